"""Checks of the numbers of a solve before they become arrays of a compiled program: its times, and the
tolerances of its steps."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, cast, TypeVar

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np

from .._solver.base import controller_tolerances


Function = TypeVar("Function", bound=Callable)


def checking_numbers(*, several_times: bool = False) -> Callable[[Function], Function]:
    """Wrap a solve whose numbers become arrays: refuse times and tolerances that are no real numbers, and
    what is known to be unusable. With `several_times` each trajectory may have times of its own."""

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def solve(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            given = signature.bind(*args, **kwargs).arguments
            for name in ("t0", "t1"):
                _check_real(f"`{name}`", given[name], axes=1 if several_times else 0)
            _check_first_step(given["dt0"])
            _check_tolerances(given.get("stepsize_controller"))
            return function(*args, **kwargs)

        return cast(Function, solve)

    return decorate


def _check_real(what: str, value: Any, axes: int | None = None) -> None:
    """Refuse what is no real number, nor an array of them with at most so many axes."""
    if not eqx.is_array_like(value):
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise TypeError(f"{what} must be a real number, got {got}.")
    dtype = jnp.result_type(value)
    if not jnp.issubdtype(dtype, jnp.floating) and not jnp.issubdtype(dtype, jnp.integer):
        raise TypeError(f"{what} must be a real number, got one of type {dtype}.")
    if axes is not None and jnp.ndim(value) > axes:
        raise ValueError(f"{what} must be one number, got an array of shape {jnp.shape(value)}.")


def _check_first_step(dt0: Any) -> None:
    if dt0 is None:
        return
    _check_real("`dt0`", dt0, axes=0)
    if isinstance(dt0, int | float) and not 0 < abs(dt0) < float("inf"):
        raise ValueError(
            f"`dt0` must be the length of the first step, with the sign of t1 - t0, got {dt0}. With an adaptive "
            "`stepsize_controller` it may be None."
        )


def _check_tolerances(controller: Any) -> None:
    """Refuse tolerances with which no step, or every step, would be accepted. Those of which only a program
    knows the values are taken as they are."""
    tolerances = controller_tolerances(controller)
    if tolerances is None:
        return
    values = []
    for name in ("rtol", "atol"):
        value = getattr(tolerances, name)
        _check_real(f"`{name}` of `stepsize_controller`", value)
        if isinstance(value, jax.core.Tracer):
            continue
        values.append(np.asarray(value))
        if not np.all(values[-1] >= 0):
            raise ValueError(
                f"`{name}` of `stepsize_controller` must not be negative or NaN, got {value}. Write e.g. "
                "`diffrax.PIDController(rtol=1e-6, atol=1e-6)`."
            )
    if len(values) == 2 and values[0].ndim == 0 and np.any(values[0] + values[1] == 0):
        raise ValueError(
            "`rtol` and `atol` of `stepsize_controller` are both zero: no step is that accurate. Write e.g. "
            "`diffrax.PIDController(rtol=1e-6, atol=1e-6)`."
        )
