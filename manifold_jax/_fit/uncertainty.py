"""Standard errors from the Gauss-Newton matrix, and what the data do not determine."""

from typing import NamedTuple

import numpy as np
import scipy.linalg


# Derivatives are as accurate as the solver's tolerance; singular values below this fraction of
# the largest, after columns are scaled to length 1, are not told from zero.
_SINGULAR = 1e-6


class Uncertainty(NamedTuple):
    """Covariance `(N, N)` for noise of size 1, of how many unknowns the data tell, and a basis of the
    directions along which nothing changes, `(directions, N)`, each of few unknowns."""

    covariance: np.ndarray
    rank: int
    directions: np.ndarray


def gauss_newton(J: np.ndarray, C: np.ndarray) -> Uncertainty:
    r"""Covariance of a linear least-squares fit, `(J^T J)^-1` on the null space of `C`.

    `J` are the derivatives of the weighted residuals, `C` those of equations that hold exactly (the
    gaps of multiple shooting). With `Z` a basis of the null space of `C`, it is
    `Z (Z^T J^T J Z)^-1 Z^T`, from the singular values of `J Z`.

    Source: Seber & Wild, Nonlinear Regression (1989), sections 2.1 and 5.13.
    """
    size = np.linalg.norm(np.concatenate([J, C]), axis=0)
    dead = size <= _SINGULAR * np.max(size, initial=0.0)
    scale = 1 / np.where(dead, 1.0, size)
    J, C = np.where(dead, 0.0, J * scale), np.where(dead, 0.0, C * scale)
    Z = np.eye(J.shape[1])
    if C.size:
        _, s, Vt = np.linalg.svd(C)
        Z = Vt[np.sum(s > 1e-12 * s[0]) :].T
    # The triangle has the same singular values, and the size of the unknowns only.
    _, s, Vt = np.linalg.svd(np.linalg.qr(J @ Z, mode="r"), full_matrices=True)
    s = np.concatenate([s, np.zeros(Vt.shape[0] - s.size)])
    small = s <= _SINGULAR * np.max(s, initial=0.0)
    root = (Z @ Vt.T[:, ~small]) / s[~small] * scale[:, None]
    directions = (Z @ Vt.T[:, small]).T * scale
    return Uncertainty(root @ root.T, int(np.sum(~small)), _sparse(directions))


def _sparse(directions: np.ndarray) -> np.ndarray:
    """Another basis, in which each vector has one unknown for itself: Gauss-Jordan elimination."""
    count = directions.shape[0]
    if count == 0:
        return directions
    R, order = scipy.linalg.qr(directions, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    return np.linalg.solve(R[:, :count], R)[:, np.argsort(order)]  # pyright: ignore[reportArgumentType, reportCallIssue]


def describe(
    direction: np.ndarray, slopes: np.ndarray, names: np.ndarray
) -> tuple[str, np.ndarray]:
    """A line for the report, and which of the `p` parameters are involved.

    Involved are those that change by a twentieth of the largest change; numbers are changes of the
    parameters in their own units (`slopes`: by their unknowns), the largest of them 1."""
    p, size = len(names), np.max(np.abs(direction))
    involved = np.abs(direction[:p]) > 0.05 * size
    change = direction[:p] * np.where(involved, slopes, 0.0)
    largest = change[np.argmax(np.abs(change))] if p else 0.0
    # A fit that has diverged may be where unknowns change their parameters by nothing, or by infinity.
    told = largest != 0 and np.isfinite(largest)
    parts = [
        f"{names[i]} ({change[i] / largest:+.3g})" if told else str(names[i])
        for i in np.flatnonzero(involved)
    ]
    if np.any(np.abs(direction[p:]) > 0.05 * size):
        parts.append("initial states")
    return " with ".join(parts), involved
