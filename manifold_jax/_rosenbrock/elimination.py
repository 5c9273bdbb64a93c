"""Linear systems with any regular matrix, factored once and solved for several right-hand sides."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from .._custom_types import BoolScalar, FloatScalar
from .._linear import multiply, UNROLL_LIMIT


Exchange = tuple[int, int, BoolScalar]


class PivotedFactorization(eqx.Module):
    """`P A = L U` with row exchanges: entry by entry for small systems, which XLA fuses, else by
    LAPACK.

    Where `A` is singular or not finite (`regular` is false) the solution is finite but meaningless:
    its derivative must not be NaN, as the zero cotangent of a rejected step would turn into NaN.
    The derivative is that of `A x = b`, not of the elimination.
    """

    A: Float[Array, "n n"]
    lu: Any  # held fixed: rows of numbers, or what LAPACK returned
    exchanges: list[Exchange]
    regular: BoolScalar

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        A, lu, exchanges = self.A, self.lu, self.exchanges
        return jax.lax.custom_linear_solve(
            lambda x: multiply(A, x),
            b,
            lambda _, b: _substitute(lu, exchanges, b),
            lambda _, b: _substitute_transposed(lu, exchanges, b),
        )


def factorize_pivoted(A: Float[Array, "n n"]) -> PivotedFactorization:
    fixed = jax.lax.stop_gradient(A)
    n = A.shape[0]
    if n > UNROLL_LIMIT:
        lu, pivots = jsl.lu_factor(fixed)
        regular = jnp.all(jnp.isfinite(lu)) & jnp.all(jnp.diagonal(lu) != 0)
        eye = jnp.eye(n, dtype=A.dtype)
        lu, pivots = jnp.where(regular, lu, eye), jnp.where(regular, pivots, jnp.arange(n))
        return PivotedFactorization(jnp.where(regular, A, eye), (lu, pivots), [], regular)
    rows = [[fixed[i, j] for j in range(n)] for i in range(n)]
    exchanges, regular = _eliminate(rows)
    # Of a singular matrix, that of the identity.
    rows = [
        [jnp.where(regular, x, float(i == j)) for j, x in enumerate(row)]
        for i, row in enumerate(rows)
    ]
    A = jnp.where(regular, A, jnp.eye(n, dtype=A.dtype))
    return PivotedFactorization(A, rows, exchanges, regular)


def _eliminate(rows: list[list[FloatScalar]]) -> tuple[list[Exchange], BoolScalar]:
    """In place. The largest entry of a column becomes its pivot by exchanges of two rows each,
    which need no index that is known only while running."""
    n = len(rows)
    exchanges, regular = [], jnp.asarray(True)
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            exchanges.append((k, i, larger))
            for j in range(n):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = jnp.where(larger, b, a), jnp.where(larger, a, b)
        regular &= (rows[k][k] != 0) & jnp.isfinite(rows[k][k])
        inverse = 1 / rows[k][k]
        for i in range(k + 1, n):
            rows[i][k] = rows[i][k] * inverse
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - rows[i][k] * rows[k][j]
    return exchanges, regular


def _substitute(lu: Any, exchanges: list[Exchange], b: Float[Array, " n"]) -> Float[Array, " n"]:
    if not isinstance(lu, list):
        return jsl.lu_solve(lu, b)
    n = len(lu)
    x = [b[i] for i in range(n)]
    for k, i, larger in exchanges:
        x[k], x[i] = jnp.where(larger, x[i], x[k]), jnp.where(larger, x[k], x[i])
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - lu[i][k] * x[k]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - lu[i][k] * x[k]
        x[i] = x[i] / lu[i][i]
    return jnp.stack(x)


def _substitute_transposed(
    lu: Any, exchanges: list[Exchange], b: Float[Array, " n"]
) -> Float[Array, " n"]:
    if not isinstance(lu, list):
        return jsl.lu_solve(lu, b, trans=1)
    n = len(lu)
    x = [b[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - lu[k][i] * x[k]
        x[i] = x[i] / lu[i][i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - lu[k][i] * x[k]
    for k, i, larger in reversed(exchanges):
        x[k], x[i] = jnp.where(larger, x[i], x[k]), jnp.where(larger, x[k], x[i])
    return jnp.stack(x)
