"""Stabilization inside the equations of motion, where it costs next to nothing."""

import equinox as eqx
import jax.numpy as jnp

from .._base.types import FloatScalar, RealScalarLike
from .._solver.stabilization import refuse_negative


class Baumgarte(eqx.Module):
    r"""Baumgarte's stabilization of a [`MechanicalSystem`][]: the accelerations satisfy
    `phi'' + 2 alpha phi' + beta^2 phi = 0` instead of `phi'' = 0`, and nonholonomic
    constraints `a' + alpha a = 0`. Backwards in time the damping changes its sign, so that
    violations decay in the direction of integration.

    **Arguments:**

    - `alpha`, `beta`: 1/time, not negative; `beta = alpha` is critical damping.

    The violation settles at a level set by the truncation error; nothing is on the manifold to
    round-off. Small gains are best, some `1 / (10 h)` or less for steps `h`; `alpha = 1 / h` is a poor
    choice, and beyond the stability interval of the solver (`alpha h` of about 2 to 3 for explicit
    Runge-Kutta methods) violations grow without bound: `mj.diffeqsolve` refuses constant steps of that
    size, adaptive ones get smaller. Prefer [`Projected`][], which needs no gains.

    Source: Baumgarte, Comput. Methods Appl. Mech. Engrg. 1 (1972) 1-16.
    """

    alpha: RealScalarLike
    beta: RealScalarLike

    def __check_init__(self):
        refuse_negative("alpha", self.alpha)
        refuse_negative("beta", self.beta)

    @property
    def rate(self) -> FloatScalar:
        """Return the largest modulus of the roots of `s^2 + 2 alpha s + beta^2`."""
        alpha, beta = jnp.asarray(self.alpha, float), jnp.asarray(self.beta, float)
        return jnp.maximum(beta, alpha + jnp.sqrt(jnp.maximum(alpha**2 - beta**2, 0)))


class VelocityStabilization(eqx.Module):
    r"""The stabilization of Gear, Gupta and Leimkuhler of a [`MechanicalSystem`][], in explicit
    form: `q' = v - M^-1 J^T (J M^-1 J^T)^-1 (J v + dphi/dt)`.

    Then `phi' = 0` whatever the velocities, and positions drift off linearly instead of
    quadratically in time. Neutral in both directions of time: it attracts nothing.

    Source: Gear, Gupta & Leimkuhler, J. Comput. Appl. Math. 12/13 (1985) 77-90.
    """
