"""Dense output of a Rosenbrock method."""

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._custom_types import RealScalarLike, Y


class RosenbrockInterpolation(dfx.AbstractLocalInterpolation):
    """`(1 - s) y0 + s (y1 + (1 - s) (k_1 + s (k_2 + ...)))`, `s` running from 0 to 1 over the
    step."""

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Y
    y1: Y
    k: tuple[Y, ...]

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        width = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(width == 0, 1, width)

        def value(y0, y1, *k):
            x = s.astype(y0.dtype)
            bump = k[-1]
            for part in reversed(k[:-1]):
                bump = part + x * bump
            return (1 - x) * y0 + x * (y1 + (1 - x) * bump)

        return jtu.tree_map(value, self.y0, self.y1, *self.k)
