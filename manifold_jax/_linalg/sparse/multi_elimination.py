"""Elimination of many unknowns at a time, without exchanges of rows."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._base.types import IntScalar
from .blocks import Pivot
from .elimination_plan import EliminationPlan, Updates
from .square import SparseMatrix


Indices: TypeAlias = Array | np.ndarray


class MultiElimination(eqx.Module):
    r"""Factors $A = L D U$ in the order of an [`EliminationPlan`][]. All of it is array code: batches and
    accelerators do the same, and transposed systems have the same factors.

    - `lower`, `upper`: the entries of `L` and `U` beside their unit diagonals, for each group of rounds.
    - `rest`: factors of the dense matrix of what is left.
    - `num_solves`: one more for each iterative refinement.
    """

    A: SparseMatrix
    lower: list[Float[Array, "_ _"]]
    diagonal: Float[Array, " n"]
    upper: list[Float[Array, "_ _"]]
    rest: Pivot
    num_solves: IntScalar

    @staticmethod
    def of(A: SparseMatrix) -> "MultiElimination":
        plan, dtype = _plan(A), A.entries.dtype
        added = plan.num_entries - A.pattern.num_entries
        end = jnp.asarray([0, 1], dtype)
        entries = jnp.concatenate([A.entries, jnp.zeros(added, dtype), end])

        def eliminate(entries: Array, targets: Indices, sources: Indices, _: None) -> Array:
            lower, upper, pivot = (_take(entries, at) for at in sources)
            return _add(entries, targets, -lower * upper / pivot)

        for updates in plan.products:
            entries = _each_round(eliminate, entries, updates.targets, updates.sources)
        divided = lambda updates: (
            _take(entries, updates.sources[0]) / _take(entries, updates.sources[1])
        )
        return MultiElimination(
            A,
            [divided(updates) for updates in plan.lower],
            _take(entries, plan.diagonal),
            [divided(updates) for updates in plan.upper],
            Pivot.of(_take(entries, plan.rest_entries)),
            jnp.asarray(1),
        )

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan, column_of_row = _plan(self.A), self.A.pattern.column_of_row
        lower, upper = _paired(plan.lower, self.lower), _paired(plan.upper, self.upper)

        def substitute(b: Array) -> Array:
            if column_of_row is not None:
                b = _take(b, np.argsort(column_of_row).astype(np.uint32))
            return self._substitute(lower, self.rest, upper, b)

        return self._refine(substitute, self.A.multiply, b)

    def solve_transposed(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        plan, column_of_row = _plan(self.A), self.A.pattern.column_of_row
        lower, upper = _paired(plan.lower, self.lower), _paired(plan.upper, self.upper)
        rest = Pivot(self.rest.right.T, self.rest.left.T)

        def substitute(b: Array) -> Array:
            x = self._substitute(upper, rest, lower, b)
            return x if column_of_row is None else _take(x, column_of_row)

        return self._refine(substitute, self.A.multiply_transposed, b)

    def _substitute(self, first: list, rest: Pivot, second: list, b: Array) -> Array:
        """Solve with the unit triangular matrix of `first`, with `D`, and with the transposed matrix of `second`."""
        for updates, entries in first:
            b = _each_round(_subtract, b, updates.targets, updates.sources[2:], entries)
        unknowns = _plan(self.A).rest
        x = (
            (b / self.diagonal)
            .at[unknowns]
            .set(rest.right @ (rest.left @ _take(b, unknowns)), mode="promise_in_bounds")
        )
        for updates, entries in reversed(second):
            pivots, others = updates.sources[2], updates.targets[None]
            x = _each_round(_subtract, x, pivots, others, entries, reverse=True)
        return x

    def _refine(self, substitute: Callable, multiply: Callable, b: Array) -> Array:
        def improve(i: Array, x: Array) -> Array:
            residual = jax.lax.cond(i == 0, lambda: b, lambda: b - multiply(x))
            return x + substitute(residual)

        return jax.lax.fori_loop(0, self.num_solves, improve, jnp.zeros_like(b))


def _plan(A: SparseMatrix) -> EliminationPlan:
    plan = A.pattern.elimination_plan
    assert plan is not None  # the method has been chosen because there is one
    return plan


def _paired(plan: list[Updates], entries: list[Array]) -> list[tuple[Updates, Array]]:
    return list(zip(plan, entries, strict=True))


def _each_round(
    update: Callable,
    x: Array,
    targets: np.ndarray,
    sources: np.ndarray,
    entries: Array | None = None,
    reverse: bool = False,
) -> Array:
    """Apply `update(x, targets, sources, entries)` of each round."""
    if len(targets) == 1:
        return update(x, targets[0], sources[:, 0], None if entries is None else entries[0])
    rounds = targets, np.moveaxis(sources, 1, 0), entries
    return jax.lax.scan(lambda x, r: (update(x, *r), None), x, rounds, reverse=reverse)[0]


def _subtract(x: Array, targets: Indices, sources: Indices, entries: Array) -> Array:
    return _add(x, targets, -entries * _take(x, sources[0]))


def _take(x: Array, at: Indices) -> Array:
    return x.at[at].get(mode="clip")


def _add(x: Array, at: Indices, change: Array) -> Array:
    return x.at[at].add(change, mode="drop")
