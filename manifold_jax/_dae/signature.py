"""Pryce's structural analysis: how often each equation has to be differentiated.

Source: J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001) 364-394.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment


# In a signature matrix: the unknown does not occur in the equation.
ABSENT = -(10**6)


class DAEStructure(NamedTuple):
    """A signature matrix `sigma_ij`, the order of the highest derivative of unknown `j` in equation
    `i`, with the smallest offsets `c_i` (differentiations of equation `i`) and `d_j` (order of the
    highest derivative of unknown `j` afterwards) with `d_j - c_i >= sigma_ij`, and equality on the
    transversal."""

    sigma: np.ndarray
    transversal: np.ndarray  # the unknown that belongs to each equation
    c: np.ndarray
    d: np.ndarray

    @property
    def leading(self) -> np.ndarray:
        """The entries where the equations, differentiated `c_i` times, contain the derivatives `d_j`."""
        return self.d[None, :] - self.c[:, None] == self.sigma

    @property
    def degrees_of_freedom(self) -> int:
        return int(self.d.sum() - self.c.sum())

    @property
    def index(self) -> int:
        """The number of differentiations until the equations are an ordinary differential equation of
        all unknowns: one more than `max c` if an unknown is only found algebraically."""
        return int(self.c.max(initial=0)) + int((self.d == 0).any())

    @staticmethod
    def of(sigma: np.ndarray, at_least: np.ndarray | None = None) -> "DAEStructure | None":
        """Find the offsets; return `None` if no assignment of unknowns to equations exists. `at_least`
        are lower bounds of the `c_i`."""
        n = len(sigma)
        rows, transversal = linear_sum_assignment(sigma.astype(float), maximize=True)
        on_transversal = sigma[rows, transversal]
        if (on_transversal == ABSENT).any():
            return None
        c = np.zeros(n, int) if at_least is None else at_least
        while True:
            d = (sigma + c[:, None]).max(axis=0, initial=ABSENT)
            raised = np.maximum(c, d[transversal] - on_transversal)
            if (raised == c).all():
                return DAEStructure(sigma, transversal, c, d)
            c = raised


def signature(occurs: np.ndarray) -> np.ndarray:
    """Return the signature matrix from `occurs[i, k, j]`: derivative `k` of unknown `j` in equation
    `i`."""
    sigma = np.full(occurs[:, 0].shape, ABSENT)
    for k in range(occurs.shape[1]):
        sigma[occurs[:, k]] = k
    return sigma
