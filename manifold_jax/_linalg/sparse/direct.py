"""Direct solution of sparse systems with any nonsingular matrix."""

from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._base.klu import klujax
from ..._base.types import BoolScalar
from ..dense import Factorization
from .elimination import Blocks, eliminate
from .factorization import solve_in_blocks
from .square import constant, multiply_sparse, permutation, SparseMatrix, SquarePattern


Method: TypeAlias = Literal["blocks", "klu"]


def factorize_sparse(A: SparseMatrix, method: Method) -> Factorization:
    """Factor a matrix; one that is singular or not finite becomes another one.

    It is usable if a system with a known solution is solved to some digits.
    """
    fixed, regular = jax.lax.stop_gradient(A), permutation(A.pattern, A.entries.dtype)
    possible = jnp.all(jnp.isfinite(fixed.entries)) & ~fixed.has_empty_lines()
    fixed = _where(possible, fixed, regular)
    factors = BlockElimination.of(fixed) if method == "blocks" else KLU.of(fixed)
    usable = possible & _is_right(fixed, factors)
    A = _where(usable, A, regular)
    return Factorization(A, Checked(factors, usable), usable, multiply_sparse)


class Checked(eqx.Module):
    """Factors where they are usable, else those of the identity."""

    factors: Any
    usable: BoolScalar

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(self.usable, self.factors.solve(b), b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(self.usable, self.factors.solve_transposed(b), b)


def _where(condition: BoolScalar, A: SparseMatrix, B: SparseMatrix) -> SparseMatrix:
    return SparseMatrix(jnp.where(condition, A.entries, B.entries), A.pattern)


def _is_right(A: SparseMatrix, factors: Any) -> BoolScalar:
    """Solve a system with a known solution, scaled to be independent of the units of the unknowns."""
    columns = constant(A.pattern.columns)
    size = jax.ops.segment_max(jnp.abs(A.entries), columns, A.pattern.size)
    mixed = jnp.arange(size.size, dtype=jnp.uint32) * jnp.uint32(2654435769)
    known = jnp.where(mixed >> 31 == 0, 1, -1).astype(size.dtype)  # signs without a pattern
    solution = factors.solve(A.multiply(known / size))
    error = jnp.max(jnp.abs(solution * size - known))
    # Without full rank the error is as large as the solution.
    return error <= float(jnp.finfo(size.dtype).eps) ** (1 / 4)


class KLU(eqx.Module):
    """Elimination with exchanges of rows by SuiteSparse's KLU, once for every right-hand side: a handle
    of factors could not be released inside of a compiled program.

    KLU accepts pivots of a thousandth of the largest entry, and with entries that are zero it does so
    often, so that the errors of long chains may grow beyond all limits. The known solution of
    [`factorize_sparse`][] finds that, and transposed systems, which are another elimination, are
    checked by their residual: NaN instead of a wrong solution.
    """

    A: SparseMatrix

    @staticmethod
    def of(A: SparseMatrix) -> "KLU":
        """KLU raises where a pivot is exactly zero. Relative changes of a few units of rounding, and tiny numbers
        in the places of zeros, make it a small number, which the known solution finds."""
        random, eps = np.random.default_rng(0), float(jnp.finfo(A.entries.dtype).eps)
        changes = 1 + eps * random.integers(-8, 9, A.pattern.num_entries)
        tiny = eps**2 * random.uniform(1, 2, A.pattern.num_entries)
        largest = jnp.max(jnp.abs(A.entries))
        entries = jnp.where(A.entries == 0, largest * constant(tiny), A.entries * constant(changes))
        return KLU(SparseMatrix(entries, A.pattern))

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        pattern = self.A.pattern
        return klujax().solve(pattern.rows, pattern.columns, self.A.entries, b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        pattern = self.A.pattern
        x = klujax().solve(pattern.columns, pattern.rows, self.A.entries, b)
        error = jnp.max(jnp.abs(self.A.multiply_transposed(x) - b))
        size = jnp.max(jnp.abs(self.A.entries)) * jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(b))
        tolerance = float(jnp.finfo(b.dtype).eps) ** (1 / 2)
        return jnp.where(error <= tolerance * size, x, jnp.nan)


class BlockElimination(eqx.Module):
    """Elimination of the blocks of a block tridiagonal matrix, without exchanges of rows between blocks,
    and one step of iterative refinement."""

    A: SparseMatrix
    blocks: Blocks
    eliminated: Any

    @staticmethod
    def of(A: SparseMatrix) -> "BlockElimination":
        blocks = _blocks(A)
        return BlockElimination(A, blocks, eliminate(blocks))

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return _refined(self.A.multiply, self.A.pattern, self.eliminated, b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        eliminated = eliminate(self.blocks.transposed())
        return _refined(self.A.multiply_transposed, self.A.pattern, eliminated, b)


def _refined(multiply: Any, pattern: SquarePattern, eliminated: Any, b: Array) -> Array:
    x = solve_in_blocks(pattern.block_order, eliminated, b)
    if pattern.block_order.width == 1:  # with exchanges of rows
        return x
    return x + solve_in_blocks(pattern.block_order, eliminated, b - multiply(x))


def _blocks(A: SparseMatrix) -> Blocks:
    """Return the blocks, with ones on the diagonal of rows that complete the last ones."""
    order = A.pattern.block_order
    number, width, places = order.num_blocks, order.width, order.own_places
    i, j = places[A.pattern.rows], places[A.pattern.columns]
    entries = jnp.zeros((number, 3, width, width), A.entries.dtype)
    at = i // width, 1 + j // width - i // width, i % width, j % width
    entries = entries.at[tuple(map(constant, at))].set(A.entries)
    padded = order.size + np.arange(order.num_padded)
    at = padded // width, np.ones_like(padded), padded % width, padded % width
    entries = entries.at[tuple(map(constant, at))].set(1)
    return Blocks(entries[:, 0], entries[:, 1], entries[:, 2])
