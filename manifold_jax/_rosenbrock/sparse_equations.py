r"""The linearized equations `M y' = f` with sparse matrices.

The rows of `M` of algebraic equations have to be zero. Then `P` of [`MassMatrixEquations`][] selects
these rows, and $P\, \partial_y (M \hat z) = 0$.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._linalg.sparse import factorize_sparse, SparseMatrix, Sparsity
from .linearized import LinearizedEquations, relative_residual


def linearize_sparse(
    field: Callable[[RealScalarLike, Float[Array, " n"]], Float[Array, " n"]],
    mass: Float[Array, "..."],
    sparsity: Sparsity,
    t: RealScalarLike,
    x: Float[Array, " n"],
) -> LinearizedEquations:
    """Linearize at one time and state. Not finite where the index is above 1, or where combinations of
    rows of the mass vanish and not rows themselves."""
    pattern, method = sparsity
    f, M = field(t, x), SparseMatrix.of_mass(mass, pattern)
    t = jnp.asarray(t, jnp.result_type(float, t))
    column = jax.linearize(lambda x: field(t, x), x)[1]
    ft = jax.jvp(lambda t: field(t, x), (t,), (jnp.ones_like(t),))[1]
    size = jax.lax.stop_gradient(M.over_rows(jax.ops.segment_max, jnp.abs(M.entries)))
    P = (size == 0).astype(x.dtype)
    D = 1 / jnp.where(size > 0, size, 1)
    K = SparseMatrix.of_columns(column, pattern, x.dtype).scaled_rows(P)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(K.entries), initial=0.0))
    s = jnp.where(largest > 0, 1 / jnp.where(largest > 0, largest, 1), 1)
    factor = factorize_sparse(M.scaled_rows(D) + K.scaled_rows(s * P), method)
    finite = [jnp.all(jnp.isfinite(v)) for v in (f, M.entries, K.entries, P * ft)]
    finite = functools.reduce(jnp.logical_and, finite)
    nonsingular = finite & factor.usable
    nan = jnp.where(nonsingular, 0.0, jnp.nan).astype(x.dtype)
    r, K = P * f, jax.lax.stop_gradient(K)
    reach = jax.lax.stop_gradient(jnp.abs(x) + 1)
    reach = SparseMatrix(jnp.abs(K.entries), pattern).multiply(reach)
    return LinearizedEquations(
        factor.solve((1 - P) * D * f - s * P * ft) + nan,
        -factor.solve(s * r) + nan,
        lambda change: factor.solve(M.scaled_rows(D).multiply(change)),
        relative_residual(jax.lax.stop_gradient(r), reach) + nan,
        finite,
        nonsingular,
    )
