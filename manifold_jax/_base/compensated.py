"""Sums over many steps whose rounding errors do not add up."""

from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .types import FloatScalar, IntScalar, RealScalarLike


class Compensated(NamedTuple):
    """A vector as the sum `value + rest`, where `rest` is what rounding has taken from the `value`.

    The rest has no derivative: it is a rounding error. Source: Kahan, Comm. ACM 8 (1965) 40; the error of a
    sum is that of Moller and Knuth, see Hairer, Lubich & Wanner (2006), section VIII.5.
    """

    value: Float[Array, " k"]
    rest: Float[Array, " k"]

    @staticmethod
    def of(value: Float[Array, " k"]) -> "Compensated":
        return Compensated(value, jnp.zeros_like(value))

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


# Differences of times that agree to so many units of rounding of the later one are the same.
_SAME = 4


class SteadySteps(NamedTuple):
    """The run of steps of equal length so far: where it began, and how many they are.

    Times far from zero have few digits after the point: the difference of two that follow each other is the
    length of the step with an error that depends on the time. That of the whole run is not, and steps of
    one length are what the energy of reversible methods relies on.
    """

    start: FloatScalar
    count: IntScalar

    @staticmethod
    def beginning(t0: RealScalarLike) -> "SteadySteps":
        return SteadySteps(jnp.asarray(t0), jnp.zeros((), jnp.int32))

    def then(self, t0: RealScalarLike, t1: RealScalarLike) -> "tuple[FloatScalar, SteadySteps]":
        """Return the length of the step from `t0` to `t1`, the mean of its run, and the run with it. A step
        of another length begins a new run."""
        mean = (t1 - self.start) / (self.count + 1).astype(self.start.dtype)
        rounding = jnp.finfo(self.start.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        same = jnp.abs(t1 - t0 - mean) <= _SAME * rounding
        run = SteadySteps(jnp.where(same, self.start, t0), jnp.where(same, self.count + 1, 1))
        return jnp.where(same, mean, t1 - t0), run
