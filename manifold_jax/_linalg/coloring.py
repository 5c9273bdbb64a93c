"""Graph colorings for derivatives along several unknowns at once (Curtis, Powell & Reid, J. Inst. Maths
Applics 13 (1974) 117-119)."""

import itertools
from typing import Any

import numpy as np
import scipy.sparse as sp


def greedy_colors(conflict: Any, most_conflicts_first: bool = False) -> np.ndarray:
    """Return for each number the smallest color that no neighbour with a color yet has."""
    conflict = sp.csr_array(conflict + conflict.T)
    starts = conflict.indptr
    order = np.arange(len(starts) - 1)
    if most_conflicts_first:
        order = np.argsort(-np.diff(starts), kind="stable")
    colors = np.full(len(order), -1, np.int32)
    for j in order:
        taken = set(colors[conflict.indices[starts[j] : starts[j + 1]]].tolist())
        colors[j] = next(color for color in itertools.count() if color not in taken)
    return colors
