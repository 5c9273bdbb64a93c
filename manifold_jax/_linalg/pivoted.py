"""Linear systems with any regular matrix, factored once and solved for several right-hand sides."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar
from .rows import combine


# Rows up to which an elimination is written out entry by entry, for XLA to fuse it with the stages. A
# step of Rodas5P for three (four) numbers then takes 0.2 (0.3) of the time with LAPACK, in batches
# too; for six 1.4 times as long, and it compiles in twice the time. jaxlib 0.10.2.
LARGEST_WRITTEN_OUT = 4


class UnrolledElimination(eqx.Module):
    """`E A = U`, upper triangular, with the inverses of the pivots on the diagonal. No row exchange is
    left for the right-hand sides."""

    U: list[list[FloatScalar]]
    E: Float[Array, "n n"]

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        x = list(combine(b, self.E.T))
        n = len(x)
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                x[i] = x[i] - self.U[i][k] * x[k]
            x[i] = x[i] * self.U[i][i]
        return jnp.stack(x)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        x = list(b)
        for i in range(len(x)):
            for k in range(i):
                x[i] = x[i] - self.U[k][i] * x[k]
            x[i] = x[i] * self.U[i][i]
        return combine(jnp.stack(x), self.E)


class Library(eqx.Module):
    """An LU factorization by LAPACK."""

    lu: tuple[Float[Array, "n n"], Array]

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return jsl.lu_solve(self.lu, b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return jsl.lu_solve(self.lu, b, trans=1)


class PivotedFactorization(eqx.Module):
    """`A^-1` by elimination with row exchanges.

    Where `A` is singular or not finite (`regular` is false) the solution is finite but meaningless:
    its derivative must not be NaN, as the zero cotangent of a rejected step would turn into NaN.
    The derivative is that of `A x = b`, not of the elimination.
    """

    A: Float[Array, "n n"]
    held: UnrolledElimination | Library  # fixed
    regular: BoolScalar

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        A, held = self.A, self.held
        return jax.lax.custom_linear_solve(
            lambda x: combine(x, A.T),
            b,
            lambda _, b: held.solve(b),
            lambda _, b: held.solve_transposed(b),
        )


def factorize_pivoted(
    A: Float[Array, "n n"], largest_written_out: int = LARGEST_WRITTEN_OUT
) -> PivotedFactorization:
    n, eye = A.shape[0], jnp.eye(A.shape[0], dtype=A.dtype)
    held, regular = (_eliminate if n <= largest_written_out else _lapack)(jax.lax.stop_gradient(A))
    return PivotedFactorization(jnp.where(regular, A, eye), held, regular)


def _lapack(A: Float[Array, "n n"]) -> tuple[Library, BoolScalar]:
    lu, pivots = jsl.lu_factor(A)
    regular = jnp.all(jnp.isfinite(lu)) & jnp.all(jnp.diagonal(lu) != 0)
    lu = jnp.where(regular, lu, jnp.eye(A.shape[0], dtype=A.dtype))
    pivots = jnp.where(regular, pivots, jnp.arange(A.shape[0], dtype=pivots.dtype))
    return Library((lu, pivots)), regular


def _eliminate(A: Float[Array, "n n"]) -> tuple[UnrolledElimination, BoolScalar]:
    """The largest entry of a column becomes its pivot by exchanges of two rows each, which need no
    index that is known only while running."""
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)
    rows: list[list[Any]] = [list(A[i]) + list(eye[i]) for i in range(n)]
    regular = jnp.asarray(True)
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            for j in range(k, 2 * n):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = jnp.where(larger, b, a), jnp.where(larger, a, b)
        pivot = rows[k][k]
        accepted = (pivot != 0) & jnp.isfinite(pivot)
        regular &= accepted
        rows[k][k] = 1 / jnp.where(accepted, pivot, 1)
        for i in range(k + 1, n):
            factor = rows[i][k] * rows[k][k]
            for j in range(k + 1, 2 * n):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    # Of a singular matrix that of the identity.
    U = [[jnp.where(regular, rows[i][j], float(i == j)) for j in range(n)] for i in range(n)]
    E = jnp.where(regular, jnp.stack([jnp.stack(row[n:]) for row in rows]), eye)
    return UnrolledElimination(U, E), regular
