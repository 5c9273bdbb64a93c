"""Times that are NaN: neither before nor after any other time, they would end a solve at once."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, cast, NamedTuple, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from diffrax import RESULTS

from .._base.types import BoolScalar, RealScalarLike


Function = TypeVar("Function", bound=Callable)

WRONG_SIGN = "`dt0` must have the sign of t1 - t0: it is the first step on the way from t0 to t1."
NO_FIRST_STEP = (
    "`dt0` is zero, NaN or infinite: it must be the length of the first step, with the sign of t1 - t0. With an "
    "adaptive `stepsize_controller` it may be None."
)
NO_OUTPUT_TIME = "`saveat.ts` has times that are NaN. Save at numbers between t0 and t1."
_NO_START = "`t0` is NaN or infinite: it must be a number."
_NO_END = "`t1` is NaN: it must be a number, or infinite if an event ends the solve."


def is_time_missing(t0: RealScalarLike, t1: RealScalarLike) -> BoolScalar:
    return ~jnp.isfinite(t0) | jnp.isnan(t1)


def is_no_step(dt0: RealScalarLike) -> BoolScalar:
    return ~jnp.isfinite(dt0) | (jnp.asarray(dt0) == 0)


def _arrays_for(*values: Any) -> Any:
    """Return NumPy for values that are known, for which JAX would compile a program for each operation."""
    return jnp if any(isinstance(value, jax.core.Tracer) for value in values) else np


class _Faults(NamedTuple):
    """The faults of the times of a solve: whether there are any, which one to report, and the messages. The
    first two are numbers of NumPy where all times are known."""

    any: Any
    number: Any
    messages: list[str]

    @staticmethod
    def of(t0: Any, t1: Any, dt0: Any, saveat: dfx.SaveAt) -> "_Faults":
        subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
        given = [sub.ts for sub in subs if sub.ts is not None]
        xp = _arrays_for(t0, t1, dt0, *given)
        found = [(xp.any(xp.isnan(ts)), NO_OUTPUT_TIME) for ts in given]
        if dt0 is not None:
            found.append((~xp.isfinite(dt0) | (xp.asarray(dt0) == 0), NO_FIRST_STEP))
        found += [(xp.isnan(t1), _NO_END), (~xp.isfinite(t0), _NO_START)]
        number, applies = xp.zeros((), np.int32), [fault for fault, _ in found]
        for i, fault in enumerate(applies):
            number = xp.where(fault, np.int32(i), number)
        return _Faults(
            functools.reduce(xp.logical_or, applies), number, [text for _, text in found]
        )


def _attach(t0: Any, fault: Any, number: Any, messages: list[str]) -> Any:
    """Attach an error to a time; a time that is known to have none stays a number."""
    if not isinstance(fault, jax.core.Tracer) and not bool(fault):
        return t0
    return eqx.branched_error_if(jnp.asarray(t0), jnp.asarray(fault), number, messages)


def refusing_missing_times(function: Function) -> Function:
    """Wrap a solve: with `throw` raise an error that names the time at fault, otherwise return the
    result code `RESULTS.nonfinite_input`. Times that are known while tracing are checked then, at no
    cost."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def solve(*args: Any, **kwargs: Any) -> dfx.Solution:
        __tracebackhide__ = True
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        given = bound.arguments
        t0, t1, dt0, saveat, throw = (given[x] for x in ("t0", "t1", "dt0", "saveat", "throw"))
        if not isinstance(saveat, dfx.SaveAt):  # refused by the function itself
            return function(*args, **kwargs)
        with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"):
            faults = _Faults.of(t0, t1, dt0, saveat)
            xp = _arrays_for(t0, t1, dt0)
            astray = np.False_ if dt0 is None else (xp.asarray(t1) - t0) * dt0 < 0
        given["t0"] = _attach(t0, astray, 0, [WRONG_SIGN])
        if throw:
            given["t0"] = _attach(given["t0"], *faults)
        sol = function(*bound.args, **bound.kwargs)
        if throw:
            return sol
        result = RESULTS.where(faults.any, RESULTS.nonfinite_input, sol.result)  # pyright: ignore[reportArgumentType]
        return eqx.tree_at(lambda s: s.result, sol, result)

    return cast(Function, solve)
