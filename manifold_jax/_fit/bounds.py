"""Parameters that the data drive to a bound.

Each step of the unknowns leaves a fraction of the distance to the bound, so the optimizer would never
arrive. Such parameters are put on their bound, where nothing depends on their unknowns any more, and
the others go on: an active set (Nocedal & Wright, Numerical Optimization, ch. 16).
"""

from typing import Any

import numpy as np

from .objective import Objective, Solved, stacked, Unknowns
from .parameters import LARGEST, Transform


# The distance to a bound, as a fraction of that at the start, at which a parameter is tested by
# derivatives, and at which it is put on the bound without derivatives.
_NEAR, _NEXT_TO = 1e-2, 1e-3
# The same fraction, at which derivatives decide whether a parameter belongs on its bound.
BESIDE = 1e-6


def at_bounds(u: Unknowns, solved: Solved, objective: Objective) -> np.ndarray:
    """Return which parameters ended at the lower (-1) or the upper bound (1), shape `(p,)`."""
    if objective.loss is not None or solved.matrices is None:
        return _near(u, objective.transform, _NEXT_TO)
    return driven(u, solved, objective)


def driven(u: Unknowns, solved: Solved, objective: Objective) -> np.ndarray:
    """Return which parameters are on a bound, or near one that they would reach if the problem were
    linear, shape `(p,)`."""
    side = _near(u, objective.transform, _NEAR)
    if objective.loss is not None or solved.matrices is None or not np.any(side):
        return np.zeros_like(side)
    onwards = side * linear_step(u, solved, objective)[: side.size]
    # Near a bound, the unknown is the logarithm of the distance.
    return np.where((onwards >= 0.9) | (on_bounds(u, objective.transform) != 0), side, 0)


def on_bounds(u: Unknowns, transform: Transform) -> np.ndarray:
    """Return which parameters have been put on a bound, shape `(p,)`."""
    held = np.abs(np.asarray(u[: transform.start.size])) > LARGEST
    return np.where(held, _near(u, transform, _NEXT_TO), 0)


def put_on_bounds(u: Unknowns, side: np.ndarray) -> Unknowns:
    which = np.flatnonzero(side)
    return u.at[which].set(2 * LARGEST * side[which])


def put_beside_bounds(u: Unknowns, side: np.ndarray, left: Any, transform: Transform) -> Unknowns:
    """Return the unknowns with the fraction `left` of the distance from the start to the bound."""
    s, a, b = (np.asarray(x) for x in (transform.start, transform.lower, transform.upper))
    width = np.where(np.isfinite(b - a), b - a, 1.0)
    other = np.where(np.isfinite(b - a), np.where(side < 0, b - s, s - a), 1.0)
    which = np.flatnonzero(side)
    return u.at[which].set((-side * np.log(left * other / width))[which])


def _near(u: Unknowns, transform: Transform, left: float) -> np.ndarray:
    start = np.asarray(transform.start)
    side = np.zeros(start.shape, int)
    # The distance is at least `exp(-abs(u))` of that from the start.
    if np.all(np.abs(np.asarray(u[: start.size])) < -np.log(left)):
        return side
    theta = np.asarray(transform.values(u))
    for sign, bound in ((-1, np.asarray(transform.lower)), (1, np.asarray(transform.upper))):
        near = np.abs(theta - bound) <= left * np.abs(start - bound)
        side = np.where(np.isfinite(bound) & near, sign, side)
    return side


def linear_step(u: Any, solved: Solved, objective: Objective) -> np.ndarray:
    """Return the Gauss-Newton step, shape `(N,)`."""
    J, r = stacked(u, solved, objective)
    size = np.linalg.norm(J, axis=0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(J / size, -r, rcond=1e-6)[0] / size
