"""Gaussian elimination of small matrices without row exchanges, written out or in loops over columns.

Source: Golub & Van Loan, Matrix Computations (2013), sections 3.1 and 3.2.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar


# Largest number of columns for which factors are computed entry by entry. At 8 (four-bar linkage) a loop
# compiles in 0.8 of the time and runs in 1.25 (jaxlib 0.12.0.1) and 0.65 times (0.10.2) of it; at 6
# (chain of six links) in 0.95, and 1.15. Inverses are always computed in a loop: 0.7 of the time to
# compile the gradient of a four-bar linkage, which runs in 0.85 of it.
LARGEST_WRITTEN_OUT = 6


class WrittenOut(eqx.Module):
    """`A = L U` entry by entry, `L` with a unit diagonal below `U`."""

    lu: list[list[FloatScalar]]

    def solve(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        lu, m = self.lu, len(self.lu)
        x = [b[i] for i in range(m)]
        for i in range(m):
            for k in range(i):
                x[i] = x[i] - lu[i][k] * x[k]
        for i in reversed(range(m)):
            for k in range(i + 1, m):
                x[i] = x[i] - lu[i][k] * x[k]
            x[i] = x[i] / lu[i][i]
        return jnp.stack(x)

    def solve_transposed(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        lu, m = self.lu, len(self.lu)
        x = [b[i] for i in range(m)]
        for i in range(m):
            for k in range(i):
                x[i] = x[i] - lu[k][i] * x[k]
            x[i] = x[i] / lu[i][i]
        for i in reversed(range(m)):
            for k in range(i + 1, m):
                x[i] = x[i] - lu[k][i] * x[k]
        return jnp.stack(x)


class TriangularFactors(eqx.Module):
    """`A = L U` in one array: `U` on and above the diagonal, below it `L`, whose diagonal is one."""

    lu: Float[Array, "m m"]

    def solve(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        one = jnp.ones(self.lu.shape[0], self.lu.dtype)
        return _substitute_back(self.lu, _substitute(self.lu, b, one), jnp.diagonal(self.lu))

    def solve_transposed(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        one = jnp.ones(self.lu.shape[0], self.lu.dtype)
        return _substitute_back(self.lu.T, _substitute(self.lu.T, b, jnp.diagonal(self.lu)), one)


def eliminate(A: Float[Array, "m m"]) -> tuple[TriangularFactors | WrittenOut, BoolScalar]:
    """Return the factors, and whether every pivot exceeds `rank_threshold` times its diagonal entry.
    Others are replaced by one."""
    return (_write_out if A.shape[0] <= LARGEST_WRITTEN_OUT else _eliminate)(A)


def _write_out(A: Float[Array, "m m"]) -> tuple[WrittenOut, BoolScalar]:
    m, full_rank = A.shape[0], jnp.asarray(True)
    lu = [[A[i, j] for j in range(m)] for i in range(m)]
    for k in range(m):
        accepted = lu[k][k] > rank_threshold(A) * jnp.abs(A[k, k])
        full_rank &= accepted
        lu[k][k] = jnp.where(accepted, lu[k][k], 1)
        for i in range(k + 1, m):
            lu[i][k] = lu[i][k] / lu[k][k]
            for j in range(k + 1, m):
                lu[i][j] = lu[i][j] - lu[i][k] * lu[k][j]
    return WrittenOut(lu), full_rank


def _eliminate(A: Float[Array, "m m"]) -> tuple[TriangularFactors, BoolScalar]:
    rows, smallest = np.arange(A.shape[0]), rank_threshold(A) * jnp.abs(jnp.diagonal(A))

    def column(k: Any, state: tuple[Array, BoolScalar]) -> tuple[Array, BoolScalar]:
        lu, full_rank = state
        accepted = lu[k, k] > smallest[k]
        pivot = jnp.where(accepted, lu[k, k], 1)
        below = rows > k
        factors = jnp.where(below, lu[:, k] / pivot, 0)
        rest = lu - factors[:, None] * jnp.where(below, lu[k], 0)[None, :]
        new = jnp.where(rows == k, pivot, jnp.where(below, factors, lu[:, k]))
        return jnp.where((rows == k)[None, :], new[:, None], rest), full_rank & accepted

    lu, full_rank = _loop(A.shape[0], column, (A, jnp.asarray(True)))
    return TriangularFactors(lu), full_rank


def invert(A: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], BoolScalar]:
    """Return the inverse by Gauss-Jordan elimination, and whether the rank was full, as in `eliminate`."""
    rows, smallest = np.arange(A.shape[0]), rank_threshold(A) * jnp.abs(jnp.diagonal(A))

    def column(k: Any, state: tuple[Array, BoolScalar]) -> tuple[Array, BoolScalar]:
        A, full_rank = state
        accepted = A[k, k] > smallest[k]
        row = jnp.where(rows == k, 1, A[k]) / jnp.where(accepted, A[k, k], 1)
        others = jnp.where((rows == k)[None, :], 0, A) - A[:, k][:, None] * row[None, :]
        return jnp.where((rows == k)[:, None], row[None, :], others), full_rank & accepted

    return _loop(A.shape[0], column, (A, jnp.asarray(True)))


def rank_threshold(A: Float[Array, "m m"]) -> float:
    """Return the size that the pivots of an equilibrated matrix of full rank exceed."""
    return 10 * A.shape[0] * float(jnp.finfo(A.dtype).eps)


def _substitute(
    M: Float[Array, "m m"], b: Float[Array, "m ..."], diagonal: Float[Array, " m"]
) -> Float[Array, "m ..."]:
    """Solve `L x = b`, with `L` the part of `M` below the diagonal and this diagonal."""
    rows = np.arange(M.shape[0])
    return _loop(
        M.shape[0], lambda k, x: _subtracted(x, k, jnp.where(rows > k, M[:, k], 0), diagonal), b
    )


def _substitute_back(
    M: Float[Array, "m m"], b: Float[Array, "m ..."], diagonal: Float[Array, " m"]
) -> Float[Array, "m ..."]:
    """Solve `U x = b`, with `U` the part of `M` above the diagonal and this diagonal."""
    rows, last = np.arange(M.shape[0]), M.shape[0] - 1

    def column(j: Any, x: Array) -> Array:
        k = last - j
        return _subtracted(x, k, jnp.where(rows < k, M[:, k], 0), diagonal)

    return _loop(M.shape[0], column, b)


def _subtracted(
    x: Array, k: Any, column: Float[Array, " m"], diagonal: Float[Array, " m"]
) -> Array:
    """Return `x` with unknown `k` in its place, and its column subtracted from the other equations."""
    along = lambda v: v.reshape(len(v), *(1,) * (x.ndim - 1))
    found = x[k] / diagonal[k]
    is_k = along(np.arange(len(diagonal)) == k)
    return jnp.where(is_k, found[None], x - along(column) * found[None])


def _loop(m: int, body: Callable[[Any, Any], Any], start: Any) -> Any:
    return jax.lax.fori_loop(0, m, body, start)
