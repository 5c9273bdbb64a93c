"""The order in which a system of equations falls into blocks that are solved one after the other.

Source: A. Pothen & C.-J. Fan, Computing the block triangular form of a sparse matrix, ACM Trans. Math.
Softw. 16 (1990) 303-324.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching


class BlockTriangular(NamedTuple):
    """Orders of the rows and of the columns in which a matrix is block upper triangular, with as many
    square diagonal blocks as possible, which start at `starts`."""

    rows: np.ndarray
    columns: np.ndarray
    starts: np.ndarray

    @staticmethod
    def of(matrix: Any) -> "BlockTriangular | None":
        """Find the orders for the nonzero entries of a matrix; `None` if all matrices with these entries
        are singular."""
        matrix = sp.csr_array(matrix)
        matrix.eliminate_zeros()
        column_of = maximum_bipartite_matching(matrix, perm_type="column")
        if (column_of < 0).any():
            return None
        coupled = sp.coo_array(matrix[:, column_of])
        number, block = connected_components(coupled, connection="strong")
        rows = np.lexsort((block, _depth(number, block[coupled.row], block[coupled.col])[block]))
        starts = np.flatnonzero(np.diff(block[rows], prepend=-1))
        return BlockTriangular(rows, column_of[rows], starts)

    @property
    def blocks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the rows and the columns of each diagonal block."""
        parts = (np.split(order, self.starts[1:]) for order in (self.rows, self.columns))
        return list(zip(*parts, strict=True))


def _depth(number: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return for each block how many others at most are before it, one after the other."""
    across, depth = before != after, np.zeros(number, int)
    before, after = before[across], after[across]
    while True:
        longer = depth.copy()
        np.maximum.at(longer, after, depth[before] + 1)
        if (longer == depth).all():
            return depth
        depth = longer
