r"""The equations of the three stages of a step, `R(Z) = 0`, and their derivatives.

$$R_i(Z) = h f(t_i, y_0 + Z_i) - M(t_i, y_0 + Z_i) V_i, \qquad V = A^{-1} Z, \quad t_i = t_0 + c_i h.$$

For a mass matrix that depends on time or state this is the method for the larger system $y' = z$,
$0 = f(t, y) - M(t, y) z$, with $h z = V_i$ at the stages.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar, RealScalarLike
from .._linalg.dense import Factorization
from .._linalg.pivoted import factorize_pivoted
from .._linalg.rows import product
from .._rosenbrock.algebraic import as_matrix
from .._rosenbrock.system import System, Vector
from .tableau import A_INVERSE, C, GAMMA, MU, T, T_INVERSE


Stages = Float[Array, "3 n"]


def constant(values: object, like: Array) -> Array:
    """Return coefficients in the precision of the state."""
    return jnp.asarray(values, like.dtype)


class StageEquations(NamedTuple):
    """The equations of one step from the state `x0`."""

    system: System
    x0: Vector

    @property
    def times(self) -> Float[Array, " 3"]:
        # Not rounded beyond the end, where the field may jump.
        inside = [self.system.time(c) for c in C.tolist()[:2]]
        return jnp.stack([*inside, jnp.asarray(self.system.t1, inside[0].dtype)])

    def mass(self, t: RealScalarLike, x: Vector) -> Float[Array, "..."]:
        M = self.system.mass_at(t, x)
        return jnp.ones((), x.dtype) if M is None else M

    def rest(self, t: RealScalarLike, x: Vector, V: Vector) -> Vector:
        """Return `h f - M V`."""
        return self.system.increment(t, x) - product(self.mass(t, x), V)

    def residual(self, Z: Stages) -> Stages:
        V = constant(A_INVERSE, Z) @ Z
        return jax.vmap(self.rest)(self.times, self.x0[None] + Z, V)

    def newton_step(self, Z: Stages) -> Stages:
        """Return the step of Newton's method with the exact matrix, of size `3 n`."""
        V, X, n = constant(A_INVERSE, Z) @ Z, self.x0[None] + Z, self.x0.size
        J = jax.vmap(jax.jacfwd(self.rest, argnums=1))(self.times, X, V)
        M = jax.vmap(lambda t, x: as_matrix(self.mass(t, x), n))(self.times, X)
        blocks = -constant(A_INVERSE, Z)[:, :, None, None] * M[:, None]
        blocks = blocks + jnp.eye(3, dtype=Z.dtype)[:, :, None, None] * J[:, None]
        matrix = blocks.swapaxes(1, 2).reshape(3 * n, 3 * n)
        residual = self.residual(Z).reshape(-1)
        return -factorize_pivoted(matrix).solve(residual).reshape(Z.shape)

    def at_start(self, V0: Vector) -> "SimplifiedNewton":
        """Linearize at the beginning of the step, where `V0` is `h y'`."""
        t0, x0 = jnp.asarray(self.system.t0), self.x0
        rest, push = jax.linearize(lambda x: self.rest(t0, x, V0), x0)
        J = jax.vmap(push, out_axes=1)(jnp.eye(x0.size, dtype=x0.dtype))
        M = self.mass(t0, x0)
        return SimplifiedNewton.of(rest + product(M, V0), M, J)


class SimplifiedNewton(NamedTuple):
    """The matrices of a step with the Jacobian of its beginning: one real and one complex.

    - `f0`: `h f` at the beginning.
    - `defined`, `nonsingular`: whether the equations are finite, and the matrices usable.
    """

    f0: Vector
    M: Float[Array, "..."]
    real: Factorization
    complex: Factorization
    defined: BoolScalar

    @staticmethod
    def of(f0: Vector, M: Float[Array, "..."], J: Float[Array, "n n"]) -> "SimplifiedNewton":
        mass = as_matrix(M, f0.size)
        defined = jnp.all(jnp.isfinite(f0)) & jnp.all(jnp.isfinite(J))
        shifted = jax.lax.complex(MU.real * mass - J, MU.imag * mass)
        real = factorize_pivoted(GAMMA * mass - J)
        return SimplifiedNewton(f0, M, real, factorize_pivoted(shifted), defined)

    @property
    def nonsingular(self) -> BoolScalar:
        return self.real.usable & self.complex.usable

    def step(self, R: Stages) -> Stages:
        """Return the change of the stages that removes the residual `R`, decoupled by the eigenvectors
        of `A^-1` (Hairer & Wanner, Solving ODEs II, IV.8)."""
        first, second, third = constant(T_INVERSE, R) @ R
        first = self.real.factors.solve(first)
        pair = self.complex.factors.solve(jax.lax.complex(second, third))
        parts = jnp.stack([first, pair.real, pair.imag])
        return constant(T, R) @ parts

    def filtered(self, f: Vector, combination: Vector) -> Vector:
        """Return the embedded error estimate (IV.8.20)."""
        return self.real.factors.solve(f + product(self.M, combination))


def extrapolated(Z: Stages, ratio: FloatScalar) -> Stages:
    """Return guesses of the stages from those of the step before, whose length is `1 / ratio` of this
    one's: the collocation polynomial, continued."""
    s = 1 + constant(C, Z) * ratio
    nodes = [0.0, *C.tolist()]
    weights = []
    for j in range(1, 4):
        factors = [(s - nodes[k]) / (nodes[j] - nodes[k]) for k in range(4) if k != j]
        weights.append(factors[0] * factors[1] * factors[2])
    return jnp.stack(weights, axis=1) @ Z - Z[2:]
