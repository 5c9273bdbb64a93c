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
        return jnp.stack(x) if x else b  # without constraints

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
        return jnp.stack(x) if x else b  # without constraints


class TriangularFactors(eqx.Module):
    """`A = L U` in one array: `U` on and above the diagonal, below it `L`, whose diagonal is one."""

    lu: Float[Array, "m m"]

    def solve(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        one = jnp.ones(self.lu.shape[0], self.lu.dtype)
        return _substitute_back(self.lu, _substitute(self.lu, b, one), diagonal_of(self.lu))

    def solve_transposed(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        one = jnp.ones(self.lu.shape[0], self.lu.dtype)
        return _substitute_back(self.lu.T, _substitute(self.lu.T, b, diagonal_of(self.lu)), one)


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
    rows, smallest = _rows(A), rank_threshold(A) * jnp.abs(diagonal_of(A))
    nothing = np.zeros(A.shape[0], A.dtype)

    def column(k: Any, state: tuple[Array, BoolScalar]) -> tuple[Array, BoolScalar]:
        lu, full_rank = state
        row, own, is_k, below = _entry(lu, k), _entry(lu, k, axis=1), rows == k, rows > k
        pivot = _entry(row, k)
        accepted = pivot > _entry(smallest, k)
        pivot = jnp.where(accepted, pivot, 1)
        factors = jnp.where(below, own / pivot, nothing)
        rest = lu - factors[:, None] * jnp.where(below, row, nothing)[None, :]
        new = jnp.where(is_k, pivot, jnp.where(below, factors, own))
        return jnp.where(is_k[None, :], new[:, None], rest), full_rank & accepted

    lu, full_rank = _loop(rows, column, (A, jnp.asarray(True)))
    return TriangularFactors(lu), full_rank


def invert(A: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], BoolScalar]:
    """Return the inverse by Gauss-Jordan elimination, and whether the rank was full, as in `eliminate`."""
    rows, smallest = _rows(A), rank_threshold(A) * jnp.abs(diagonal_of(A))
    one, nothing = np.ones(A.shape[0], A.dtype), np.zeros(A.shape, A.dtype)

    def column(k: Any, state: tuple[Array, BoolScalar]) -> tuple[Array, BoolScalar]:
        A, full_rank = state
        row, is_k = _entry(A, k), rows == k
        pivot = _entry(row, k)
        accepted = pivot > _entry(smallest, k)
        row = jnp.where(is_k, one, row) / jnp.where(accepted, pivot, 1)
        others = jnp.where(is_k[None, :], nothing, A) - _entry(A, k, axis=1)[:, None] * row[None, :]
        return jnp.where(is_k[:, None], row[None, :], others), full_rank & accepted

    return _loop(rows, column, (A, jnp.asarray(True)))


def rank_threshold(A: Float[Array, "m m"]) -> float:
    """Return the size that the pivots of an equilibrated matrix of full rank exceed."""
    return 10 * A.shape[0] * float(jnp.finfo(A.dtype).eps)


def diagonal_of(A: Float[Array, "m m"]) -> Float[Array, " m"]:
    """Return the diagonal of a small matrix in three operations, where `jnp.diagonal` needs fifteen."""
    return jnp.sum(jnp.where(np.eye(A.shape[0], dtype=bool), A, np.zeros(A.shape, A.dtype)), axis=1)


def _substitute(
    M: Float[Array, "m m"], b: Float[Array, "m ..."], diagonal: Float[Array, " m"]
) -> Float[Array, "m ..."]:
    """Solve `L x = b`, with `L` the part of `M` below the diagonal and this diagonal."""
    rows, nothing = _rows(M), np.zeros(M.shape[0], M.dtype)

    def column(k: Any, x: Array) -> Array:
        below = jnp.where(rows > k, _entry(M, k, axis=1), nothing)
        return _subtracted(x, k, rows == k, below, diagonal)

    return _loop(rows, column, b)


def _substitute_back(
    M: Float[Array, "m m"], b: Float[Array, "m ..."], diagonal: Float[Array, " m"]
) -> Float[Array, "m ..."]:
    """Solve `U x = b`, with `U` the part of `M` above the diagonal and this diagonal."""
    rows, nothing = _rows(M), np.zeros(M.shape[0], M.dtype)

    def column(k: Any, x: Array) -> Array:
        above = jnp.where(rows < k, _entry(M, k, axis=1), nothing)
        return _subtracted(x, k, rows == k, above, diagonal)

    return _loop(rows[::-1], column, b)


def _subtracted(
    x: Array, k: Any, is_k: Array, column: Float[Array, " m"], diagonal: Float[Array, " m"]
) -> Array:
    """Return `x` with unknown `k` in its place, and its column subtracted from the other equations."""
    along = lambda v: v.reshape(len(v), *(1,) * (x.ndim - 1))
    found = _entry(x, k) / _entry(diagonal, k)
    return jnp.where(along(is_k), found[None], x - along(column) * found[None])


def _entry(x: Array, k: Any, axis: int = 0) -> Array:
    """Return entry, row or column `k`. (Of `x[k]` six operations would be for negative numbers.)"""
    return jax.lax.dynamic_index_in_dim(x, k, axis, keepdims=False, allow_negative_indices=False)


def _rows(A: Array) -> np.ndarray:
    return np.arange(A.shape[0], dtype=np.int32)


def _loop(rows: np.ndarray, body: Callable[[Any, Any], Any], start: Any) -> Any:
    return jax.lax.scan(lambda state, k: (body(k, state), None), start, rows)[0]
