"""Standard errors from the Gauss-Newton matrix, and what the data do not determine."""

from typing import NamedTuple

import numpy as np


# Derivatives are as accurate as the solver's tolerance; singular values below this fraction of
# the largest, after columns are scaled to length 1, are not told from zero.
_SINGULAR = 1e-6


class Uncertainty(NamedTuple):
    """Covariance `(N, N)` for noise of size 1, `N - rank` of the unknowns, and the directions
    `(directions, N)`, scaled to largest component 1, along which nothing changes."""

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
    _, s, Vt = np.linalg.svd(J @ Z, full_matrices=True)
    s = np.concatenate([s, np.zeros(Vt.shape[0] - s.size)])
    small = s <= _SINGULAR * np.max(s, initial=0.0)
    root = (Z @ Vt.T[:, ~small]) / s[~small] * scale[:, None]
    directions = (Z @ Vt.T[:, small]).T * scale
    largest = np.argmax(np.abs(directions), axis=1)[:, None]
    directions = directions / np.take_along_axis(directions, largest, axis=1)
    return Uncertainty(root @ root.T, int(np.sum(~small)), directions)


def describe(direction: np.ndarray, names: tuple[str, ...]) -> tuple[str, np.ndarray]:
    """A line for the report, and which of the parameters are involved."""
    p = len(names)
    involved = np.abs(direction[:p]) > 0.05
    parts = [f"{names[i]} ({direction[i]:+.2f})" for i in np.flatnonzero(involved)]
    if np.any(np.abs(direction[p:]) > 0.05):
        parts.append("initial states")
    return " with ".join(parts), involved
