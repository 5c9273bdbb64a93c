"""A solution as it is drawn: its positions, and lines through points of the plane."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np


class DrawnMotion(NamedTuple):
    """Positions `q` at the `times`, with a leading axis for these, the parameters, and the resets of the
    solution, `None` if it has none."""

    times: np.ndarray
    q: Any
    args: Any
    resets: Any = None


Lines: TypeAlias = list[np.ndarray]
# Makes lines `(times, points, 2)` of a motion, one for each body or each chain of rods. Each body is drawn
# from its own coordinates: where joints are violated, bodies do not meet.
Sketch: TypeAlias = Callable[[DrawnMotion], Lines]


def line_through(*points: Any) -> np.ndarray:
    """Return a line through points given as their coordinates, numbers or arrays `(times,)`."""
    places = [np.stack(np.broadcast_arrays(*point), axis=-1) for point in points]
    return np.stack(np.broadcast_arrays(*places), axis=-2)
