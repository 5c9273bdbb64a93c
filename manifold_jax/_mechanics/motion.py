"""The equations of motion at one state: accelerations and multipliers."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.shapes import are_alike, shapes
from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._linalg.dense import (
    Factorization,
    factorize,
    gram,
    gram_written_out,
    pseudo_invert,
    UNROLL_LIMIT,
)
from .._linalg.rows import AbstractRows, combine, directions_of, multiply
from .auxiliary import split
from .kinematics import Kinematics
from .saddle_point import Factored, Pair, solve_held_fixed


class LagrangianForce(eqx.Module):
    """`Q + dL/dq - d^2L/dv dq v - d^2L/dv dt`: all terms of `d/dt dL/dv - dL/dq = Q` except `M a`."""

    lagrangian: Callable
    applied: Callable | None

    def __call__(self, t: RealScalarLike, q: Y, v: Y, *rest: Any) -> Y:
        """Evaluate the force; `rest` are the auxiliary states, if there are any, and the args."""
        args = rest[-1]
        x, unravel = jfu.ravel_pytree(q)
        w, _ = jfu.ravel_pytree(v)
        t = jnp.asarray(t, x.dtype)
        L = lambda t, x, w: self.lagrangian(t, unravel(x), unravel(w), args)
        momentum = lambda t, x: jax.grad(L, argnums=2)(t, x, w)
        _, momentum_rate = jax.jvp(momentum, (t, x), (jnp.ones_like(t), w))
        force = unravel(jax.grad(L, argnums=1)(t, x, w) - momentum_rate)
        if self.applied is None:
            return force
        return jax.tree_util.tree_map(jnp.add, force, self.applied(t, q, v, *rest))


# Largest residual of a redundant equation, relative to the size of its terms.
_LARGEST_RESIDUAL = 0.05
# Largest rounding of the residual, relative to free accelerations and squares of velocities, in units of the
# last place.
_ROUNDING = 1000


class EquationsOfMotion:
    """The quantities of the equations of motion at one state: `C a = -bias`, the mass matrix, and
    `C M^-1 C^T`, factored."""

    def __init__(self, system: Any, t: RealScalarLike, y: Y, args: Args):
        state = y if system.auxiliary is None else split(y)[0]
        here = Kinematics.of(system, t, state, args)
        self.here = here._replace(t=jnp.asarray(here.t, here.x.dtype))
        self.unravel, self.redundant = here.unravel, system.redundant
        self.C, self.num_positions = self.here.rows()
        self.bias = self.here.acceleration_bias()
        self.force = flat_force(system.force(t, *y, args), state[0], here.x)
        self.mass = self.here.mass(self.C)
        self.directions = directions_of(self.mass, self.C)
        if isinstance(self.C, AbstractRows):
            self.factorization = self.C.factorize(self.directions, checked=False)
        else:
            gram_matrix = gram_written_out(self.C, self.directions)
            self.factorization = (pseudo_invert if self.redundant else factorize)(gram_matrix)

    def solve(self, bias: Float[Array, " m"]) -> Pair:
        """Return accelerations and multipliers of `M a + C^T lambda = Q`, `C a = -bias`."""
        force = self.force
        if isinstance(self.factorization, Factorization) and bias.size > UNROLL_LIMIT:
            # The derivative of `C M^-1 C^T` would cost more than the rest of the program.
            M = self.here.mass_values()
            factored = Factored(self.C, self.directions, self.mass, self.factorization)
            pair = solve_held_fixed(M, factored, force, -bias)
            return _defined(*pair, self.mass.valid & self.factorization.usable)
        if self.mass.augmentation is not None:
            force = force - combine(self.mass.augmentation * bias, self.C)
        free = self.mass.solve(force)
        right = multiply(self.C, free) + bias
        multipliers = self.factorization.solve(right)
        accelerations = free - combine(multipliers, self.directions)
        valid = self.mass.valid & self.factorization.usable
        if isinstance(self.C, AbstractRows):
            # `M` applied to the free accelerations and to those caused by the constraints.
            size2 = jnp.abs(jnp.dot(free, force)) + jnp.abs(jnp.dot(multipliers, right))
            residual = multiply(self.C, accelerations) + bias
            valid &= self.factorization.solves(residual, size2)  # pyright: ignore[reportAttributeAccessIssue]
        elif self.redundant:
            valid &= _agree(self.C, accelerations, free, self.here.w, bias)
        return _defined(accelerations, multipliers, valid)

    def constrained(self, b: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return the smallest change of the velocities, in the metric of the masses, with `C dv = b`."""
        return combine(self.factorization.solve(b), self.directions)

    def stabilized_velocity(self) -> Float[Array, " n"]:
        p = self.num_positions
        rate, J = self.here.velocities()[:p], self.here.position_rows(self.C, p)
        directions = directions_of(self.mass, J)
        if isinstance(J, AbstractRows):
            factorization = J.factorize(directions)
        else:
            factorization = (pseudo_invert if self.redundant else factorize)(gram(J, directions))
        return self.here.w - combine(factorization.solve(rate), directions)


def _defined(a: Float[Array, " n"], multipliers: Float[Array, " m"], valid: BoolScalar) -> Pair:
    """Make both NaN unless valid. Added, not selected: the derivative of a discarded NaN would be NaN."""
    undefined = jnp.where(valid, 0, jnp.nan).astype(a.dtype)
    return a + undefined, multipliers + undefined


def _agree(
    C: Float[Array, "m n"],
    a: Float[Array, " n"],
    free: Float[Array, " n"],
    w: Float[Array, " n"],
    bias: Float[Array, " m"],
) -> BoolScalar:
    """Whether `C a = -bias`, up to the inconsistency that redundant equations have off the manifold, and to the
    rounding of the `free` accelerations, which is all that is left at rest in an equilibrium, and of the bias, a
    square of the velocities `w`. If not, an independent equation was taken for a dependent one."""
    C, a, free, w, bias = jax.lax.stop_gradient((C, a, free, w, bias))
    sizes = jnp.abs(C)
    rows = jnp.max(sizes, axis=1)
    own = sizes @ jnp.abs(a) + jnp.abs(bias)
    # For rows without motion, e.g. across the plane of a planar mechanism in space.
    largest = rows * jnp.max(jnp.abs(a)) + jnp.max(jnp.abs(bias))
    # The terms of a row that is zero, which cancelled, were as large as other rows, or about 1.
    terms = jnp.where(rows > 0, rows, jnp.max(rows))
    terms = jnp.where(terms > 0, terms, 1)
    motion = jnp.max(jnp.abs(free)) + jnp.max(w * w)
    rounding = _ROUNDING * jnp.finfo(a.dtype).eps * terms * motion
    most = _LARGEST_RESIDUAL * (own + 0.02 * largest) + rounding
    return jnp.all(jnp.abs(C @ a + bias) <= most)


def flat_force(force: Any, q: Y, x: Float[Array, " n"]) -> Float[Array, " n"]:
    if not are_alike(force, q):
        raise ValueError(
            f"`force` must return Q(t, q, v, args) of the structure and shapes of q, {shapes(q)}, got {shapes(force)}."
        )
    return jfu.ravel_pytree(force)[0].astype(x.dtype)
