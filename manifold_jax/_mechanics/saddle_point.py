"""The equations of motion `M a + C^T lambda = Q`, `C a = r` as one linear system, and its derivative.

Differentiated as `A x = b`, `dx = A^-1 (db - dA x)`: the derivative of the elimination would be that of
every entry of `C M^-1 C^T`, `m^2 n` operations for each direction, where products take `m n`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg.dense import Factorization
from .._linalg.rows import combine, multiply, product
from .mass import InvertedBlocks, Mass


Pair = tuple[Float[Array, " n"], Float[Array, " m"]]


class Factored(NamedTuple):
    """The factors of the system: `C`, the rows of `C M^-1`, and `M` and `C M^-1 C^T` factored."""

    C: Float[Array, "m n"]
    directions: Float[Array, "m n"]
    mass: Mass | InvertedBlocks
    factorization: Factorization

    def accelerations(self, force: Float[Array, " n"], r: Float[Array, " m"]) -> Pair:
        """Return accelerations and multipliers."""
        if self.mass.augmentation is not None:
            force = force + combine(self.mass.augmentation * r, self.C)
        free = self.mass.solve(force)
        multipliers = self.factorization.solve(multiply(self.C, free) - r)
        return free - combine(multipliers, self.directions), multipliers

    def momenta(self, force: Float[Array, " n"], r: Float[Array, " m"]) -> Pair:
        """Return `p = M a` and multipliers: `p + C^T lambda = Q`, `C M^-1 p = r`."""
        multipliers = self.factorization.solve(multiply(self.C, self.mass.solve(force)) - r)
        return force - combine(multipliers, self.C), multipliers

    def momenta_transposed(self, f: Float[Array, " n"], r: Float[Array, " m"]) -> Pair:
        """Solve the transposed system `u + M^-1 C^T mu = f`, `C u = r`."""
        multipliers = self.factorization.solve(multiply(self.C, f) - r)
        return f - combine(multipliers, self.directions), multipliers


def solve_held_fixed(M: Any, factored: Factored, force: Float[Array, " n"], r: Any) -> Pair:
    """Return accelerations and multipliers, with the derivatives of `M` (as of `mass_values`), `C`,
    `force` and `r`, but not of the factors."""
    C, factored = factored.C, jax.lax.stop_gradient(factored)
    if isinstance(M, InvertedBlocks):  # with M^-1 p in the place of a, as M is not known
        momenta = lambda p, z: (p + combine(z, C), multiply(C, M.solve(p)))
        p, multipliers = _solve_linear(
            momenta, force, r, factored.momenta, factored.momenta_transposed
        )
        return M.solve(p), multipliers
    both = lambda a, z: (product(M, a) + combine(z, C), multiply(C, a))
    return _solve_linear(both, force, r, factored.accelerations, factored.accelerations)


def _solve_linear(product: Any, force: Any, r: Any, solve: Any, solve_transposed: Any) -> Pair:
    """Solve for both unknowns in one vector: `custom_linear_solve` cannot be differentiated if only one
    of several right-hand sides depends on something (JAX 0.10.2 and 0.12.0)."""
    n = force.size
    as_one = lambda f: lambda x: jnp.concatenate(f(x[:n], x[n:]))
    x = jax.lax.custom_linear_solve(
        as_one(product),
        jnp.concatenate([force, r]),
        lambda _, b: as_one(solve)(b),
        lambda _, b: as_one(solve_transposed)(b),
    )
    return x[:n], x[n:]
