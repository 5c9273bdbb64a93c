"""Square sparse matrices: where their entries are, and their values."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float
from scipy.sparse.csgraph import maximum_bipartite_matching

from ..coloring import greedy_colors
from ..singular_parts import SingularParts
from .block_order import BlockOrder
from .elimination_plan import EliminationPlan


class SquarePattern:
    """Where an `n x n` matrix has entries: `rows` and `columns`, row by row."""

    def __init__(self, entries: sp.csr_matrix):
        entries = sp.csr_matrix(entries)
        entries.sort_indices()
        self.size: int = entries.shape[0]  # pyright: ignore[reportOptionalSubscript]
        self.rows = np.repeat(np.arange(self.size, dtype=np.int32), np.diff(entries.indptr))
        self.columns = entries.indices.astype(np.int32)

    @property
    def num_entries(self) -> int:
        return len(self.rows)

    @functools.cached_property
    def on_diagonal(self) -> np.ndarray:
        """Return the numbers of those entries that are on the diagonal."""
        return np.flatnonzero(self.rows == self.columns).astype(np.int32)

    @functools.cached_property
    def transversal(self) -> np.ndarray | None:
        """Return the numbers of entries of which one is in each row and each column; `None` if there
        are none: then all matrices of the pattern are singular."""
        column_of = maximum_bipartite_matching(self._matrix(), perm_type="column")
        if (column_of < 0).any():
            return None
        return np.flatnonzero(column_of[self.rows] == self.columns).astype(np.int32)

    @property
    def singular_parts(self) -> SingularParts:
        return SingularParts.of(self._matrix() != 0)

    @functools.cached_property
    def color(self) -> np.ndarray:
        """Return a color for each column; no row has entries in two columns of the same color."""
        return greedy_colors(self._matrix().T @ self._matrix())

    @property
    def num_colors(self) -> int:
        return int(self.color.max(initial=0)) + 1

    @functools.cached_property
    def block_order(self) -> BlockOrder:
        """Return the order in which the matrix is block tridiagonal, with narrow blocks if there is one."""
        return BlockOrder.best(sp.coo_matrix(self._matrix() + self._matrix().T))

    @functools.cached_property
    def column_of_row(self) -> np.ndarray | None:
        """Return the columns in whose places rows have to be for a diagonal without zeros; `None` where they are."""
        if len(self.on_diagonal) == self.size or self.transversal is None:
            return None
        column_of_row = np.empty(self.size, np.uint32)
        column_of_row[self.rows[self.transversal]] = self.columns[self.transversal]
        return column_of_row

    @functools.cached_property
    def elimination_plan(self) -> EliminationPlan | None:
        rows = self.rows if self.column_of_row is None else self.column_of_row[self.rows]
        return EliminationPlan.of(rows, self.columns, self.size)

    def _matrix(self) -> sp.csr_matrix:
        ones = np.ones(self.num_entries, np.int64)
        return sp.csr_matrix((ones, (self.rows, self.columns)), (self.size, self.size))

    @functools.cached_property
    def _contents(self) -> tuple[int, bytes, bytes]:
        return self.size, self.rows.tobytes(), self.columns.tobytes()

    def __eq__(self, other: object) -> bool:
        """Compare by contents: a pattern that is found again is the same static field."""
        return isinstance(other, SquarePattern) and self._contents == other._contents

    def __hash__(self) -> int:
        return hash(self._contents)


class SparseMatrix(eqx.Module):
    """A square matrix by its entries, in the order of the pattern."""

    entries: Float[Array, " entries"]
    pattern: SquarePattern = eqx.field(static=True)

    @staticmethod
    def of_columns(
        multiply: Callable[[Float[Array, " n"]], Float[Array, " n"]],
        pattern: SquarePattern,
        dtype: jnp.dtype,
    ) -> "SparseMatrix":
        """Return the matrix of a linear function, from one product for all columns of a color (Curtis,
        Powell & Reid, J. Inst. Maths Applics 13 (1974) 117-119)."""
        colors = constant(pattern.color)
        seeds = jnp.arange(pattern.num_colors, dtype=jnp.int32)[:, None] == colors[None, :]
        products = jax.vmap(multiply)(seeds.astype(dtype))
        at = constant(pattern.color[pattern.columns]), constant(pattern.rows)
        return SparseMatrix(products[at], pattern)

    @staticmethod
    def of_mass(mass: Float[Array, "..."], pattern: SquarePattern) -> "SparseMatrix":
        """Return a scalar, a diagonal or a matrix in the form of the pattern. Not finite if it has other
        entries."""
        if mass.ndim == 2:
            return SparseMatrix(mass[constant(pattern.rows), constant(pattern.columns)], pattern)
        diagonal = jnp.broadcast_to(mass, (pattern.size,))
        numbers, entries = pattern.on_diagonal, jnp.zeros(pattern.num_entries, mass.dtype)
        entries = entries.at[constant(numbers)].set(diagonal[constant(pattern.rows[numbers])])
        others = np.setdiff1d(np.arange(pattern.size), pattern.rows[numbers])
        outside = jnp.any(diagonal[others] != 0)
        return SparseMatrix(entries + jnp.where(outside, jnp.nan, 0).astype(mass.dtype), pattern)

    def multiply(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.over_rows(jax.ops.segment_sum, self.entries * x[constant(self.pattern.columns)])

    def multiply_transposed(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        pattern = self.pattern
        values = self.entries * x[constant(pattern.rows)]
        return jax.ops.segment_sum(values, constant(pattern.columns), pattern.size)

    def scaled_rows(self, factors: Float[Array, " n"]) -> "SparseMatrix":
        return SparseMatrix(self.entries * factors[constant(self.pattern.rows)], self.pattern)

    def over_rows(self, reduction: Callable, values: Array) -> Array:
        """Reduce values, one per entry, over each row; `reduction` is such as `jax.ops.segment_max`."""
        return reduction(
            values, constant(self.pattern.rows), self.pattern.size, indices_are_sorted=True
        )

    def has_empty_lines(self) -> Bool[Array, ""]:
        """Whether all entries of a row or of a column are zero."""
        pattern, there = self.pattern, (self.entries != 0).astype(jnp.int32)
        rows = self.over_rows(jax.ops.segment_max, there)
        columns = jax.ops.segment_max(there, constant(pattern.columns), pattern.size)
        return ~jnp.all((rows > 0) & (columns > 0))

    def __add__(self, other: "SparseMatrix") -> "SparseMatrix":
        return SparseMatrix(self.entries + other.entries, self.pattern)

    def __sub__(self, other: "SparseMatrix") -> "SparseMatrix":
        return SparseMatrix(self.entries - other.entries, self.pattern)

    def __truediv__(self, number: float) -> "SparseMatrix":
        return SparseMatrix(self.entries / number, self.pattern)


def multiply_sparse(A: SparseMatrix, x: Float[Array, " n"]) -> Float[Array, " n"]:
    return A.multiply(x)


def permutation(pattern: SquarePattern, dtype: jnp.dtype) -> SparseMatrix:
    """Return a matrix of the pattern with a one in each row and each column."""
    entries = jnp.zeros(pattern.num_entries, dtype)
    return SparseMatrix(entries.at[constant(pattern.transversal)].set(1), pattern)  # pyright: ignore[reportArgumentType]


def constant(indices: np.ndarray) -> Array:
    """Return indices behind a barrier, which keeps the compiler from evaluating all that depends on
    them at compile time, slowly."""
    return jax.lax.optimization_barrier(jnp.asarray(indices))
