"""Events at the start of a step, told to the solver by a step of negative length.

The loop of Diffrax hands a solver nothing but times and states. That an event happens at a time that has
been reached already is therefore said by the next step: it ends a little before it starts, by a number
of units of rounding that stands for the event.
"""

from typing import NamedTuple

import jax.numpy as jnp

from .._base.types import BoolScalar, FloatScalar, IntScalar


class EventAtStart(NamedTuple):
    """An event at the start of a step.

    - `happens`: whether there is one.
    - `number`: which of the resets.
    - `irregular`: whether it has no derivative.
    - `crosses`: whether its condition is zero there, up to rounding; otherwise it is the jump before that
        changed its sign.
    """

    happens: BoolScalar
    number: IntScalar
    irregular: BoolScalar
    crosses: BoolScalar

    def end_of_step(self, start: FloatScalar, count: int) -> FloatScalar:
        """Return where the step ends that tells this event, one of `count` resets."""
        kind = 2 * self.crosses.astype(jnp.int32) + self.irregular.astype(jnp.int32)
        units = self.number + 1 + count * kind
        return start - units.astype(start.dtype) * _unit(start)

    @staticmethod
    def told_by(start: FloatScalar, end: FloatScalar, count: int) -> "EventAtStart":
        units = jnp.round((start - end) / _unit(start)).astype(jnp.int32) - 1
        units = jnp.clip(units, 0, 4 * count - 1)
        kind = units // count
        return EventAtStart(end < start, units % count, kind % 2 == 1, kind >= 2)


def _unit(t: FloatScalar) -> FloatScalar:
    """Return a length that is negligible at this time."""
    info = jnp.finfo(t.dtype)
    return jnp.maximum(2 * info.eps * jnp.abs(t), jnp.sqrt(jnp.asarray(info.tiny, t.dtype)))
