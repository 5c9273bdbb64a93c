"""In which order the unknowns of a sparse system are eliminated, many at a time."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


# Unknowns left at the end for a dense matrix: always as few as the first number; from the second one on where
# rounds have become so small that they cost more than their arithmetic. A mesh of 30 x 30 and random patterns of
# 300 and 1000 unknowns take 1.0 of the time with 96, 1.5 to 2 with 48, and 1.3 to 1.8 with 160. jaxlib 0.10.2.
_FEW, _MANY = 12, 96
_SMALL_ROUND = 4
# Pivots of a round have at most twice as many neighbours as the one with the fewest, and one more.
_SLACK = 2
# More rounds, or products for each entry, take too long to find and to run; KLU takes two to three times as long for
# a mesh of 40 x 40, with 54 rounds and 112 products for each entry.
_MOST_ROUNDS, _MOST_PRODUCTS = 100, 150
# Updates that cost less than a loop.
_FEW_UPDATES = 32
_NONE = 2**31 - 1  # not an index of any array


class Updates(NamedTuple):
    """What rounds of a similar size do, one after the other: arrays of shape `(rounds, most updates of a round)`.

    - `targets`: what is changed: entries of the matrix, or unknowns. Too large a number is no update.
    - `sources`: of shape `(number of sources, rounds, most updates)`, see [`EliminationPlan`][].
    """

    targets: np.ndarray
    sources: np.ndarray


@dataclasses.dataclass(frozen=True)
class EliminationPlan:
    """Rounds of a multi-elimination (Y. Saad, SIAM J. Sci. Comput. 17 (1996) 830-847): unknowns that no equation
    couples with each other are eliminated at the same time, with pivots on the diagonal. For a chain this is cyclic
    reduction.

    - `num_entries`: with those that elimination adds, behind the given ones. Then a zero and a one follow.
    - `diagonal`: numbers of the entries of the diagonal.
    - `products`: `entry[target] -= entry[lower] entry[upper] / entry[pivot]`, the sources being numbers of entries.
    - `lower`: entries below pivots: the targets are their rows, the sources their numbers, those of the pivots, and
        the pivots' columns. `x[target] -= entry[number] / entry[pivot] x[column]`.
    - `upper`: entries to the right of pivots: the targets are their columns, the sources the same with the pivots'
        rows. `x[row] -= entry[number] / entry[pivot] x[target]`, in the opposite order.
    - `rest`: the unknowns that are left at the end.
    - `rest_entries`: numbers of the entries of their matrix.
    """

    num_entries: int
    diagonal: np.ndarray
    products: list[Updates]
    lower: list[Updates]
    upper: list[Updates]
    rest: np.ndarray
    rest_entries: np.ndarray

    @staticmethod
    def of(rows: np.ndarray, columns: np.ndarray, size: int) -> "EliminationPlan | None":
        """Return a plan for a matrix with the given entries; `None` if it would take too much."""
        graph = _Graph(rows, columns, size)
        rounds: list[tuple[list, list, list]] = []
        most, num_products = _MOST_PRODUCTS * len(rows), 0
        while not graph.is_small:
            pivots = graph.independent()
            if len(pivots) <= _SMALL_ROUND and len(graph.active) <= _MANY:
                break
            rounds.append(graph.eliminate(pivots))
            num_products += len(rounds[-1][0])
            if len(rounds) > _MOST_ROUNDS or num_products > most:
                return None
        rest, numbers = graph.active, graph.numbers
        zero, one = len(numbers), len(numbers) + 1
        entries = [[numbers.get((i, j), zero) for j in rest] for i in rest]
        products, lower, upper = zip(*rounds, strict=True) if rounds else ((), (), ())
        return EliminationPlan(
            num_entries=len(numbers),
            diagonal=_indices([numbers[i, i] for i in range(size)]),
            products=_grouped(products, (_NONE, zero, zero, one)),
            lower=_grouped(lower, (_NONE, zero, one, 0)),
            upper=_grouped(upper, (_NONE, zero, one, 0)),
            rest=_indices(rest),
            rest_entries=_indices(entries).reshape(len(rest), len(rest)),
        )


class _Graph:
    """The entries that are left: columns of each row, rows of each column; and numbers of all entries."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        self.active = list(range(size))
        self.columns: list[set[int]] = [{i} for i in range(size)]
        self.rows: list[set[int]] = [{i} for i in range(size)]
        self.numbers: dict[tuple[int, int], int] = {}
        diagonal = ((i, i) for i in range(size))
        for i, j in [*zip(rows.tolist(), columns.tolist(), strict=True), *diagonal]:
            self.add(i, j)

    @property
    def is_small(self) -> bool:
        return len(self.active) <= _FEW

    def add(self, i: int, j: int) -> None:
        self.numbers.setdefault((i, j), len(self.numbers))
        self.columns[i].add(j)
        self.rows[j].add(i)

    def independent(self) -> list[int]:
        """Choose unknowns with few neighbours, none of them neighbours of each other."""
        degree = {i: len(self.columns[i] | self.rows[i]) - 1 for i in self.active}
        limit = _SLACK * min(degree.values()) + 1
        chosen: list[int] = []
        excluded: set[int] = set()
        for i in sorted(self.active, key=degree.__getitem__):
            if degree[i] > limit:
                break
            if i not in excluded:
                chosen.append(i)
                excluded |= self.columns[i] | self.rows[i]
        return chosen

    def eliminate(self, pivots: list[int]) -> tuple[list, list, list]:
        """Return the updates of a round: targets and sources of products, lower and upper entries."""
        products, lower, upper = [], [], []
        for k in pivots:
            below, right = sorted(self.rows[k] - {k}), sorted(self.columns[k] - {k})
            pivot = self.numbers[k, k]
            lower += [(i, self.numbers[i, k], pivot, k) for i in below]
            upper += [(j, self.numbers[k, j], pivot, k) for j in right]
            for i in below:
                self.columns[i].discard(k)
            for j in right:
                self.rows[j].discard(k)
            for i in below:
                for j in right:
                    self.add(i, j)
                    numbers = self.numbers[i, j], self.numbers[i, k], self.numbers[k, j], pivot
                    products.append(numbers)
        gone = set(pivots)
        self.active = [i for i in self.active if i not in gone]
        return products, lower, upper


def _grouped(rounds: Sequence[list], padding: tuple[int, ...]) -> list[Updates]:
    """Join rounds of which the largest is not much larger than the others."""
    groups: list[list[list]] = []
    for updates in rounds:
        together = [*groups[-1], updates] if groups else []
        number = len(together) * max(map(len, together), default=0)
        if together and number <= 2 * sum(map(len, together)) + len(together) * _FEW_UPDATES:
            groups[-1] = together
        else:
            groups.append([updates])
    return [_padded(group, padding) for group in groups]


def _padded(group: list[list], padding: tuple[int, ...]) -> Updates:
    most = max(map(len, group))
    table = [[*updates, *[padding] * (most - len(updates))] for updates in group]
    table = _indices(table).reshape(len(group), most, len(padding))
    return Updates(table[..., 0], np.moveaxis(table[..., 1:], -1, 0))


def _indices(values: list) -> np.ndarray:
    """Return indices without a sign, which JAX does not have to compare with zero."""
    return np.array(values, np.uint32)
