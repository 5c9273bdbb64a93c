"""Forward mode at the steps that were made, as in reverse mode: the ends of steps are held fixed,
except for the end of the solve."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.compat import LoopState, Progress, with_next_time
from .._linalg.newton import without_derivative
from .._resets.controller import ResettingController


class SizesHeldFixed(dfx.AbstractStepSizeController):
    """Wraps a controller; the step sizes it chooses have no derivatives."""

    controller: dfx.AbstractStepSizeController

    def wrap(self, direction: Any) -> "SizesHeldFixed":
        return SizesHeldFixed(self.controller.wrap(direction))

    def init(self, *args: Any) -> Any:
        return self.controller.init(*args)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state) -> Any:
        fixed = without_derivative((t0, t1, y0, y1_candidate, args, y_error, error_order, state))
        keep, next_t0, next_t1, jump, state, result = self.controller.adapt_step_size(*fixed)
        # A step begins at the end of the one before, which may be the end of the solve.
        ends = jnp.where(next_t0 == fixed[1], t1, jnp.where(next_t0 == fixed[0], t0, next_t0))
        return keep, ends, next_t1, jump, state, result


def with_sizes_held_fixed(
    controller: dfx.AbstractStepSizeController,
) -> dfx.AbstractStepSizeController:
    """Return a controller whose step sizes have no derivatives; the times of events have."""
    if isinstance(controller, ResettingController):
        return eqx.tree_at(
            lambda c: c.controller, controller, SizesHeldFixed(controller.controller)
        )
    return SizesHeldFixed(controller)


def with_end_held_fixed(state: LoopState, t1: Any) -> LoopState:
    """Hold the end of the first step fixed, unless it is the end of the solve."""
    tnext = Progress.of(state).tnext
    return with_next_time(state, jnp.where(tnext == t1, t1, lax.stop_gradient(tnext)))


def event_of_controller(
    event: dfx.Event | None, controller: dfx.AbstractStepSizeController
) -> dfx.Event | None:
    """Return the event with the original controller, whose tolerances Diffrax's own event functions ask
    for, instead of the wrapped one."""
    if event is None:
        return None

    own = {"stepsize_controller": controller}
    wrap = lambda cond_fn: lambda *args, **kwargs: cond_fn(*args, **kwargs | own)
    cond_fn = jtu.tree_map(wrap, event.cond_fn, is_leaf=callable)
    return dfx.Event(cond_fn, event.root_finder, event.direction)
