"""The vector field of a mass matrix and a forcing vector."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike, Y
from .._linalg.pivoted import factorize_equilibrated
from .function import SymbolicFunction


class SymbolicField(eqx.Module):
    """`(q', u')` from `K q' = k` and `M (u', multipliers) = f`, solved numerically: an inverse in symbols
    would be far larger than its matrix. NaN where a matrix is singular."""

    equations: SymbolicFunction  # K, k, M, f; without K where it is the identity
    explicit: bool = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        *kinematic, mass, forcing = self.equations(t, y, args)
        rates = kinematic[0] if self.explicit else _solve(*kinematic)
        return rates, _solve(mass, forcing)[: y[1].shape[0]]


def _solve(A: Float[Array, "n n"], b: Float[Array, " n"]) -> Any:
    factorization = factorize_equilibrated(A)
    # Added, not selected: the derivative of a discarded NaN would be NaN.
    return factorization.solve(b) + jnp.where(factorization.usable, 0, jnp.nan).astype(b.dtype)
