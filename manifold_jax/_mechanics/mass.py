"""The mass matrix in its forms: scalar, diagonal, blocks or full matrix."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.shapes import shapes
from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._linalg.dense import Factorization, factorize_positive, gram, is_rounding
from .._linalg.rows import Rows
from .._linalg.sparse import SparseRows


class ConfigurationMass(eqx.Module):
    """The user's `M(q, args)`, or a constant."""

    function: Callable | Any

    def __call__(self, t: RealScalarLike, q: Y, v: Y, args: Args) -> Any:
        return self.function(q, args) if callable(self.function) else self.function


class LagrangianMass(eqx.Module):
    """`M = d^2 L / dv^2`."""

    lagrangian: Callable

    def __call__(self, t: RealScalarLike, q: Y, v: Y, args: Args) -> Float[Array, "n n"]:
        w, unravel = jfu.ravel_pytree(v)
        return jax.hessian(lambda w: self.lagrangian(t, q, unravel(w), args))(w)


class Mass(eqx.Module):
    """A factored mass matrix.

    - `diagonal`: scalar or `(n,)`; `None` for a matrix.
    - `factorization`: of the matrix plus `C^T D C`; for blocks, one each.
    - `augmentation`: the diagonal of `D`, shape `(m,)`, or `None` for a diagonal.
    - `symmetric`, `positive`: whether the matrix can be used.
    """

    diagonal: Float[Array, "*n"] | None
    factorization: Factorization | None
    augmentation: Float[Array, " m"] | None
    symmetric: BoolScalar
    positive: BoolScalar

    @property
    def valid(self) -> BoolScalar:
        return self.symmetric & self.positive

    def solve(self, rows: Float[Array, "*k n"]) -> Float[Array, "*k n"]:
        """Apply `M^-1` to each row."""
        if self.factorization is None:
            return rows / jnp.broadcast_to(self.diagonal, rows.shape)  # pyright: ignore[reportArgumentType]
        if self.factorization.usable.ndim == 0:
            return self.factorization.solve(rows.T).T
        number, size = self.factorization.A.shape[:2]
        parts = jnp.moveaxis(rows.reshape(*rows.shape[:-1], number, size), -2, 0)
        solved = jax.vmap(lambda block, r: block.solve(r.T).T)(self.factorization, parts)
        return jnp.moveaxis(solved, 0, -2).reshape(rows.shape)


class InvertedBlocks(eqx.Module):
    """A nonsingular mass matrix of blocks with known inverses, in the place of the matrix."""

    matrix: Float[Array, "b d d"]
    inverse: Float[Array, "b d d"]
    symmetric: BoolScalar
    positive: BoolScalar
    augmentation: ClassVar[None] = None

    @property
    def shape(self) -> tuple[int, ...]:
        return self.inverse.shape

    @property
    def valid(self) -> BoolScalar:
        return self.symmetric & self.positive

    def solve(self, rows: Float[Array, "*k n"]) -> Float[Array, "*k n"]:
        """Apply `M^-1` to each row."""
        number, size, _ = self.shape
        parts = rows.reshape(*rows.shape[:-1], number, 1, size)
        inverse = self.inverse.reshape(*(1,) * (rows.ndim - 1), number, size, size)
        return jnp.sum(inverse * parts, axis=-1).reshape(rows.shape)


def mass_values(mass_matrix: Any, q: Y) -> Float[Array, "..."] | InvertedBlocks:
    """Return the result of `mass_matrix` as a scalar, a diagonal `(n,)`, a matrix `(n, n)` or its
    blocks `(n / d, d, d)`."""
    if isinstance(mass_matrix, InvertedBlocks):
        return mass_matrix
    x, _ = jfu.ravel_pytree(q)
    n = x.size
    shape = jnp.shape(mass_matrix) if eqx.is_array_like(mass_matrix) else None
    if shape is not None and (shape in ((), (n,), (n, n)) or _is_blocks(shape, n)):
        return jnp.asarray(mass_matrix, x.dtype)
    # Others are not broadcast: for masses of shape (2,) and q of shape (2, 2) it is unknown whether
    # they belong to two bodies or to two coordinates.
    if jtu.tree_structure(mass_matrix) == jtu.tree_structure(q):
        pairs = zip(jtu.tree_leaves(mass_matrix), jtu.tree_leaves(q), strict=True)
        if all(jnp.shape(M) in ((), jnp.shape(leaf)) for M, leaf in pairs):
            spread = lambda M, leaf: jnp.broadcast_to(jnp.asarray(M, leaf.dtype), leaf.shape)
            return jfu.ravel_pytree(jtu.tree_map(spread, mass_matrix, q))[0]
    raise ValueError(
        f"`mass_matrix` must be a scalar, a diagonal of shape ({n},) or of the shapes of q, a matrix of shape ({n}, "
        f"{n}), or the blocks on its diagonal, of shape (bodies, d, d), for q of {n} numbers of "
        f"shapes {shapes(q)}, got {shapes(mass_matrix)}. Masses of points whose "
        "positions are the rows of q: `jnp.broadcast_to(masses[:, None], q.shape)`."
    )


def factorize_mass(M: Float[Array, "..."] | InvertedBlocks, C: Rows) -> Mass | InvertedBlocks:
    """Factor `M`, in one of the forms of `mass_values`, under constraints `C a = b`.

    A singular matrix is allowed if it is positive definite on the null space of `C`, that is, if the
    matrix `[[M, C^T], [C, 0]]` is nonsingular: then `M + C^T D C` is positive definite for every
    `D > 0` and has the same accelerations (augmented Lagrangian; Benzi, Golub & Liesen, Acta Numerica
    14 (2005) 1-137, section 5). It is used for nonsingular ones, too: to distinguish them would take
    two factorizations in every program.
    """
    if isinstance(M, InvertedBlocks):
        return M
    yes = jnp.asarray(True)
    if M.ndim < 2:
        positive = jnp.all(M > 0)
        return Mass(jnp.where(positive, M, 1), None, None, yes, positive)
    if M.ndim == 3:
        return _factorize_blocks(M, C)
    symmetric, weights = _is_symmetric(M), jax.lax.stop_gradient(_weights(M, C))
    factorization = factorize_positive(M + gram((C * weights[:, None]).T, C.T))
    return Mass(None, factorization, weights, symmetric, factorization.usable)


def _is_symmetric(M: Float[Array, "*b n n"]) -> BoolScalar:
    asymmetry = jnp.max(jnp.abs(M - jnp.swapaxes(M, -1, -2)))
    return asymmetry <= 100 * jnp.finfo(M.dtype).eps * jnp.max(jnp.abs(M))


def _is_blocks(shape: tuple[int, ...], n: int) -> bool:
    return len(shape) == 3 and shape[1] == shape[2] and shape[0] * shape[1] == n


def _factorize_blocks(M: Float[Array, "b d d"], C: Rows) -> Mass | InvertedBlocks:
    """Factor each of the blocks, under the constraints on its coordinates alone (the unit length of a
    quaternion): a block may be singular in the directions that those exclude."""
    if not isinstance(C, SparseRows):
        return factorize_mass(jax.scipy.linalg.block_diag(*M), C)
    symmetric, augmentation = _is_symmetric(M), jnp.zeros((C.structure.num_equations,), M.dtype)
    if C.structure.local.any():
        M, augmentation = _augmented(M, C)
    factorization = jax.vmap(factorize_positive)(M)
    return Mass(None, factorization, augmentation, symmetric, jnp.all(factorization.usable))


def _augmented(
    M: Float[Array, "b d d"], C: SparseRows
) -> tuple[Float[Array, "b d d"], Float[Array, " m"]]:
    """Return `M + C^T D C` with the diagonal `D` of `_weights` for local constraints, zero for others."""
    number, size, _ = M.shape
    masses = jax.vmap(_masses)(M).reshape(-1)
    seeds = jnp.tile(jnp.eye(size, dtype=M.dtype), (1, number))  # one coordinate of all blocks
    local = jnp.asarray(C.structure.local)[None, :]
    entries = jnp.where(local, jax.vmap(C.multiply)(seeds), 0)
    lighter = jax.vmap(C.multiply)(seeds / jax.lax.stop_gradient(masses)[None, :])
    lengths = jax.lax.stop_gradient(jnp.sum(entries * lighter, axis=0))
    tiny = jnp.finfo(M.dtype).tiny
    weights = jnp.where(local[0], 1 / jnp.maximum(lengths, tiny), 0)
    columns = jax.vmap(C.combine)(weights[None, :] * entries)
    return M + jnp.moveaxis(columns.reshape(size, number, size), 0, 2), weights


def _weights(M: Float[Array, "n n"], C: Float[Array, "m n"]) -> Float[Array, " m"]:
    """Return the diagonal of `D`, `1 / (C diag(M)^-1 C^T)_ii`: then no entry of `C_i^T D_i C_i` exceeds
    `sqrt(M_jj M_kk)`, and light bodies keep their digits beside heavy ones. Diagonal entries that are
    zero to rounding count as the mean. Zero for rows that are rounding: of redundant equations these are
    not solved, and `C_i^T D_i C_i` would be as large as masses."""
    size = jnp.sum(C * C / _masses(M)[None, :], axis=1)
    none = is_rounding(jnp.sqrt(size))
    return jnp.where(none, 0, 1 / jnp.where(none, 1, size))


def _masses(M: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Return the diagonal, with the mean in the place of zeros."""
    diagonal = jnp.diagonal(M)
    mean, eps = jnp.mean(jnp.abs(diagonal)), jnp.finfo(M.dtype).eps
    return jnp.where(diagonal > 10 * eps * mean, diagonal, mean)
