"""The reduced equations with their leading derivatives as unknowns, of index 1:

    z' = (z, w),   0 = F_i^(c_i)(t, z, w)

so that equations nonlinear in `w` need neither be differentiated once more nor solved for `w` in the
vector field: a Rosenbrock method does both at once. The state is `(z, w)`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, RealScalarLike
from .._constraint.settings import NewtonProjection
from .._linalg.newton import AbstractEquations, damped_newton, implicit_root, without_derivative
from .constraint import Reduced
from .highest_derivatives import HighestDerivatives
from .layout import Layout
from .pivots import Pivoted


_MAX_STEPS = 100


def mass(layout: Layout) -> np.ndarray:
    """Its diagonal."""
    return np.repeat([1.0, 0.0], [layout.num_states, len(layout.structure.d)])


def implicit_field(
    system: Reduced, t: RealScalarLike, y: Float[Array, " n"], args: Args
) -> Float[Array, " n"]:
    z, w = system.split(y)
    assert w is not None
    rate = system.static.plan.layout.rate()(z, w)
    return jnp.concatenate([rate, system.closing(t, z, args).residual(w)])


class _Leading(AbstractEquations):
    """The closing equations, for `w`."""

    closing: HighestDerivatives

    def point(self, z: Float[Array, " k"]) -> Float[Array, " k"]:
        return z

    def residual(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return self.closing.residual(x)

    def linearize(self, x: Float[Array, " k"]) -> Pivoted:
        return Pivoted.of(self.closing.matrix(x))


def leading(
    closing: HighestDerivatives, guess: Float[Array, " k"]
) -> tuple[Float[Array, " k"], BoolScalar]:
    """The derivatives near a guess, and whether they solve the equations."""
    equations = _Leading(closing)
    fixed, start = without_derivative((equations, guess))
    r, tolerance = fixed.residual(start), NewtonProjection().tolerance_for(start.dtype)
    found = damped_newton(fixed, start, r, jnp.ones_like(r), _MAX_STEPS, tolerance).z
    change = fixed.linearize(found).solve(fixed.residual(found))
    small = jnp.max(jnp.abs(change) / (1 + jnp.abs(found)), initial=0) <= 1e3 * tolerance
    return implicit_root(equations, found), jax.lax.stop_gradient(small)
