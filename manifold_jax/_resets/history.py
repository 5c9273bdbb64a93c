"""What a solve remembers of its events from step to step."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._base.types import BoolScalar, IntScalar


class History(eqx.Module):
    """The events so far, and the conditions just before the last jump."""

    after_reset: BoolScalar  # whether the step begins at an event, or is the first one
    # The conditions just before the last jump: their values, infinite where only the sign is known, and NaN
    # for the one that caused it, which may have any sign after it.
    sides: Float[Array, " resets"]
    # Their largest values in the step before the jump, from which follows what is rounding after it. It is
    # kept as long as a condition has not left zero since, and 0 then.
    scale: Float[Array, " resets"]
    rates: Float[Array, " resets"]  # of change of the conditions just before the last jump
    happened: Int[Array, " resets"]  # how often each has happened
    irregular: IntScalar  # how many had no derivative
    failed: BoolScalar  # whether the state after the last jump could not be used

    @staticmethod
    def initial(count: int, dtype: Any) -> "History":
        never, zero = jnp.zeros(count, jnp.int32), jnp.zeros((), jnp.int32)
        unknown = jnp.zeros(count, dtype)
        return History(
            jnp.asarray(True), unknown, unknown, unknown, never, zero, jnp.asarray(False)
        )

    @property
    def remembers(self) -> Bool[Array, " resets"]:
        """Which conditions begin the step as the last jump has left them."""
        return self.after_reset | (self.scale > 0)
