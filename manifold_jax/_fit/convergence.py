"""When a fit is over, apart from what its optimizer says."""

from typing import Any

import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .objective import at_once, Objective, Solved


# What is left to a step, of what the noise of the data moves the minimum by.
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
    losses: list[float], u: Float[Array, " N"], solved: Solved, objective: Objective, solver: Any
) -> bool:
    r"""Whether steps are refused at the minimum, where errors of the solves are larger than what there
    is left to gain: by the residuals along the columns of their Jacobian against those across,

    $$\sqrt{\frac{\lVert P r\rVert^2 / N}{\lVert r - P r\rVert^2 / (n - N)}} \le 10^{-5}.$$

    Source: Bates & Watts, A relative offset orthogonality convergence criterion for nonlinear least
    squares, Technometrics 23 (1981) 179-183.
    """
    if not isinstance(solver, optx.AbstractLeastSquaresSolver) or not stalled(losses, _TRIALS):
        return False
    J, r = at_once(u, solved, objective)
    J = J[:, np.any(J != 0, axis=0)]
    n, N = J.shape
    if n <= N or N == 0:
        return False
    Q = np.linalg.qr(J / np.linalg.norm(J, axis=0))[0]
    along = np.sum((Q.T @ r) ** 2)
    return bool(along / N <= _OFFSET**2 * (np.sum(r * r) - along) / (n - N))
