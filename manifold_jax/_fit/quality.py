"""How well the model fits the data, and how well they determine its parameters."""

from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from .bounds import at_bounds
from .data import Records
from .objective import linearize, Objective, Solved, weighted
from .uncertainty import describe, gauss_newton


class Quality(NamedTuple):
    """`None` where it cannot be told: with a `loss` of one's own, or without data to spare.

    `chi_squared` needs a `sigma` that is known, `covariance` derivatives. `at_bounds` has -1 for a
    parameter at its lower bound and 1 at the upper, `(p,)`."""

    covariance: np.ndarray | None
    noise: float | None
    chi_squared: float | None
    degrees_of_freedom: int | None
    unidentifiable: tuple[str, ...]
    at_bounds: np.ndarray


def judge(
    u: Any, solved: Solved, objective: Objective, records: Records, absolute: bool
) -> Quality:
    """Judge a fit from the residuals of records that were solved; `absolute`: whether `sigma` is
    known."""
    side = at_bounds(u, solved, objective)
    if objective.loss is not None:
        return Quality(None, None, None, None, (), side)
    failed = np.asarray(solved.values.failed) > 0
    used = (np.asarray(objective.pieces.weights) > 0) & ~failed[:, None, None]
    squares = float(np.sum(np.asarray(weighted(objective, solved.values))[used] ** 2))
    # What is held at a bound is no unknown.
    free = np.concatenate([side == 0, np.ones(u.size - side.size, bool)])
    covariance, rank, lines = None, int(np.sum(free)), ()
    if solved.matrices is not None:
        covariance, rank, lines = _determined(u, solved, objective, used, free)
    freedom = int(np.sum(used)) - rank
    if freedom <= 0:
        return Quality(covariance if absolute else None, None, None, None, lines, side)
    noise = np.sqrt(squares / freedom)
    if absolute:
        return Quality(covariance, float(noise), squares, freedom, lines, side)
    scaled = None if covariance is None else noise**2 * covariance
    return Quality(scaled, float(noise / np.max(records.weights)), None, None, lines, side)


def _determined(
    u: Any, solved: Solved, objective: Objective, used: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, int, tuple[str, ...]]:
    """The covariance of the parameters for `sigma` as given, how many unknowns the data determine, and
    the directions that they do not."""
    linear = jtu.tree_map(np.asarray, linearize(u, solved, objective))
    names, p = np.asarray(objective.transform.names), linear.slopes.size
    found = gauss_newton(linear.J[used][:, free], linear.C.reshape(-1, u.size)[:, free])
    own = free[:p]
    slopes, inner = linear.slopes[own], np.count_nonzero(own)
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
