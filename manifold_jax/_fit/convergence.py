"""Convergence tests of a fit, in addition to those of its optimizer."""

from typing import Any

import numpy as np
import optimistix as optx

from .objective import Objective, Solved, stacked, Unknowns


# Largest relative offset of a converged fit: the remaining step relative to the effect of noise.
_OFFSET = 1e-5
_TRIALS = 3


def stalled(losses: list[float], patience: int) -> bool:
    """Whether `patience` steps have not lowered the loss by more than rounding."""
    if len(losses) <= patience + 1:
        return False
    return min(losses[-patience:]) > min(losses[:-patience]) * (1 - 1e-9)


def flat(losses: list[float]) -> bool:
    """Whether the last five steps have lowered the loss by less than a hundredth."""
    return len(losses) > 5 and losses[-6] - losses[-1] <= 0.01 * abs(losses[-6])


def at_minimum(
    losses: list[float], u: Unknowns, solved: Solved, objective: Objective, solver: Any
) -> bool:
    """Whether steps are rejected because the errors of the solves exceed the possible gain."""
    if not isinstance(solver, optx.AbstractLeastSquaresSolver) or not stalled(losses, _TRIALS):
        return False
    return relative_offset(*stacked(u, solved, objective)) <= _OFFSET


def relative_offset(J: np.ndarray, r: np.ndarray) -> float:
    r"""Return the size of the residuals `(n,)` in the range of their Jacobian `(n, N)`, relative to the
    rest of them,

    $$\sqrt{\frac{\lVert P r\rVert^2 / N}{\lVert r - P r\rVert^2 / (n - N)}},$$

    infinite for as many unknowns as residuals. Source: Bates & Watts, A relative offset orthogonality
    convergence criterion for nonlinear least squares, Technometrics 23 (1981) 179-183.
    """
    # Without missing values and the constants that stand for records whose solves failed.
    known = np.any(J != 0, axis=1)
    J, r = J[known][:, np.any(J != 0, axis=0)], r[known]
    n, N = J.shape
    if n <= N or N == 0:
        return np.inf
    Q = np.linalg.qr(J / np.linalg.norm(J, axis=0))[0]
    along = Q @ (Q.T @ r)
    across = np.linalg.norm(r - along)
    return float(np.linalg.norm(along) / across * np.sqrt((n - N) / N)) if across > 0 else np.inf
