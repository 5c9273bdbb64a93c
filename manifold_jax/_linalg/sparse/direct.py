"""Direct solution of sparse systems with any nonsingular matrix."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._base.klu import klujax
from ..._base.types import BoolScalar, FloatScalar
from ..dense import Factorization
from .condensation import Condensation, Condensed
from .elimination import Blocks, eliminate
from .factorization import solve_in_blocks
from .multi_elimination import MultiElimination
from .square import constant, multiply_sparse, permutation, SparseMatrix, SquarePattern


Method: TypeAlias = Literal["tridiagonal", "multi-elimination", "klu", "either"]


def factorize_sparse(A: SparseMatrix, method: Method) -> Factorization:
    """Factor a matrix; one that is singular or not finite becomes another one.

    It is usable if a system with a known solution is solved to some digits. Where these are not many, solutions
    of the elimination without exchanges of rows are refined.
    """
    fixed, regular = jax.lax.stop_gradient(A), permutation(A.pattern, A.entries.dtype)
    possible = jnp.all(jnp.isfinite(fixed.entries)) & ~fixed.has_empty_lines()
    fixed = _where(possible, fixed, regular)
    factors, error = _factored(fixed, method)
    usable = possible & (error <= _tolerance(fixed))
    A = _where(usable, A, regular)
    return Factorization(A, Checked(factors, usable), usable, multiply_sparse)


def _factored(A: SparseMatrix, method: Method) -> tuple[Any, FloatScalar]:
    """Return factors and the error of the known solution."""
    if method == "tridiagonal":
        factors = TridiagonalElimination.of(A)
        return factors, _error(A, factors)
    if method == "klu":
        factors = _condensed(A)
        if isinstance(factors, KLU):
            return factors, _error(A, factors)
        error = _error(A, factors)
    else:
        factors = MultiElimination.of(A)
        error, few = _error(A, factors), float(jnp.finfo(A.entries.dtype).eps) ** (2 / 3)
        factors = dataclasses.replace(factors, num_solves=jnp.where(error <= few, 1, 2))
    if method == "multi-elimination":
        return factors, error
    first, second = error <= _tolerance(A), KLU.of(A)
    of_second = lambda entries: _error(SparseMatrix(entries, A.pattern), second)
    return Either(factors, second, first), _unless(first, of_second, A.entries, error)


def _tolerance(A: SparseMatrix) -> float:
    return float(jnp.finfo(A.entries.dtype).eps) ** (1 / 4)


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


def _error(A: SparseMatrix, factors: Any) -> FloatScalar:
    """Solve a system with a known solution, scaled to be independent of the units of the unknowns. Without full
    rank the error is as large as the solution."""
    columns = constant(A.pattern.columns)
    size = jax.ops.segment_max(jnp.abs(A.entries), columns, A.pattern.size)
    mixed = jnp.arange(size.size, dtype=jnp.uint32) * jnp.uint32(2654435769)
    known = jnp.where(mixed >> 31 == 0, 1, -1).astype(size.dtype)  # signs without a pattern
    solution = factors.solve(A.multiply(known / size))
    return jnp.max(jnp.abs(solution * size - known))


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


def _condensed(A: SparseMatrix) -> "Condensed | KLU":
    """Return the factors of what is left when unknowns have been eliminated, as often as there are some."""
    return KLU.of(A) if Condensation.of(A.pattern) is None else Condensed.of(A, _condensed)


class Either(eqx.Module):
    """The elimination without exchanges of rows where it is usable, else that of KLU."""

    first: MultiElimination | Condensed
    second: KLU
    use_first: BoolScalar

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        x = self.first.solve(b)
        return _unless(self.use_first, self.second.solve, b, x)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        x = self.first.solve_transposed(b)
        return _unless(self.use_first, self.second.solve_transposed, b, x)


def _unless(condition: BoolScalar, function: Callable, x: Array, otherwise: Array) -> Array:
    """Return `function(x)`, or what is there already. A loop of one iteration or none: KLU refuses indices that
    differ in a batch, which `jax.lax.cond` makes of all. What does not depend on `i` would be moved out of it."""
    body = lambda i, _: function(jnp.where(i == 0, x, 0))
    return jax.lax.fori_loop(0, jnp.where(condition, 0, 1), body, otherwise)


class TridiagonalElimination(eqx.Module):
    """Elimination in blocks of one, by the library with exchanges of rows, once for every right-hand side."""

    blocks: Blocks
    pattern: SquarePattern = eqx.field(static=True)

    @staticmethod
    def of(A: SparseMatrix) -> "TridiagonalElimination":
        order = A.pattern.block_order
        i, j = order.own_places[A.pattern.rows], order.own_places[A.pattern.columns]
        diagonals = jnp.zeros((3, order.num_blocks, 1, 1), A.entries.dtype)
        diagonals = diagonals.at[1, order.size :].set(1)  # rows that complete the blocks
        diagonals = diagonals.at[constant(j - i + 1), constant(i), 0, 0].set(A.entries)
        blocks = Blocks(diagonals[0], diagonals[1], diagonals[2])
        return TridiagonalElimination(blocks, A.pattern)

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return solve_in_blocks(self.pattern.block_order, eliminate(self.blocks), b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        return TridiagonalElimination(self.blocks.transposed(), self.pattern).solve(b)
