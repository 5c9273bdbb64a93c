"""Sums over many steps whose rounding errors do not add up."""

from typing import NamedTuple

import jax.lax as lax
from jaxtyping import Array, Float

from .types import FloatScalar


class Compensated(NamedTuple):
    """A vector as the sum `value + rest`, where `rest` is what rounding has taken from the `value`.

    The rest has no derivative: it is a rounding error. Source: Kahan, Comm. ACM 8 (1965) 40; the error of a
    sum is that of Moller and Knuth, see Hairer, Lubich & Wanner (2006), section VIII.5.
    """

    value: Float[Array, " k"]
    rest: Float[Array, " k"]

    def plus(self, increment: Float[Array, " k"]) -> "Compensated":
        """Add an increment; the smaller it is, the smaller is the rounding error."""
        increment = increment + self.rest
        value = self.value + increment
        added = value - self.value
        rest = (self.value - (value - added)) + (increment - added)
        return Compensated(value, lax.stop_gradient(rest))

    def moved(self, h: FloatScalar, velocity: "Compensated") -> "Compensated":
        """Add `h * velocity`."""
        return self.plus(h * velocity.value + h * velocity.rest)
