"""The parts of a solve as functions that can be differentiated.

Each is a `function(equations, given, x, ...)`, with `x` the state on which steps depend, and returns
the differentiable part of its results, and all results.
"""

from typing import Any

import equinox as eqx

from ..._adjoint.replay import Solve, State
from ..._base.compat import directed
from ..._base.types import FloatScalar
from ..._solver.step.hook_state import memory_of
from .trajectory import LaneEquations, Trajectory, TrajectoryData


def step_state(trajectory: Trajectory) -> State:
    """Return the part of a trajectory that a step depends on: the state, and the solver's memory."""
    return State(trajectory.y, memory_of(trajectory.solver_state))


def smooth_part(tree: Any) -> Any:
    """Return the leaves with respect to which a step has derivatives; the others are `None`."""
    return eqx.filter(tree, eqx.is_inexact_array)


def begin(equations: LaneEquations, given: TrajectoryData, x: None) -> tuple[Any, Any]:
    """Return the state before the first step; and the start."""
    start = equations.begin(given)
    return smooth_part(step_state(start.trajectory)), start


def step(
    equations: LaneEquations,
    given: TrajectoryData,
    smooth: State,
    rest: State,
    solver_state: Any,
    *ends: Any,
) -> tuple[Any, Any]:
    """Return the state after a step and the data of its interpolation; and these data. `solver_state`
    is an example, for the parts that are not in the solver's memory."""
    terms, (start, end) = directed(equations.terms, given.direction), ends
    solve = Solve(terms, equations.solver, given.args, solver_state, remembers=True, jumps=False)
    after, dense_info = solve.attempt(start, end, False, eqx.combine(smooth, rest))
    return (smooth_part(after), dense_info), dense_info


def interpolate(
    equations: LaneEquations,
    given: TrajectoryData,
    dense_info: Any,
    t: FloatScalar,
    start: FloatScalar,
    end: FloatScalar,
) -> tuple[Any, None]:
    """Return the state at a time in a step."""
    return equations.interpolated(t, start, end, dense_info), None


def save(
    equations: LaneEquations, given: TrajectoryData, y: Any, t: FloatScalar
) -> tuple[Any, Any]:
    """Return the saved value of a state at time `t`; and whether it is on the manifold."""
    value, success = equations.saved_value(given, t, y)
    return smooth_part(value), (value, success)
