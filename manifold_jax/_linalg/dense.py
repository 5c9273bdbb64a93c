"""Small dense linear systems as arithmetic that XLA can fuse.

A LAPACK or cuSOLVER call per step costs more than a whole Runge-Kutta step of a small
mechanism and cannot be fused across a batch. Up to `UNROLL_LIMIT` rows the elimination
is therefore written out entry by entry; beyond that the library routine is used.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact

from .._base.derivative_rule import ForwardRule
from .._base.types import BoolScalar, FloatScalar
from . import lapack
from .elimination import diagonal_of, eliminate, invert, rank_threshold


# Number of operations grows like m^3 / 3: 170 at m = 8, still less than one library call.
UNROLL_LIMIT = 8


class Factorization(eqx.Module):
    """A square matrix, the factors with which its systems are solved, and whether they are usable.

    Where they are not, the solution is finite but meaningless: its derivative must not be NaN, as
    the zero cotangent of a rejected step would turn into NaN, too.

    The derivative is that of `A x = b`, not of the elimination: five times less to compile.
    """

    A: Any  # an array, or what `product` multiplies
    factors: Any  # with `solve` and `solve_transposed`; held fixed
    usable: BoolScalar  # full rank
    product: Callable = eqx.field(static=True)  # multiplies `A` by a solution

    def solve(self, b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
        return jax.lax.custom_linear_solve(
            lambda x: self.product(self.A, x),
            b,
            lambda _, b: self.factors.solve(b),
            lambda _, b: self.factors.solve_transposed(b),
        )


class Library(eqx.Module):
    """`A = L U` with row exchanges, by LAPACK or cuSOLVER."""

    lu: tuple[Inexact[Array, "m m"], Array]

    @staticmethod
    def where(usable: BoolScalar, lu: Inexact[Array, "m m"], permutation: Array) -> "Library":
        """Return these factors, or those of the identity."""
        unchanged = np.arange(lu.shape[0], dtype=permutation.dtype)
        return Library((_or_identity(lu, usable), jnp.where(usable, permutation, unchanged)))

    def solve(self, b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
        return lapack.lu_solve(*self.lu, b)

    def solve_transposed(self, b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
        return lapack.lu_solve_transposed(*self.lu, b)


class Cholesky(eqx.Module):
    """`A = L L^T` by LAPACK or cuSOLVER."""

    lower: Float[Array, "m m"]

    def solve(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        return lapack.cholesky_solve(self.lower, b)

    def solve_transposed(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        return self.solve(b)


class Equilibrated(eqx.Module):
    """The factors of `A` after multiplying its rows and columns by these numbers."""

    rows: Float[Array, " m"]
    columns: Float[Array, " m"]
    factors: Any  # with `solve` and `solve_transposed`

    def solve(self, b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
        return _scaled(self.columns, self.factors.solve(_scaled(self.rows, b)))

    def solve_transposed(self, b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
        return _scaled(self.rows, self.factors.solve_transposed(_scaled(self.columns, b)))


def _scaled(size: Float[Array, " m"], b: Inexact[Array, "m ..."]) -> Inexact[Array, "m ..."]:
    return size.reshape(-1, *(1,) * (b.ndim - 1)) * b


class Inverse(eqx.Module):
    """The inverse of a matrix, or its pseudo-inverse."""

    inverse: Float[Array, "m m"]
    usable: BoolScalar  # full rank; of a pseudo-inverse, which does not need it, finite
    product: Callable = eqx.field(static=True)

    def solve(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        return self.product(self.inverse, b)


# Number of rows from which on the inverse is faster.
_SMALLEST_INVERSE = 3


def factorize_once(A: Float[Array, "m m"]) -> "Factorization | Inverse":
    """Factor a matrix that is used once in a step or in a solve.

    Small ones by Gauss-Jordan elimination without pivoting, on the whole matrix as one array: fewer and
    larger operations than those of [`factorize`][], which compile faster. At stages `factorize` runs
    faster.
    """
    if not _SMALLEST_INVERSE <= A.shape[0] <= UNROLL_LIMIT:
        return factorize(A)
    return Inverse(*_invert(A), _product)


_invert = jax.custom_jvp(invert)


@_invert.defjvp  # pyright: ignore[reportArgumentType]
def _invert_jvp(primals, tangents):
    (A,), (A_dot,) = primals, tangents
    X, full_rank = _invert(A)
    no_tangent = np.zeros((), jax.dtypes.float0)
    return (X, full_rank), (-_product(_product(X, A_dot), X), no_tangent)


def _product(A: Float[Array, "i j"], B: Float[Array, "j ..."]) -> Float[Array, "i ..."]:
    """Return `A B`; small products as sums that fuse, as batched tiny `dot`s are slow."""
    if A.shape[0] > UNROLL_LIMIT:
        return jnp.tensordot(A, B, axes=1)
    return jnp.sum(A.reshape(*A.shape, *(1,) * (B.ndim - 1)) * B[None], axis=1)


def factorize(A: Float[Array, "m m"]) -> Factorization:
    """Factor a nonsingular matrix.

    Small ones without pivoting: the matrices met here are `G V` with `V` close to `W^-1 G^T`, or mass
    matrices, hence close to symmetric positive definite.

    The rank counts as full if every pivot exceeds `10 m eps` times its diagonal entry: for a Gram
    matrix `A = G W^-1 G^T` that ratio is the squared sine of the angle between one row of `G` and the
    span of those before it, and rounding leaves about `eps` of it.
    """
    if A.shape[0] > UNROLL_LIMIT:
        return _by_library(A, _by_lu)
    return Factorization(A, *eliminate(jax.lax.stop_gradient(A)), _product)


# Redundant equations depend on each other only nearly at a stage off the manifold: eigenvalues of `A`
# below this fraction of the largest count as zero.
DEPENDENCE_THRESHOLD = 1e-4


def pseudo_invert(A: Float[Array, "m m"], dependent: Any = DEPENDENCE_THRESHOLD) -> Inverse:
    """Return the pseudo-inverse of a symmetric positive semidefinite matrix whose diagonal is scaled to
    one, so that the units of equations do not decide which of them depend on others. For redundant
    equations `solve` gives the solution of least norm, with each unknown multiplied by the square root
    of its diagonal entry. Eigenvalues below `dependent` times the largest count as zero. Usable if the
    matrix is finite, whatever its rank."""
    finite = jnp.all(jnp.isfinite(A))
    A = jnp.where(finite, A, jnp.eye(A.shape[0], dtype=A.dtype))
    fixed = jax.lax.stop_gradient(A)
    size = jnp.where(is_rounding(jnp.sqrt(jnp.abs(diagonal_of(fixed)))), 0, _size(fixed))
    scale = size[:, None] * size[None, :]
    dependent = jax.lax.stop_gradient(jnp.asarray(dependent, A.dtype))
    return Inverse(scale * _pseudo_inverse(scale * A, dependent), finite, jnp.matmul)


def is_rounding(sizes: Float[Array, " m"]) -> Bool[Array, " m"]:
    """Whether sizes of gradients are rounding beside the largest: those of redundant equations that hold identically,
    such as the diagonal of `S^T J S = J`."""
    return sizes <= 16 * jnp.finfo(sizes.dtype).eps * jnp.max(sizes, initial=0)


@ForwardRule
def _pseudo_inverse(A: Float[Array, "m m"], dependent: FloatScalar) -> Float[Array, "m m"]:
    """Return the pseudo-inverse of a symmetric matrix. (The derivative of `jnp.linalg.pinv` cannot be
    differentiated again if `rtol` is an array.)"""
    values, V = lapack.eigh(A)
    used = jnp.abs(values) > dependent * jnp.max(jnp.abs(values), initial=0)
    return (V * jnp.where(used, 1 / jnp.where(used, values, 1), 0)[None, :]) @ V.T


@_pseudo_inverse.define_jvp
def _pseudo_inverse_jvp(P, primals, tangents):
    """Differentiate at constant rank (Golub & Pereyra 1973)."""
    (A, _), (A_dot, _) = primals, tangents
    one = jnp.eye(A.shape[0], dtype=A.dtype)
    turned = P @ P @ A_dot.T @ (one - A @ P)
    return turned + turned.T - P @ A_dot @ P


def factorize_positive(A: Float[Array, "m m"]) -> Factorization:
    """Factor a symmetric matrix; its rank counts as full if it is positive definite."""
    if A.shape[0] <= UNROLL_LIMIT:
        return factorize(A)  # requires positive pivots, too
    return _by_library(A, _by_cholesky)


def _by_lu(A: Float[Array, "m m"]) -> tuple[Equilibrated, BoolScalar]:
    size = _size(A)
    lu, permutation = lapack.lu_factor(_scaled(size, A) * size[None, :])
    pivots = jnp.abs(diagonal_of(lu))
    full_rank = jnp.all((pivots > rank_threshold(A)) & (pivots < jnp.inf))
    return Equilibrated(size, size, Library.where(full_rank, lu, permutation)), full_rank


def _by_cholesky(A: Float[Array, "m m"]) -> tuple[Equilibrated, BoolScalar]:
    size = _size(A)
    lower = lapack.cholesky(_scaled(size, A) * size[None, :])
    pivots = diagonal_of(lower) ** 2  # NaN unless positive definite
    positive = jnp.all((pivots > rank_threshold(A)) & (pivots < jnp.inf))
    return Equilibrated(size, size, Cholesky(_or_identity(lower, positive))), positive


def _size(A: Float[Array, "m m"]) -> Float[Array, " m"]:
    """Return the numbers by which rows and columns are multiplied for a diagonal of ones; finite whatever the
    matrix is."""
    entries = jnp.abs(diagonal_of(A))
    usable = (entries > 0) & (entries < jnp.inf)
    return jnp.where(usable, 1 / jnp.sqrt(jnp.where(usable, entries, 1)), 1)


def _or_identity(A: Inexact[Array, "m m"], usable: BoolScalar) -> Inexact[Array, "m m"]:
    return jnp.where(usable, A, np.eye(A.shape[0], dtype=A.dtype))


def _by_library(A: Float[Array, "m m"], factor: Callable) -> Factorization:
    factors, usable = factor(jax.lax.stop_gradient(A))
    return Factorization(_or_identity(A, usable), factors, usable, _product)


def gram(A: Float[Array, "i n"], B: Float[Array, "k n"]) -> Float[Array, "i k"]:
    """Return `A B^T`; small products as sums that fuse, as batched tiny `dot`s are slow."""
    if max(A.shape[0], B.shape[0]) > UNROLL_LIMIT:
        return A @ B.T
    return jnp.sum(A[:, None, :] * B[None, :, :], axis=2)


def gram_written_out(A: Float[Array, "i n"], B: Float[Array, "k n"]) -> Float[Array, "i k"]:
    """Return `A B^T` for use at every stage: takes longer to compile, but has no reductions, for which
    XLA calls a library if the batch is large, and which then do not fuse."""
    if max(*A.shape, B.shape[0]) > UNROLL_LIMIT:
        return gram(A, B)
    return sum(A[:, None, j] * B[None, :, j] for j in range(A.shape[1]))  # pyright: ignore[reportReturnType]
