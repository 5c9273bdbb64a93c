"""Forward mode of many trajectories in lanes: each is advanced together with its tangent."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._base.types import BoolScalar, FloatScalar
from ..._solver.step.hook_state import with_memory
from .functions import begin, save, smooth_part, step_state
from .parts import in_steps, Inputs, Parts
from .rows import like, smooth_rows
from .schedule import Schedule
from .trajectory import Attempt, LaneEquations, LaneOutcome, LaneStart, Trajectory, TrajectoryData


class GivenTangent(NamedTuple):
    """The data that a trajectory has of its own, their tangent, and the trajectory that they define."""

    each: Any
    rest: Any
    tangent: Any
    equations: LaneEquations
    given: TrajectoryData

    @property
    def direction(self) -> FloatScalar:
        return self.given.direction


class Moving(NamedTuple):
    """A trajectory with the tangent of the part that its next step depends on."""

    trajectory: Trajectory
    tangent: Any


class Tangents:
    """The methods of [`LaneEquations`][] for pairs of a value and its tangent, with the same steps."""

    def __init__(self, parts: Parts, common_tangent: Any):
        self.parts, self.common_tangent = parts, common_tangent
        self.saveat, self.lanes = parts.rest.equations.saveat, parts.rest.equations.lanes

    def given(self, of_each: tuple[Any, Any, Any]) -> GivenTangent:
        each, rest, _ = of_each
        return GivenTangent(*of_each, *self.parts.one(each, self.parts.common, rest))

    def _along(self, function: Any, given: GivenTangent, x: Any, dx: Any, *args: Any) -> Any:
        """Differentiate along a tangent: return the results of a function (see `functions.py`), with
        the tangent of its real numbers between them."""
        at, along = (given.each, self.parts.common, x), (given.tangent, self.common_tangent, dx)
        return jax.jvp(self.parts.smooth(function, given.rest, *args), at, along, has_aux=True)

    def begin(self, given: GivenTangent) -> LaneStart:
        _, tangent, start = self._along(begin, given, None, None)
        return start._replace(trajectory=Moving(start.trajectory, tangent))

    def goes_on(self, given: GivenTangent, moving: Moving) -> BoolScalar:
        return given.equations.goes_on(given.given, moving.trajectory)

    def attempt(self, given: GivenTangent, moving: Moving) -> Attempt:
        before = moving.trajectory
        smooth, discrete = eqx.partition(step_state(before), eqx.is_inexact_array)

        def attempt(equations: LaneEquations, given: TrajectoryData, smooth: Any) -> Any:
            y, memory = eqx.combine(smooth, discrete)
            state = with_memory(before.solver_state, memory)
            tried = equations.attempt(given, before._replace(y=y, solver_state=state))
            return (smooth_part(step_state(tried.trajectory)), tried.dense_info), tried

        _, (tangent, dense_tangent), tried = self._along(attempt, given, smooth, moving.tangent)
        after = Moving(tried.trajectory, tangent)
        return tried._replace(trajectory=after, dense_info=(tried.dense_info, dense_tangent))

    def state_of(self, moving: Moving) -> tuple[Any, Any]:
        return moving.trajectory.y, moving.tangent.y

    def interpolated(
        self, t: FloatScalar, start: FloatScalar, end: FloatScalar, dense_info: Any
    ) -> tuple[Any, Any]:
        equations = in_steps(self.parts.rest.equations)
        interpolated = lambda info: equations.interpolated(t, start, end, info)
        info, tangent = dense_info
        return jax.jvp(interpolated, (info,), (tangent,))

    def saved_value(self, given: GivenTangent, t: FloatScalar, y: Any) -> tuple[Any, BoolScalar]:
        _, tangent, (value, success) = self._along(save, given, *y, t)
        return (value, tangent), success

    def outcome(self, given: GivenTangent, moving: Moving) -> tuple[LaneOutcome, Any]:
        return given.equations.outcome(given.given, moving.trajectory), moving.tangent.y


def tangents_in_lanes(
    inputs: Inputs, differentiated: Any, tangents: Any, limit: int
) -> tuple[Any, Any]:
    """Return the tangents of times and values. `tangents` of the inputs are `None` where there are
    none; `differentiated` is a tree of Booleans."""
    parts, along = Parts.of(inputs, differentiated), Parts.of(tangents, differentiated)
    equations = Tangents(parts, along.common)
    given = parts.each, parts.rest_each, along.each
    run = Schedule(equations, given, equations.given, limit).run()
    start, (outcome, last_tangent) = run.start.trajectory, run.outcome
    values, values_tangent = run.values or (None, None)
    if values is not None:
        reached = jnp.arange(equations.saveat.subs.ts.size)[None] < run.rows[:, None]
        values_tangent = jtu.tree_map(lambda x: jnp.where(like(reached, x), x, 0), values_tangent)
    saved, smooth = smooth_rows(parts, run.rows, outcome.t, values)
    at = parts.each, parts.common, start.trajectory.y, outcome.y, smooth
    along = along.each, along.common, start.tangent.y, last_tangent, values_tangent
    return jax.jvp(saved, at, along)[1]
