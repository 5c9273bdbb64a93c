"""Linear systems with any nonsingular matrix, factored once and solved for several right-hand sides."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from .._base.types import BoolScalar, FloatScalar
from . import lapack
from .dense import Equilibrated, Factorization, Library, rank_threshold, UNROLL_LIMIT
from .rows import combine, multiply


# Largest number of rows for which an elimination is written out entry by entry, so that XLA fuses it
# with the stages. A step of Rodas5P for three (four) unknowns then takes 0.2 (0.3) of the time with
# LAPACK, in batches too; for six 1.4 times as long, and it compiles in twice the time. jaxlib 0.10.2.
LARGEST_WRITTEN_OUT = 4

# Largest number of columns for which the loop of `reduction` is unrolled.
_UNROLLED_COLUMNS = 4


class UnrolledElimination(eqx.Module):
    """`E A = U`, upper triangular, with inverse pivots on its diagonal. `E` has the row exchanges."""

    U: list[list[Inexact[Array, ""]]]
    E: Inexact[Array, "n n"]

    def solve(self, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        x = list(combine(b, self.E.T))
        n = len(x)
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                x[i] = x[i] - self.U[i][k] * x[k]
            x[i] = x[i] * self.U[i][i]
        return jnp.stack(x)

    def solve_transposed(self, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        x = list(b)
        for i in range(len(x)):
            for k in range(i):
                x[i] = x[i] - self.U[k][i] * x[k]
            x[i] = x[i] * self.U[i][i]
        return combine(jnp.stack(x), self.E)


def factorize_pivoted(
    A: Inexact[Array, "n n"], largest_written_out: int = LARGEST_WRITTEN_OUT
) -> Factorization:
    """Factor any matrix, also a complex one, with row exchanges; one that is singular or not finite
    becomes the identity."""
    fixed, eye = jax.lax.stop_gradient(A), jnp.eye(A.shape[0], dtype=A.dtype)
    factors, nonsingular = (_eliminate if A.shape[0] <= largest_written_out else _lapack)(fixed)
    return Factorization(jnp.where(nonsingular, A, eye), factors, nonsingular, multiply)


def _lapack(A: Inexact[Array, "n n"]) -> tuple[Library, BoolScalar]:
    lu, permutation = lapack.lu_factor(A)
    nonsingular = jnp.all(jnp.isfinite(lu)) & jnp.all(jnp.diagonal(lu) != 0)
    return Library.where(nonsingular, lu, permutation), nonsingular


def _eliminate(A: Inexact[Array, "n n"]) -> tuple[UnrolledElimination, BoolScalar]:
    """Eliminate with partial pivoting. The largest entry of a column is brought to the pivot by
    comparing and exchanging pairs of rows, without indices that are known only at run time."""
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)
    rows: list[list[Any]] = [list(A[i]) + list(eye[i]) for i in range(n)]
    nonsingular = jnp.asarray(True)
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            for j in range(k, 2 * n):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = jnp.where(larger, b, a), jnp.where(larger, a, b)
        pivot = rows[k][k]
        accepted = (pivot != 0) & jnp.isfinite(pivot)
        nonsingular &= accepted
        rows[k][k] = 1 / jnp.where(accepted, pivot, 1)
        for i in range(k + 1, n):
            factor = rows[i][k] * rows[k][k]
            for j in range(k + 1, 2 * n):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    # A singular matrix is replaced by the identity.
    U = [[jnp.where(nonsingular, rows[i][j], float(i == j)) for j in range(n)] for i in range(n)]
    E = jnp.where(nonsingular, jnp.stack([jnp.stack(row[n:]) for row in rows]), eye)
    return UnrolledElimination(U, E), nonsingular


class InverseFactor(eqx.Module):
    """The inverse `A^-1`."""

    inverse: Float[Array, "n n"]
    product: Callable = eqx.field(static=True)

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.product(self.inverse, b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.product(self.inverse.T, b)


def factorize_equilibrated(A: Float[Array, "n n"]) -> Factorization:
    """Factor any matrix with row exchanges, whatever the units of equations and unknowns. Solutions
    need not be finite if the rank is not full."""
    fixed, threshold = jax.lax.stop_gradient(A), rank_threshold(A)
    one = lambda size: jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    rows = one(jnp.max(jnp.abs(fixed), axis=1))
    columns = one(jnp.max(jnp.abs(fixed) * rows[:, None], axis=0))
    scaled = fixed * rows[:, None] * columns[None, :]
    if A.shape[0] <= UNROLL_LIMIT:
        factors = InverseFactor(reduction(scaled)[0], multiply)
        full_rank = jnp.max(jnp.abs(factors.inverse)) * threshold < 1  # false for NaN
    else:
        factors = Library(lapack.lu_factor(scaled))
        full_rank = jnp.all(jnp.abs(jnp.diagonal(factors.lu[0])) > threshold)
    return Factorization(A, Equilibrated(rows, columns, factors), full_rank, multiply)


def factorize_by_reduction(A: Float[Array, "n n"]) -> Factorization:
    """Factor any matrix with row exchanges, without LAPACK. The result is not finite if it is singular."""
    E, _ = reduction(jax.lax.stop_gradient(A))
    return Factorization(A, InverseFactor(E, jnp.matmul), jnp.all(jnp.isfinite(E)), jnp.matmul)


def reduction(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], FloatScalar]:
    """Return `E` with `E A = 1` (or `[1; 0]` if `k < n`) and the sign of `det E`, by Gauss-Jordan
    elimination with row exchanges. The result is not finite if the columns of `A` are dependent."""
    n, k = A.shape
    rows = jnp.arange(n)

    def column(j, state):
        M, sign = state
        p = jnp.argmax(jnp.where(rows >= j, jnp.abs(M[:, j]), -1))
        sign = sign * jnp.sign(M[p, j]) * jnp.where(p == j, 1, -1)
        pivot_row = M[p] / M[p, j]
        M = jnp.where((rows == p)[:, None], M[j][None], M)
        M = jnp.where((rows == j)[:, None], pivot_row[None], M - jnp.outer(M[:, j], pivot_row))
        return M, sign

    start = jnp.concatenate([A, jnp.eye(n, dtype=A.dtype)], axis=1), jnp.ones((), A.dtype)
    M, sign = jax.lax.fori_loop(0, k, column, start, unroll=k <= _UNROLLED_COLUMNS)
    return M[:, k:], sign
