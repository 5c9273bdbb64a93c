"""The coordinates in which a step is computed: the state itself, or local coordinates."""

from collections.abc import Callable
from typing import Any, NamedTuple

from diffrax import RESULTS

from ..._base.types import RealScalarLike, Y
from ..._constraint.projection_info import ProjectionInfo


class StepFrame(NamedTuple):
    """The coordinates `w` that one step of a solver advances.

    - `origin`: the coordinates of the state `y0` at which the step begins.
    - `terms`: the differential equation for them, evaluated at stages.
    - `correct`: maps coordinates at the end of the step to the state on the manifold.
    - `pull_back`: `(t, w, y, vector)`, maps a velocity of the state to one of the coordinates.
    - `state`: for dense output, `(y0, w)`: a state near that of the coordinates; `None` if it is
        `w` itself.
    - `error_of_state`: `(w1, y1, error)`, the error estimate of the state from that of the
        coordinates; `None` if they are the same.
    - `verdict`: the result of a step that ends at a state that `correct` does not check.
    """

    origin: Y
    terms: Any
    correct: Callable[[Y], tuple[Y, ProjectionInfo]]
    pull_back: Callable[[RealScalarLike, Y, Y, Y], Y]
    state: Callable[[Y, Y], Y] | None = None
    error_of_state: Callable[[Y, Y, Y], Y] | None = None
    verdict: Callable[[Y], RESULTS] | None = None

    @staticmethod
    def of_state(
        y0: Y,
        terms: Any,
        correct: Callable[[Y], tuple[Y, ProjectionInfo]],
        verdict: Callable[[Y], RESULTS] | None = None,
    ) -> "StepFrame":
        """Use the state as its own coordinates."""
        return StepFrame(y0, terms, correct, lambda t, w, y, vector: vector, verdict=verdict)
