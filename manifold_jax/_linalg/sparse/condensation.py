"""Unknowns that are eliminated before a library is called: those with an equation for one other at most.

    d x_p + c x_j = b_p    gives    x_p = (b_p - c x_j) / d

`x' = v` is such an equation in an implicit step. KLU orders rows and columns by their structure alone; for a
flow on 41 x 41 cells, 4961 unknowns and 3280 such equations, a step takes twice as long with them as without.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .square import constant, SparseMatrix, SquarePattern


# The smallest part of the unknowns for which it is worth while.
_FEWEST = 1 / 8


class Condensation(NamedTuple):
    """Which unknowns are eliminated and what is left. `pivots` and `beside` are the numbers of the entries
    `d` and `c` of each equation; `partner` is the place of `x_j` among the unknowns that are left. `below` are
    the entries of the eliminated unknowns in other equations, with the places of both."""

    eliminated: np.ndarray
    left: np.ndarray
    pivots: np.ndarray
    beside: np.ndarray
    partner: np.ndarray
    below: np.ndarray
    below_row: np.ndarray
    below_pivot: np.ndarray
    pattern: SquarePattern  # of the matrix that is left
    kept: np.ndarray  # entries of the whole matrix that stay, and their numbers in the rest
    kept_place: np.ndarray
    fill_place: np.ndarray  # numbers of the entries that change by those in `below`

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(pattern: SquarePattern) -> "Condensation | None":
        """Choose the unknowns; `None` if they are few."""
        rows, columns, n = pattern.rows, pattern.columns, pattern.size
        beside = _entries_beside(pattern)
        eliminated = np.flatnonzero(beside >= 0)
        if len(eliminated) < _FEWEST * n:
            return None
        beside = beside[eliminated]
        pivots = pattern.on_diagonal[np.isin(rows[pattern.on_diagonal], eliminated)]
        left = np.setdiff1d(np.arange(n), eliminated)
        place = np.empty(n, np.int64)
        place[left], place[eliminated] = np.arange(len(left)), np.arange(len(eliminated))
        is_left = np.isin(np.arange(n), left)
        kept = np.flatnonzero(is_left[rows] & is_left[columns])
        below = np.flatnonzero(is_left[rows] & ~is_left[columns])
        partner, below_row, below_pivot = (
            place[index] for index in (columns[beside], rows[below], columns[below])
        )
        fill = below_row, partner[below_pivot]
        stays = place[rows[kept]], place[columns[kept]]
        shape = len(left), len(left)
        there = sp.coo_array((np.ones(len(kept)), stays), shape)
        there = sp.csr_array(there + sp.coo_array((np.ones(len(below)), fill), shape))
        rest = SquarePattern(sp.csr_matrix(there))
        number = sp.csr_array((np.arange(rest.num_entries), (rest.rows, rest.columns)), shape)
        find = lambda at: np.asarray(number[at]).ravel()
        parts = beside, partner, below, below_row, below_pivot
        return Condensation(eliminated, left, pivots, *parts, rest, kept, find(stays), find(fill))


def _entries_beside(pattern: SquarePattern) -> np.ndarray:
    """Return for each unknown that is eliminated the number of the other entry of its equation, -1 for all
    others. Greedily: no partner is eliminated itself."""
    rows, columns, n = pattern.rows, pattern.columns, pattern.size
    has_diagonal = np.zeros(n, bool)
    has_diagonal[rows[pattern.on_diagonal]] = True
    of_two = has_diagonal & (np.bincount(rows, minlength=n) == 2)
    beside, is_partner = np.full(n, -1), np.zeros(n, bool)
    for entry in np.flatnonzero(of_two[rows] & (rows != columns)).tolist():
        row, column = rows[entry], columns[entry]
        if beside[column] < 0 and not is_partner[row]:
            beside[row], is_partner[column] = entry, True
    return beside


class Condensed(eqx.Module):
    """A matrix without the unknowns that are eliminated, factored by `inner`. The equations of these are not
    exchanged with others: a small `d` costs digits."""

    pivots: Float[Array, " p"]
    ratios: Float[Array, " p"]  # c / d
    below: Float[Array, " k"]
    inner: Any
    pattern: SquarePattern = eqx.field(static=True)

    @staticmethod
    def of(A: SparseMatrix, factorize: Any) -> "Condensed":
        plan = _plan(A.pattern)
        take = lambda numbers: A.entries[constant(numbers)]
        pivots, below = take(plan.pivots), take(plan.below)
        ratios = take(plan.beside) / pivots
        fill = -below * ratios[constant(plan.below_pivot)]
        entries = jnp.zeros(plan.pattern.num_entries, A.entries.dtype)
        entries = entries.at[constant(plan.kept_place)].set(take(plan.kept))
        entries = entries.at[constant(plan.fill_place)].add(fill)
        inner = factorize(SparseMatrix(entries, plan.pattern))
        return Condensed(pivots, ratios, below, inner, A.pattern)

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan, (upper, lower) = _plan(self.pattern), self._split(b)
        upper = upper / self.pivots
        moved = self.below * upper[constant(plan.below_pivot)]
        lower -= jax.ops.segment_sum(moved, constant(plan.below_row), len(plan.left))
        x = self.inner.solve(lower)
        return self._joined(upper - self.ratios * x[constant(plan.partner)], x)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan, (upper, lower) = _plan(self.pattern), self._split(b)
        moved = self.ratios * upper
        lower -= jax.ops.segment_sum(moved, constant(plan.partner), len(plan.left))
        x = self.inner.solve_transposed(lower)
        moved = self.below * x[constant(plan.below_row)]
        upper -= jax.ops.segment_sum(moved, constant(plan.below_pivot), len(plan.eliminated))
        return self._joined(upper / self.pivots, x)

    def _split(self, b: Float[Array, " n"]) -> tuple[Array, Array]:
        plan = _plan(self.pattern)
        return b[constant(plan.eliminated)], b[constant(plan.left)]

    def _joined(self, upper: Array, lower: Array) -> Float[Array, " n"]:
        plan = _plan(self.pattern)
        order = np.argsort(np.concatenate([plan.eliminated, plan.left]))
        return jnp.concatenate([upper, lower])[constant(order)]


def _plan(pattern: SquarePattern) -> Condensation:
    plan = Condensation.of(pattern)
    assert plan is not None  # the method has been chosen because there is one
    return plan
