"""A solve with resets: the loop around the solver and the controller, and the report of the resets."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS

from .._base.compat import use_stepsize_tol
from .._base.types import BoolScalar, Y
from .._resets.conditions import Conditions
from .._resets.controller import ResettingController, ResettingState
from .._resets.reset import Reset, ResetAt, TIME_IS_NAN
from .._resets.solver import ResetState, Resetting
from .._resets.terminating import TerminatingEvents
from .finish import finish
from .prepare import Ready
from .setup import Setup
from .solution import Solution


_TRUE_AT_START = (
    "A Boolean `condition` in `resets` is true at `t0`, but an event is where it becomes true. Make the jump in `y0` if it "
    "is meant to happen at the start, or write a condition that is false there."
)

TOO_MANY_RESETS = (
    "There were more events than `max_resets`. If they come closer and closer to each other (a bouncing ball at rest), "
    "let a terminating `event` or another condition take over; otherwise increase `max_resets`."
)
NO_STATE_AFTER = (
    "The state that a `jump` in `resets` returned is not finite, or could not be moved onto the manifold: no nearby state "
    "satisfies the equations of `constraint`. Return a state that does."
)


class LoopArguments(NamedTuple):
    """What Diffrax is given for a solve, and whether a known time of `resets` is NaN."""

    solver: dfx.AbstractSolver
    controller: dfx.AbstractStepSizeController
    saveat: dfx.SaveAt
    solver_state: Any
    y0: Y
    is_time_nan: BoolScalar | bool = False


def with_resets(
    run: LoopArguments,
    resets: Sequence[Reset | ResetAt],
    max_resets: int,
    setup: Setup,
    ready: Ready,
    event: dfx.Event | None,
) -> LoopArguments:
    """Return what Diffrax is given for a solve with resets, which ends with `event`."""
    t0, t1, _, args = ready.data
    dtype = jnp.result_type(ready.data.direction)
    y0 = jtu.tree_map(jnp.asarray, run.y0)
    t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    conditions = Conditions.of(resets, t0, y0, args)
    if setup.throw and any(conditions.is_boolean):
        y0 = eqx.error_if(y0, jnp.any(conditions.true_at_start(t0, y0)), _TRUE_AT_START)
    is_time_nan = conditions.is_time_nan  # such a solve ends before its first step, as one from NaN
    y0 = jtu.tree_map(lambda leaf: jnp.where(is_time_nan, jnp.nan, leaf), y0)
    # Room for known times besides, as their number is known.
    room = max_resets + conditions.num_known_times
    direction = ready.data.direction
    inner = _with_tolerances(run.solver, run.controller)
    terminating = None if event is None else TerminatingEvents(event, args)
    ends = t0 * direction, t1 * direction
    solver = Resetting(inner, conditions, terminating, *ends, room)
    state = None if run.solver_state is None else solver.starting(run.solver_state)
    controller = ResettingController(run.controller, room)
    saveat = eqx.tree_at(lambda s: (s.solver_state, s.controller_state), run.saveat, (True, True))
    return LoopArguments(solver, controller, saveat, state, y0, is_time_nan)


def _with_tolerances(solver: Any, controller: Any) -> Any:
    """Return an implicit solver with the tolerances of the controller, as Diffrax does for controllers
    that it knows."""
    if not isinstance(solver, dfx.AbstractImplicitSolver):
        return solver
    names = ("rtol", "atol", "norm")
    open_ = [n for n in names if getattr(solver.root_finder, n) is use_stepsize_tol]
    if not open_ or not hasattr(controller, "rtol"):
        return solver
    where = lambda s: [getattr(s.root_finder, name) for name in open_]
    return eqx.tree_at(where, solver, [getattr(controller, name) for name in open_])


def finish_resets(
    setup: Setup,
    ready: Ready,
    sol: dfx.Solution,
    is_time_nan: BoolScalar | bool,
    constraint: Any,
    keeps_controller_state: bool,
) -> Solution:
    """Report a solve with resets."""
    state, controller_state = sol.solver_state, sol.controller_state
    assert isinstance(state, ResetState)
    assert isinstance(controller_state, ResettingState)
    resets = controller_state.record.read(ready.data.direction)
    where = lambda s: (s.solver_state, s.controller_state)
    kept = controller_state.inner if keeps_controller_state else None
    sol = eqx.tree_at(where, sol, (state.inner, kept), is_leaf=lambda x: x is None)
    stats = {**sol.stats, "num_nondifferentiable_resets": state.history.irregular}
    result = RESULTS.where(is_time_nan, RESULTS.nonfinite_input, sol.result)  # pyright: ignore[reportArgumentType]
    sol = eqx.tree_at(lambda s: (s.stats, s.result), sol, (stats, result))
    too_many = controller_state.record.number > resets.times.size
    faults = [(too_many, TOO_MANY_RESETS), (state.history.failed, NO_STATE_AFTER)]
    faults.append((jnp.asarray(is_time_nan), TIME_IS_NAN))
    sol = finish(setup, ready, sol, constraint, faults)
    if not setup.saveat.solver_state:
        sol = eqx.tree_at(lambda s: s.solver_state, sol, None, is_leaf=lambda x: x is None)
    return Solution.of(sol, resets)
