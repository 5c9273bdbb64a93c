"""Quality of a fit: how well the model fits the data, and standard errors from the Gauss-Newton matrix."""

from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np
import scipy.linalg

from .bounds import at_bounds
from .data import Records
from .objective import linearize, Objective, Solved, weighted


# Derivatives are as accurate as the solver's tolerance: singular values below this fraction of the
# largest, after scaling columns to length 1, count as zero.
_SINGULAR = 1e-6


class Quality(NamedTuple):
    """The fields of the same names in [`FitResult`][]; `None` where unknown: with a user's `loss`, or
    if no data are left to estimate them."""

    covariance: np.ndarray | None
    noise: float | None
    chi_squared: float | None
    degrees_of_freedom: int | None
    unidentifiable: tuple[str, ...]
    at_bounds: tuple[str, ...]


def judge(u: Any, solved: Solved, objective: Objective, records: Records) -> Quality:
    """Judge a fit from the residuals of records that were solved."""
    side = at_bounds(u, solved, objective)
    names = tuple(name for name, s in zip(objective.transform.names, side, strict=True) if s)
    if objective.loss is not None:
        return Quality(None, None, None, None, (), names)
    failed = np.asarray(solved.values.failed) > 0
    used = (np.asarray(objective.pieces.weights) > 0) & ~failed[:, None, None]
    squares = float(np.sum(np.asarray(weighted(objective, solved.values))[used] ** 2))
    # A parameter held at a bound is not an unknown.
    free = np.concatenate([side == 0, np.ones(u.size - side.size, bool)])
    covariance, rank, lines = None, int(np.sum(free)), ()
    if solved.matrices is not None:
        covariance, rank, lines = _determined(u, solved, objective, used, free)
    freedom = int(np.sum(used)) - rank
    if freedom <= 0:
        return Quality(covariance if records.absolute else None, None, None, None, lines, names)
    noise = np.sqrt(squares / freedom)
    if records.absolute:
        return Quality(covariance, float(noise), squares, freedom, lines, names)
    scaled = None if covariance is None else noise**2 * covariance
    return Quality(scaled, float(noise / np.max(records.weights)), None, None, lines, names)


def _determined(
    u: Any, solved: Solved, objective: Objective, used: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, int, tuple[str, ...]]:
    """Return the covariance of the parameters for `sigma` as given, how many unknowns the data
    determine, and the directions that they do not."""
    linear = jtu.tree_map(np.asarray, linearize(u, solved, objective))
    names, p = np.asarray(objective.transform.names), linear.slopes.size
    large = large_changes(u, objective)
    linear = linear._replace(J=linear.J * large, C=linear.C * large)
    moves = free & has_effect(linear, solved.values.observed, objective, used)
    J, C = (np.where(moves, matrix, 0.0)[..., free] for matrix in (linear.J, linear.C))
    found = gauss_newton(J[used], np.concatenate([J[used][:0], *C]))
    own = free[:p]
    slopes, inner = (linear.slopes * large[:p])[own], np.count_nonzero(own)
    block = found.covariance[:inner, :inner] * slopes[:, None] * slopes
    lines = []
    for direction in found.directions:
        line, involved = describe(direction, slopes, names[own])
        lines.append(line)
        block[involved], block[:, involved] = 0.0, 0.0
        block[involved, involved] = np.inf
    covariance = np.full((p, p), np.nan)
    covariance[np.ix_(own, own)] = block
    return covariance, found.rank, tuple(lines)


def large_changes(u: Any, objective: Objective) -> np.ndarray:
    """Return changes of the unknowns with which their effects can be compared whatever the units and the
    start values are: for parameters without bounds their start value, or the final one if they have grown,
    and for tangent coordinates of initial states the size of the states."""
    transform, pieces = objective.transform, objective.pieces
    start, theta = np.asarray(transform.start), np.abs(np.asarray(transform.values(u)))
    bounded = np.isfinite(transform.lower) | np.isfinite(transform.upper)
    grown = theta / np.where(start == 0, 1.0, np.abs(start))
    parameters = np.where(bounded | ~np.isfinite(grown), 1.0, np.maximum(grown, 1.0))
    basis = np.abs(np.asarray(pieces.basis))[np.asarray(objective.free)]
    sizes = np.max(np.abs(np.asarray(pieces.guess)), axis=0)
    states = np.max(basis * sizes[:, None], axis=1, initial=0.0).ravel()
    return np.concatenate([parameters, np.where(states > 0, states, 1.0)])


def has_effect(linear: Any, observed: Any, objective: Objective, used: np.ndarray) -> np.ndarray:
    """Return which unknowns change any prediction or gap by more than its rounding, `(N,)`. Weights do not
    matter: that one quantity is measured precisely says nothing about what others depend on, nor does
    an offset that is large."""
    weights = np.where(used, np.asarray(objective.pieces.weights), 1.0)
    measured = np.where(used[..., None], linear.J / weights[..., None], 0.0)
    size = np.max(np.abs(np.where(used, np.asarray(observed), 0.0)), axis=1)
    noticed = lambda effects, rounding: np.any(effects > rounding, axis=(0, 1))
    rounding = 100 * np.finfo(size.dtype).eps * size[..., None]
    of_data = noticed(np.max(np.abs(measured), axis=1), rounding)
    # The state where a gap is has an effect of the size of the state, far above rounding.
    return of_data | noticed(np.abs(linear.C), 0.0)


class Uncertainty(NamedTuple):
    """Covariance `(N, N)` for noise of size 1, the number of unknowns that the data determine, and a
    basis of the directions that they do not, `(directions, N)`, each with few unknowns."""

    covariance: np.ndarray
    rank: int
    directions: np.ndarray


def gauss_newton(J: np.ndarray, C: np.ndarray) -> Uncertainty:
    r"""Return the covariance of a linear least-squares fit, `(J^T J)^-1` on the null space of `C`.

    `J` are the derivatives of the weighted residuals, `C` those of equations that hold exactly (the
    gaps of multiple shooting). With `Z` a basis of the null space of `C`, it is
    `Z (Z^T J^T J Z)^-1 Z^T`, from the singular values of `J Z`.

    Source: Seber & Wild, Nonlinear Regression (1989), sections 2.1 and 5.13.
    """
    size = np.linalg.norm(np.concatenate([J, C]), axis=0)
    scale = 1 / np.where(size == 0, 1.0, size)
    J, C = J * scale, C * scale
    Z = scipy.linalg.null_space(C, rcond=1e-12) if C.size else np.eye(J.shape[1])
    # The triangular factor has the same singular values, and the size of the unknowns only.
    _, s, Vt = np.linalg.svd(np.linalg.qr(J @ Z, mode="r"), full_matrices=True)
    s = np.concatenate([s, np.zeros(Vt.shape[0] - s.size)])
    small = s <= _SINGULAR * np.max(s, initial=0.0)
    root = (Z @ Vt.T[:, ~small]) / s[~small] * scale[:, None]
    directions = (Z @ Vt.T[:, small]).T * scale
    return Uncertainty(root @ root.T, int(np.sum(~small)), _sparse(directions))


def _sparse(directions: np.ndarray) -> np.ndarray:
    """Return another basis, in which each vector has one unknown to itself (Gauss-Jordan elimination)."""
    count = directions.shape[0]
    if count == 0:
        return directions
    R, order = scipy.linalg.qr(directions, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    return np.linalg.solve(R[:, :count], R)[:, np.argsort(order)]  # pyright: ignore[reportArgumentType, reportCallIssue]


def describe(
    direction: np.ndarray, slopes: np.ndarray, names: np.ndarray
) -> tuple[str, np.ndarray]:
    """Describe a direction in a line of the report; return also which of the `p` parameters are
    involved.

    Those are involved that change by a twentieth of the largest change; numbers are changes of the
    parameters in their own units (`slopes`: with respect to their unknowns), the largest of them 1.
    """
    p, size = len(names), np.max(np.abs(direction))
    involved = np.abs(direction[:p]) > 0.05 * size
    change = direction[:p] * np.where(involved, slopes, 0.0)
    largest = change[np.argmax(np.abs(change))] if p else 0.0
    # After divergence, unknowns may change their parameters by nothing, or by infinity.
    told = largest != 0 and np.isfinite(largest)
    parts = [
        f"{names[i]} ({change[i] / largest:+.3g})" if told else str(names[i])
        for i in np.flatnonzero(involved)
    ]
    if np.any(np.abs(direction[p:]) > 0.05 * size):
        parts.append("initial states")
    return " with ".join(parts), involved
