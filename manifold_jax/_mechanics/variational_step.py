"""The step of RATTLE for masses that depend on positions and forces that depend on velocities: implicit."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.types import Args, BoolScalar
from .._constraint.correction import FactoredGram
from .._constraint.residual import row_scale
from .._constraint.settings import NewtonProjection
from .._linalg.newton import chord, implicit_root, SquareSystem, without_derivative
from .._linalg.rows import combine, product
from .kinematics import Kinematics
from .mass import InvertedBlocks, Mass
from .motion import flat_force
from .separable_step import linearized, on_constraints, Point
from .system import MechanicalSystem


# The most simplified Newton iterations of a step. Each reduces the error by a factor of about `h^2`.
_MOST = 30


class _ImplicitStart(NamedTuple):
    """The masses, factored, and the constraints linearized."""

    mass: Mass | InvertedBlocks
    factored: FactoredGram
    usable: BoolScalar


class VariationalStep(NamedTuple):
    """A step of second order, for the velocity `w` in its middle and multipliers:

        (M(q0) + M(q1)) w / 2 = M(q0) v0 + h/2 (F(q0, w) - J(q0)^T lambda),   q1 = q0 + h w,   phi(q1) = 0,
        M(q1) v1 = (M(q0) + M(q1)) w / 2 + h/2 (F(q1, w) - J(q1)^T mu),   J(q1) v1 = 0,

    with `F(q, v) = Q + M' v`, the rate of the momentum `M v`. With `M' = d/dt M(q)` the gyroscopic forces,
    which `Q` contains, become `d/dq (v^T M v / 2)`: these are the discrete Euler-Lagrange equations of the
    trapezoidal rule, `h/2 (L(q0, w) + L(q1, w))`. With unit quaternions `2 G(q0) w = 2 G(q1) w` is the angular
    velocity, so that for rigid bodies they are those of a Lie group method.

    Sources: Wendlandt & Marsden, Physica D 106 (1997) 223-246; Marsden & West, Acta Numerica 10 (2001)
    357-514, sections 2.3 and 3.5; Hairer, Lubich & Wanner (2006), sections VI.6.2 and VII.5.
    """

    system: MechanicalSystem
    unravel: Callable
    args: Args

    def at(self, t: Any, x: Array, w: Array) -> _ImplicitStart:
        mass, factored = linearized(self._kinematics(t, x, w))
        return _ImplicitStart(mass, factored, mass.valid & factored.factorization.usable)

    def made(self, start: Point, h: Any) -> Point:
        t, x, w, here, success = start
        after, normals = t + h, here.factored.normals

        def end_of(change: Array) -> tuple[Array, Array]:
            """Return the velocity in the middle, and the positions to which it leads."""
            middle = w.plus(change)
            return middle.value, x.moved(h, middle).value

        def accelerated(z: Array) -> tuple[Array, Array]:
            """Return the change of the velocity that the unknowns imply, and the positions at the end."""
            change, multipliers = z[: x.value.size], z[x.value.size :]
            velocity, x1 = end_of(change)
            impulse = self._impulse(t, x.value, velocity, (t, x.value), (after, x1), h)
            return here.mass.solve(impulse) - combine(multipliers, normals.directions), x1

        def equations(z: Array) -> Array:
            change, x1 = accelerated(z)
            distance = self._kinematics(after, x1, w.value).positions()
            return jnp.concatenate([z[: change.size] - change, distance / h])

        sizes = row_scale(normals.jacobian, x.value) / jnp.abs(h)
        sizes = lax.stop_gradient(jnp.concatenate([jnp.abs(w.value) + 1, sizes]))
        z, solved = _solve(equations, jnp.zeros_like(sizes), sizes)
        middle = w.plus(accelerated(z)[0])  # once more: it is then as accurate as it is small
        x1 = x.moved(h, middle)
        there = self.at(after, x1.value, middle.value)
        ends = (t, x.value), (after, x1.value)
        impulse = self._impulse(after, x1.value, middle.value, *ends, h)
        w1 = middle.plus(there.mass.solve(impulse))
        w1 = on_constraints(self._kinematics(after, x1.value, w1.value), w1, there.factored)
        return Point(after, x1, w1, there, success & solved & there.usable)

    def _impulse(self, t: Any, x: Array, w: Array, start: tuple, end: tuple, h: Any) -> Array:
        """Return `h/2 F(t, x, w) - (M(end) - M(start)) w / 2`, which changes the momentum of a half step."""
        momentum = lambda t, x: self._momentum(t, x, w)
        q, v = self.unravel(x), self.unravel(w)
        force = flat_force(self.system.force(t, q, v, self.args), q, x)
        _, rate = jax.jvp(momentum, (t, x), (jnp.ones_like(t), w))
        return 0.5 * (h * (force + rate) - (momentum(*end) - momentum(*start)))

    def _momentum(self, t: Any, x: Array, w: Array) -> Float[Array, " k"]:
        M = self._kinematics(t, x, w).mass_values()
        return product(M.matrix if isinstance(M, InvertedBlocks) else M, w)

    def _kinematics(self, t: Any, x: Array, w: Array) -> Kinematics:
        return Kinematics.of(self.system, t, (self.unravel(x), self.unravel(w)), self.args)


def _solve(equations: Callable, guess: Array, sizes: Array) -> tuple[Array, BoolScalar]:
    """Return the root by simplified Newton iterations, with its derivative, and whether it is one."""
    system = SquareSystem(convert_closure(equations, guess))
    fixed = without_derivative(system)
    linearization = fixed.linearize(guess)
    root = chord(fixed, linearization, guess, guess, fixed.residual(guess), sizes, _MOST)
    # With masses of a bad condition, as those of a long chain in its angles, rounding leaves more of the
    # residual than elsewhere; it no longer shrinks then.
    stalled = ~root.progress & (root.scaled_residual <= float(jnp.finfo(guess.dtype).eps) ** 0.75)
    success = stalled | (root.scaled_residual <= NewtonProjection().tolerance_for(guess.dtype))
    return implicit_root(system, jnp.where(success, root.z, guess)), success
