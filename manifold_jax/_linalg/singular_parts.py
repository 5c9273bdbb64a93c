"""The parts of a matrix, of which only the places of its entries are known, that make it singular."""

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching


class SingularParts(NamedTuple):
    """The singular parts of a matrix without a transversal (Dulmage & Mendelsohn, Canad. J. Math. 10
    (1958) 517-534): the equations that have too few unknowns for all of them, with those unknowns, and
    the unknowns that have too few equations, with those equations."""

    overdetermined: tuple[np.ndarray, np.ndarray]  # equations, unknowns
    underdetermined: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(there: Any) -> "SingularParts":
        """Find them for a matrix of Booleans, an array or a sparse one."""
        there = csr_array(there)
        unknown_of = maximum_bipartite_matching(there, perm_type="column")
        equation_of = np.full(there.shape[1], -1)
        matched = unknown_of >= 0
        equation_of[unknown_of[matched]] = np.nonzero(matched)[0]
        over = _reached(there, ~matched, equation_of)
        under = _reached(csr_array(there.T), equation_of < 0, unknown_of)
        return SingularParts(over, (under[1], under[0]))


def _reached(
    there: csr_array, start: np.ndarray, back: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Follow alternating paths: rows from `start`, to columns, and to the rows these belong to."""
    rows = start.copy()
    while True:
        columns = there.T @ rows > 0
        after = rows.copy()
        after[back[columns & (back >= 0)]] = True
        if (after == rows).all():
            return np.nonzero(rows)[0], np.nonzero(columns)[0]
        rows = after
