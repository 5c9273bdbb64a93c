"""Forward mode of a solve with the steps that were made, as reverse mode has it: where steps end is
held fixed, but for the end of the solve."""

from typing import Any

import diffrax as dfx
import jax.lax as lax
import jax.numpy as jnp

from .._compat import LoopState, Progress, with_next_time
from .._newton import without_derivative


class SizesHeldFixed(dfx.AbstractStepSizeController):
    """Another controller, whose choices have no derivatives."""

    controller: dfx.AbstractStepSizeController

    def wrap(self, direction: Any) -> "SizesHeldFixed":
        return SizesHeldFixed(self.controller.wrap(direction))

    def init(self, *args: Any) -> Any:
        return self.controller.init(*args)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state) -> Any:
        fixed = without_derivative((t0, t1, y0, y1_candidate, args, y_error, error_order, state))
        keep, next_t0, next_t1, jump, state, result = self.controller.adapt_step_size(*fixed)
        # A step begins where the one before has ended, which may be the end of the solve.
        ends = jnp.where(next_t0 == fixed[1], t1, jnp.where(next_t0 == fixed[0], t0, next_t0))
        return keep, ends, next_t1, jump, state, result


def with_end_held_fixed(state: LoopState, t1: Any) -> LoopState:
    """The first step ends where it does, unless that is the end of the solve."""
    tnext = Progress.of(state).tnext
    return with_next_time(state, jnp.where(tnext == t1, t1, lax.stop_gradient(tnext)))
