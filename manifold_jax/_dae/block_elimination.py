"""Block elimination: constant pivots are eliminated before the rest of a linear system is factored."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._base.types import BoolScalar
from .._linalg.block_triangular import BlockTriangular
from .._linalg.dense import Factorization, factorize, gram, UNROLL_LIMIT
from .._linalg.pivoted import factorize_equilibrated
from .._linalg.rows import multiply
from .compressed import Compressed
from .derivatives import pick


# Smallest size of a pivot, relative to the largest entry of its row.
_SMALLEST_PIVOT = 1e-6


class Elimination(NamedTuple):
    """The pivots `J[rows, columns]`, a diagonal and constant block. `sign` is 1 or -1 if the rest is
    symmetric and positive or negative definite, else 0."""

    rows: np.ndarray
    columns: np.ndarray
    other_rows: np.ndarray
    other_columns: np.ndarray
    sign: Literal[-1, 0, 1]

    @staticmethod
    def of(constant: np.ndarray, samples: list[sp.csr_array]) -> "Elimination":
        """Choose pivots from samples of the matrix, and where it is constant."""
        rows, columns = _independent_pivots(constant, samples)
        n, sign = constant.shape[0], 0
        others = [np.setdiff1d(np.arange(n), taken) for taken in (rows, columns)]
        # Large ones are factored by the library, which exchanges rows in any case.
        if len(others[0]) <= UNROLL_LIMIT:
            left = [_schur_complement(J, rows, columns, *others) for J in samples]
            definite = [s for s in (1, -1) if all(_is_definite(s * S) for S in left)]
            sign = definite[0] if definite else 0
        others = others if sign else _in_order(samples, rows, columns, *others)
        return Elimination(rows, columns, *others, sign)  # pyright: ignore[reportCallIssue]


def _independent_pivots(
    constant: np.ndarray, samples: list[sp.csr_array]
) -> tuple[np.ndarray, np.ndarray]:
    """Choose pivots greedily: no entry in the row or column of another."""
    places = samples[0].tocoo()
    i, j = places.row, places.col
    sizes = np.abs([J.data for J in samples])
    largest = np.zeros((len(samples), len(constant)))
    np.maximum.at(largest.T, i, sizes.T)
    size, there = np.min(sizes / largest[:, i], axis=0), np.any(sizes > 0, axis=0)
    good = np.nonzero(constant[i, j] & (size > _SMALLEST_PIVOT))[0]
    fewest_first = good[np.argsort(np.bincount(i[there])[i[good]], kind="stable")]
    by_rows = sp.csr_array((np.ones(there.sum(), bool), (i[there], j[there])), constant.shape)
    by_columns = sp.csr_array(by_rows.T)
    pivot_rows, pivot_columns = (np.zeros(n, bool) for n in constant.shape)
    column_of = {}
    for row, column in zip(i[fewest_first].tolist(), j[fewest_first].tolist(), strict=True):
        beside, below = _line(by_rows, row), _line(by_columns, column)
        if not pivot_columns[beside].any() and not pivot_rows[below].any():
            pivot_rows[row] = pivot_columns[column] = True
            column_of[column] = row
    columns = np.sort(np.array([*column_of], int))
    return np.array([column_of[column] for column in columns.tolist()], int), columns


def _line(matrix: sp.csr_array, row: int) -> np.ndarray:
    return matrix.indices[matrix.indptr[row] : matrix.indptr[row + 1]]


def _in_order(
    samples: list[sp.csr_array], r: Any, c: Any, other_r: Any, other_c: Any
) -> list[np.ndarray]:
    """Return the other rows and columns in an order in which the rest is block triangular: exchanges of
    rows then stay inside of its blocks, which long chains need, in which each unknown is a multiple of
    the one before."""
    there = sp.csr_array(sum(abs(J) for J in samples))
    rest = there[other_r][:, other_c] + there[other_r][:, c] @ there[r][:, other_c]
    form = BlockTriangular.of(rest)
    return [other_r, other_c] if form is None else [other_r[form.rows], other_c[form.columns]]


def _schur_complement(J: sp.csr_array, r: Any, c: Any, other_r: Any, other_c: Any) -> np.ndarray:
    half = J[other_r][:, c].toarray() / J[r][:, c].diagonal()
    return J[other_r][:, other_c].toarray() - half @ J[r][:, other_c].toarray()


def _is_definite(S: np.ndarray) -> bool:
    symmetric = np.abs(S - S.T).max(initial=0) <= 1e-10 * np.abs(S).max(initial=0)
    return bool(symmetric and (np.linalg.eigvalsh(S) > 0).all())


class Eliminated(NamedTuple):
    """A matrix with its pivots eliminated, and the rest factored."""

    plan: Elimination
    pivots: Float[Array, " p"]
    right: Float[Array, "p k"]
    below: Float[Array, "k p"]
    rest: Factorization | None

    @staticmethod
    def of(plan: Elimination, entries: Compressed, derivatives: Array) -> "Eliminated":
        pivots = entries.diagonal(derivatives, plan.rows, plan.columns)
        right = entries.block(derivatives, plan.rows, plan.other_columns)
        below = entries.block(derivatives, plan.other_rows, plan.columns)
        if len(plan.other_rows) == 0:
            return Eliminated(plan, pivots, right, below, None)
        S = entries.block(derivatives, plan.other_rows, plan.other_columns)
        if len(plan.rows) > 0:
            S = S - gram(below, (right / pivots[:, None]).T)
        rest = factorize(plan.sign * S) if plan.sign else factorize_equilibrated(S)
        return Eliminated(plan, pivots, right, below, rest)

    @property
    def usable(self) -> BoolScalar:
        nonzero = jnp.all(self.pivots != 0)
        return nonzero if self.rest is None else nonzero & self.rest.usable

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan = self.plan
        upper, lower = pick(b, plan.rows), pick(b, plan.other_rows)
        order = np.argsort(np.concatenate([plan.columns, plan.other_columns]))
        if self.rest is None:
            return pick(upper / self.pivots, order)
        if len(plan.rows) > 0:
            lower = lower - multiply(self.below, upper / self.pivots)
        y = self.rest.solve(plan.sign * lower if plan.sign else lower)
        if len(plan.rows) == 0:
            return pick(y, order)
        x = (upper - multiply(self.right, y)) / self.pivots
        return pick(jnp.concatenate([x, y]), order)
