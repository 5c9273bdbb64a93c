"""Planar mechanisms of the gallery as lines, one for each body or each chain of rods."""

from collections.abc import Callable
from typing import Any

import numpy as np


# Maps positions `(times, n)` and parameters to lines `(times, points, 2)`. Each body is drawn from its
# own coordinates: where joints are violated, bodies do not meet.
Sketch = Callable[[np.ndarray, Any], list[np.ndarray]]


def _points(*points: Any) -> np.ndarray:
    """Return a line through points given as `(x, y)`, numbers or arrays `(times,)`."""
    pairs = [np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in points]
    return np.stack(np.broadcast_arrays(*pairs), axis=-2)


def _chain(q: np.ndarray, args: Any) -> list[np.ndarray]:
    joints = q.reshape(len(q), -1, 2)
    return [np.concatenate([np.zeros((len(q), 1, 2)), joints], axis=1)]


def _slider_crank(q: np.ndarray, args: Any) -> list[np.ndarray]:
    """Draw the rod from the slider, with length 1."""
    crank, slider, rod = q.T
    a = float(args.crank_length)
    return [
        _points((0 * crank, 0 * crank), (a * np.cos(crank), a * np.sin(crank))),
        _points((slider - np.cos(rod), -np.sin(rod)), (slider, 0 * slider)),
    ]


def _four_bar(q: np.ndarray, args: Any) -> list[np.ndarray]:
    lines = []
    for body, length in enumerate(np.asarray(args.lengths)[:3]):
        x, y, angle = q[:, 3 * body : 3 * body + 3].T
        dx, dy = length / 2 * np.cos(angle), length / 2 * np.sin(angle)
        lines.append(_points((x - dx, y - dy), (x + dx, y + dy)))
    return lines


def _parallelogram(q: np.ndarray, args: Any) -> list[np.ndarray]:
    x, y, tilt, *cranks = q.T
    spacing, length = float(args.spacing), float(args.length)
    pivots = (-spacing, 0.0, spacing)
    coupler = [(x + s * np.cos(tilt), y + s * np.sin(tilt)) for s in pivots]
    hanging = [
        _points((s + 0 * a, 0 * a), (s + length * np.sin(a), -length * np.cos(a)))
        for s, a in zip(pivots, cranks, strict=True)
    ]
    return [_points(*coupler), *hanging]


SKETCHES: dict[str, Sketch] = {
    "pendulum": _chain,
    "double-pendulum": _chain,
    "chain": _chain,
    "slider-crank": _slider_crank,
    "four-bar": _four_bar,
    "parallelogram": _parallelogram,
}
