"""Dense output of mechanical states."""

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.types import RealScalarLike, Y


class MechanicalHermite(dfx.AbstractLocalInterpolation):
    """Positions as the cubic polynomial with the velocities at both ends, and velocities as its derivative.

    `length` is that of the step in true time. It is not taken from the times, which searches for events
    replace by 0 and 1.
    """

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Y
    y1: Y
    length: RealScalarLike

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        span, h = self.t1 - self.t0, self.length
        s = (t0 - self.t0) / jnp.where(span == 0, 1, span)
        (q0, v0), (q1, v1) = self.y0, self.y1

        def position(q0: Array, q1: Array, v0: Array, v1: Array) -> Array:
            turn = s * s * (3 - 2 * s)
            bend = s * (1 - s) * h * ((1 - s) * v0 - s * v1)
            return (q0 + turn * (q1 - q0) + bend).astype(q0.dtype)

        def velocity(q0: Array, q1: Array, v0: Array, v1: Array) -> Array:
            mean = (q1 - q0) / jnp.where(h == 0, 1, h)
            own = (1 - s) * (1 - 3 * s) * v0 - s * (2 - 3 * s) * v1
            return (6 * s * (1 - s) * mean + own).astype(v0.dtype)

        return tuple(jtu.tree_map(part, q0, q1, v0, v1) for part in (position, velocity))
