"""Linear systems with constant pivots, which are eliminated first."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar
from .._linalg.dense import Factorization, factorize, gram, UNROLL_LIMIT
from .._linalg.pivoted import factorize_equilibrated
from .._linalg.rows import multiply
from .compressed import Compressed
from .derivatives import pick


# Of a pivot, relative to the largest entry of its row.
_SMALLEST_PIVOT = 1e-6


class Elimination(NamedTuple):
    """Which pivots are taken: `J[rows, columns]` is diagonal and constant. Of what is left the
    symmetric part may be definite, positive or negative (`sign`), or not (0)."""

    rows: np.ndarray
    columns: np.ndarray
    other_rows: np.ndarray
    other_columns: np.ndarray
    sign: Literal[-1, 0, 1]

    @staticmethod
    def of(constant: np.ndarray, samples: list[np.ndarray]) -> "Elimination":
        """Choose pivots from samples of the matrix, and where it is constant."""
        rows, columns = _independent_pivots(constant, samples)
        n = constant.shape[0]
        others = [np.setdiff1d(np.arange(n), taken) for taken in (rows, columns)]
        left = [_schur_complement(J, rows, columns, *others) for J in samples]
        for sign in (1, -1):
            if all(_is_definite(sign * S) for S in left):
                return Elimination(rows, columns, *others, sign)  # pyright: ignore[reportCallIssue]
        return Elimination(rows, columns, *others, 0)  # pyright: ignore[reportCallIssue]

    @property
    def is_definite(self) -> bool:
        """Large ones are factored by the library, which exchanges rows in any case."""
        return self.sign != 0 and len(self.other_rows) <= UNROLL_LIMIT

    def factorize(self, S: Float[Array, "k k"]) -> Factorization:
        return factorize(self.sign * S) if self.is_definite else factorize_equilibrated(S)

    def solve_rest(self, rest: Factorization, b: Float[Array, " k"]) -> Float[Array, " k"]:
        return rest.solve(self.sign * b if self.is_definite else b)


def _independent_pivots(
    constant: np.ndarray, samples: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Greedily: no entry in the row or column of another."""
    size = np.min([np.abs(J) / np.abs(J).max(axis=1, keepdims=True) for J in samples], axis=0)
    there = np.any([J != 0 for J in samples], axis=0)
    good = constant & (size > _SMALLEST_PIVOT)
    rows, columns = [], []
    for i, j in sorted(np.argwhere(good).tolist(), key=lambda ij: there[ij[0]].sum()):
        if not there[i, columns].any() and not there[rows, j].any():
            rows.append(i)
            columns.append(j)
    order = np.argsort(np.array(columns, int))
    return np.array(rows, int)[order], np.array(columns, int)[order]


def _schur_complement(J: np.ndarray, r: Any, c: Any, other_r: Any, other_c: Any) -> np.ndarray:
    half = J[np.ix_(other_r, c)] / J[r, c]
    return J[np.ix_(other_r, other_c)] - half @ J[np.ix_(r, other_c)]


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
        return Eliminated(plan, pivots, right, below, plan.factorize(S))

    @property
    def full_rank(self) -> BoolScalar:
        regular = jnp.all(self.pivots != 0)
        return regular if self.rest is None else regular & self.rest.full_rank

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan = self.plan
        upper, lower = pick(b, plan.rows), pick(b, plan.other_rows)
        order = np.argsort(np.concatenate([plan.columns, plan.other_columns]))
        if self.rest is None:
            return pick(upper / self.pivots, order)
        if len(plan.rows) == 0:
            y = plan.solve_rest(self.rest, lower)
            return pick(y, order)
        lower = lower - multiply(self.below, upper / self.pivots)
        y = plan.solve_rest(self.rest, lower)
        x = (upper - multiply(self.right, y)) / self.pivots
        return pick(jnp.concatenate([x, y]), order)
