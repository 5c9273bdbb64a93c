"""What a user writes: a condition or times, and the state after the jump."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function


_NAN = "NaN, which is no time. Leave it out, or write infinity for a jump that is not made."
TIME_IS_NAN = f"`times` of an `mj.ResetAt` in `resets` has {_NAN}"


class Reset(eqx.Module):
    """A jump of the state where a condition changes sign: impacts, switches, thresholds.

    At the time `t*` at which `condition(t, y, args)` crosses zero the state `y-` becomes
    `jump(t*, y-, args)`, corrected onto the manifold of the solver, and the solve goes on from there.

    **Arguments:**

    - `condition`: `condition(t, y, args) -> float`, a differentiable function that crosses zero at the
        event. Or a Boolean one, for an event where it becomes true; the time of such an event
        has no derivative. (A trailing `**kwargs`, as in event functions of Diffrax, stays empty.)
    - `jump`: `jump(t, y, args) -> y`, the state after the event, of the same structure, shapes and dtypes.
    - `direction`: `True` for events where the condition increases, `False` where it decreases,
        `None` (default) for both. Of the progress of the solve, also backwards in time.
    - `samples`: the number of parts into which a step is divided to look for changes of sign. More find
        events of conditions that change faster than the state.
    - `max_number`: how often it can happen in a solve, afterwards the condition is ignored. By default
        there is no such limit.

    An event is a change: a condition that has its new sign at `t0` already is not one. One that is zero
    at `t0` and moves on in a stated `direction` is. A jump that makes another condition
    change sign causes that event, at the same time. Of several events at one time the first in `resets`
    comes first.

    The derivative includes that of the time of the event (the saltation matrix). It does not exist
    where the condition only touches zero, or where events change their order; see
    `sol.stats["num_nondifferentiable_resets"]`.

    **Raises:**

    `TypeError` or `ValueError` for functions that cannot be called like this.

    Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204-220, for the derivative.
    """

    condition: Callable[..., Any]
    jump: Callable[[RealScalarLike, Y, Args], Y]
    direction: bool | None = eqx.field(static=True, default=None, kw_only=True)
    samples: int = eqx.field(static=True, default=10, kw_only=True)
    max_number: int | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_function("condition", self.condition, "condition(t, y, args)")
        check_function("jump", self.jump, "jump(t, y, args)")
        if self.direction not in (True, False, None):
            raise ValueError(
                f"`direction` must be True (increasing), False (decreasing) or None, got {self.direction!r}."
            )
        for name in ("samples", "max_number"):
            value = getattr(self, name)
            is_count = isinstance(value, int) and not isinstance(value, bool) and value > 0
            if not is_count and not (name == "max_number" and value is None):
                raise ValueError(f"`{name}` must be a positive integer, got {value!r}.")


class ResetAt(eqx.Module):
    """A jump of the state at known times: doses, switching times, sampled controllers.

    At each of the times, which steps meet exactly, the state `y-` becomes `jump(t, y-, args)`,
    corrected onto the manifold of the solver. Times before `t0` or from `t1` on are ignored; at `t0`
    the jump is made first. The state has a derivative with respect to `times`; where two of them coincide,
    also of two of the `resets`, only for changes that keep them together.

    **Arguments:**

    - `times`: array of shape `(k,)`, in any order; or a function `times(args)` that returns it, for times
        that each trajectory of an ensemble has of its own. Infinity stands for a jump that is not made; a
        solve with NaN ends before its first step, with `RESULTS.nonfinite_input`.
    - `jump`: `jump(t, y, args) -> y`, the state after the jump, of the same structure, shapes and dtypes.

    **Raises:**

    `TypeError` or `ValueError` for times that are not a vector of numbers, or for another `jump`.
    """

    times: Array | Callable[[Args], Any]
    jump: Callable[[RealScalarLike, Y, Args], Y]

    def __init__(
        self,
        times: Sequence[float] | Array | Callable[[Args], Any],
        jump: Callable[[RealScalarLike, Y, Args], Y],
    ):
        check_function("jump", jump, "jump(t, y, args)")
        self.times = times if callable(times) else _vector(times)
        self.jump = jump

    def with_times(self, args: Args) -> "ResetAt":
        """Return this with the times as an array."""
        return ResetAt(self.times(args), self.jump) if callable(self.times) else self


def _vector(times: Any) -> Array:
    try:
        array = jnp.asarray(times)
    except (TypeError, ValueError):
        array = jnp.zeros(0, bool)
    if array.ndim != 1 or array.dtype == bool or jnp.iscomplexobj(array):
        raise TypeError(
            f"`times` must be a vector of numbers, or a function of `args` that returns one, got {_described(times)}."
        )
    if not isinstance(array, jax.core.Tracer) and np.isnan(np.asarray(array)).any():
        raise ValueError(f"`times` has {_NAN}")
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)


def check_resets(resets: Any, max_resets: Any, controller_state: Any) -> None:
    if not isinstance(resets, tuple | list):
        raise TypeError(
            f"`resets` must be a tuple of `mj.Reset` and `mj.ResetAt`, got {type(resets).__name__}. Write "
            "`resets=(mj.Reset(condition, jump),)`."
        )
    for reset in resets:
        if not isinstance(reset, Reset | ResetAt):
            raise TypeError(
                "`resets` must be a tuple of `mj.Reset(condition, jump)` and `mj.ResetAt(times, jump)`, got one with a "
                f"{type(reset).__name__}."
            )
    if not isinstance(max_resets, int) or isinstance(max_resets, bool) or max_resets < 1:
        raise ValueError(f"`max_resets` must be a positive integer, got {max_resets!r}.")
    if resets and controller_state is not None:
        raise ValueError(
            "`controller_state` cannot be passed to a solve with `resets`, whose steps are chosen anew after each."
        )


def _described(x: Any) -> str:
    if isinstance(x, np.ndarray | Array):
        return f"an array of shape {x.shape} and dtype {x.dtype}"
    return type(x).__name__
