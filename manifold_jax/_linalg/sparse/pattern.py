"""Sparsity pattern of a function, found in time that grows with the number of equations and of
unknowns, not with their product.

The traced function is evaluated with hashed unknowns: each counts as one of `_GROUPS` groups in each of
`_HASHES` random partitions. An equation can depend only on unknowns whose groups it depends on in all
of them. None is missed, and false positives are sorted out by new partitions (Bloom, Commun. ACM 13
(1970) 422-426).
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ..._jaxpr.incidence import incidence


_GROUPS = 256
_HASHES = 4
# An equation depends on a quarter of all groups only if it depends on very many unknowns.
_FULL = 0.25


def dependence(function: Callable, x: Float[Array, " n"]) -> sp.csr_matrix | None:
    """Return the dependence of `function(x)`, a vector: `(m, n)` with a one where equation `i` depends
    on unknown `j`, for any values. `None` if most equations depend on very many."""
    n = x.size
    if n <= _GROUPS * _HASHES:
        return sp.csr_matrix(incidence(function, (x, np.eye(n, dtype=bool))).depends)
    random = np.random.default_rng(0)
    rows, columns = _candidates(function, x, random)
    for _ in range(3):
        if rows is None:
            return None
        before = len(rows)
        group, depends = _hashed(function, x, random)
        rows, columns = _kept(rows, columns, group, depends)
        if len(rows) == before:
            break
    return sp.csr_matrix((np.ones(len(rows), bool), (rows, columns)), (len(depends), n))  # pyright: ignore[reportArgumentType]


def _hashed(function, x, random) -> tuple[np.ndarray, np.ndarray]:
    """Return the group of each unknown in each partition, and the groups that each equation depends on."""
    numbers = np.arange(x.size)
    group = np.stack([random.permutation(x.size) % _GROUPS for _ in range(_HASHES)])
    group += _GROUPS * np.arange(_HASHES)[:, None]
    tracked = np.zeros((x.size, _GROUPS * _HASHES), bool)
    for row in group:
        tracked[numbers, row] = True
    return group, incidence(function, (x, tracked)).depends


def _candidates(function, x, random):
    group, depends = _hashed(function, x, random)
    first = depends[:, :_GROUPS]
    if first.mean() > _FULL:
        return None, None
    members = np.argsort(group[0], kind="stable")
    bounds = np.searchsorted(group[0][members], np.arange(_GROUPS + 1))
    rows, groups = np.nonzero(first)
    counts = np.diff(bounds)[groups]
    inside = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    columns = members[np.repeat(bounds[groups], counts) + inside]
    return _kept(np.repeat(rows, counts), columns, group[1:], depends)


def _kept(rows, columns, group, depends):
    for partition in group:
        kept = depends[rows, partition[columns]]
        rows, columns = rows[kept], columns[kept]
    return rows, columns
