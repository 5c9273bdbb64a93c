"""One trajectory as functions of arrays: its start, one attempted step, a value inside it.

The loop of `diffrax.diffeqsolve`, taken apart through the public methods of solvers and controllers, so
that another loop can advance many trajectories.
"""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jax import lax
from jaxtyping import Array

from ..._base.compat import directed, is_okay, nonlinear_failure, update_result
from ..._base.rejection import result_of_state
from ..._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from ..._solve.prepare import prepare
from ..._solve.setup import Consistent, ProblemData, Setup
from ..._solve.times import is_time_missing
from ..._solver.step.hook_state import HookState, StepStatistics


class Trajectory(NamedTuple):
    """The state of a trajectory between two steps, with times that increase."""

    tprev: FloatScalar
    tnext: FloatScalar
    y: Y
    solver_state: HookState
    controller_state: Any
    result: RESULTS
    num_steps: IntScalar
    num_accepted: IntScalar


class TrajectoryData(NamedTuple):
    """The data that define a trajectory, besides those that all have in common."""

    t0: FloatScalar
    t1: FloatScalar
    y0: Y
    args: Args
    end_floor: FloatScalar  # see [`end_floor`][]

    @property
    def direction(self) -> FloatScalar:
        return jnp.where(self.t0 < self.t1, 1, -1).astype(self.t0.dtype)


class LaneStart(NamedTuple):
    trajectory: Trajectory
    correction: FloatScalar


class Attempt(NamedTuple):
    """The result of a step: the trajectory after it, whether it was kept, and its interpolation."""

    trajectory: Trajectory
    kept: BoolScalar
    start: FloatScalar
    end: FloatScalar
    dense_info: Any


class LaneOutcome(NamedTuple):
    """The end of a trajectory."""

    t: FloatScalar
    y: Y
    result: RESULTS
    num_steps: IntScalar
    num_accepted: IntScalar
    statistics: StepStatistics


class LaneEquations(eqx.Module):
    """The settings that all trajectories have in common."""

    terms: dfx.AbstractTerm
    solver: Any  # in lanes one of this library, else any of Diffrax
    controller: dfx.AbstractStepSizeController
    saveat: dfx.SaveAt
    dt0: RealScalarLike | None
    adjoint: dfx.AbstractAdjoint
    max_steps: int = eqx.field(static=True)
    lanes: int = eqx.field(static=True)  # how many trajectories advance together
    consistent: Consistent = eqx.field(static=True)
    event: dfx.Event | None = None  # not in lanes, as the resets
    resets: Any = ()
    max_resets: int = eqx.field(static=True, default=100)

    def begin(self, given: TrajectoryData) -> LaneStart:
        solver, args = self.solver, given.args
        settings = self.dt0, self.saveat, self.controller, self.consistent
        data = ProblemData(given.t0, given.t1, given.y0, args)
        ready = prepare(Setup(self.terms, solver, *settings, throw=False), data)
        direction = given.direction
        terms = directed(self.terms, direction)
        t0, t1, y0, _ = ready.data
        t0, t1 = t0 * direction, t1 * direction
        dt0 = None if ready.dt0 is None else ready.dt0 * direction
        error_order = solver.error_order(terms)
        tnext, controller_state = self.controller.wrap(direction).init(
            terms, t0, t1, y0, dt0, args, solver.func, error_order
        )
        tnext = jnp.minimum(tnext, t1)
        solver_state = ready.solver_state
        if solver_state is None:
            solver_state = solver.init(terms, t0, tnext, y0, args)
        result = RESULTS.where(ready.start.success, RESULTS.successful, nonlinear_failure())
        result = update_result(result, result_of_state(y0))
        missing = is_time_missing(given.t0, given.t1)
        result = RESULTS.where(missing, RESULTS.nonfinite_input, result)  # pyright: ignore[reportArgumentType]
        zero = jnp.zeros((), jnp.int32)
        trajectory = Trajectory(t0, tnext, y0, solver_state, controller_state, result, zero, zero)
        return LaneStart(trajectory, ready.start.correction)

    def goes_on(self, given: TrajectoryData, trajectory: Trajectory) -> BoolScalar:
        before = trajectory.tprev < given.t1 * given.direction
        return before & is_okay(trajectory.result) & (trajectory.num_steps < self.max_steps)

    def attempt(self, given: TrajectoryData, trajectory: Trajectory) -> Attempt:
        solver, direction = self.solver, given.direction
        terms, t1 = directed(self.terms, direction), given.t1 * direction
        before, end = trajectory, trajectory.tnext
        y, error, dense_info, solver_state, solver_result = solver.step(
            terms, before.tprev, end, before.y, given.args, before.solver_state, False
        )
        error = jtu.tree_map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error)
        controller, of_step = self.controller.wrap(direction), (before.tprev, end, before.y, y)
        kept, tprev, tnext, _, controller_state, result = controller.adapt_step_size(
            *of_step, given.args, error, solver.error_order(terms), before.controller_state
        )
        kept = jnp.asarray(kept)
        tprev = jnp.minimum(tprev, t1)
        # A step that ends just before the end would leave one of a few rounding errors.
        last = jnp.where(kept, t1, tprev + 0.5 * (t1 - tprev))
        tnext = jnp.where(tnext > given.end_floor, last, tnext)
        keep = lambda a, b: jnp.where(kept, a, b)
        result = update_result(RESULTS.where(kept, solver_result, RESULTS.successful), result)
        after = Trajectory(
            tprev,
            tnext,
            jtu.tree_map(keep, y, before.y),
            jtu.tree_map(keep, solver_state, before.solver_state),
            controller_state,
            update_result(before.result, result),
            before.num_steps + 1,
            before.num_accepted + jnp.where(kept, 1, 0),
        )
        return Attempt(after, kept, before.tprev, end, dense_info)

    def state_of(self, trajectory: Trajectory) -> Y:
        return trajectory.y

    def interpolated(
        self, t: FloatScalar, start: FloatScalar, end: FloatScalar, dense_info: Any
    ) -> Y:
        """Return the state inside a step, as the solver interpolates it. Times increase."""
        return self.solver.interpolation_cls(t0=start, t1=end, **dense_info).evaluate(t)

    def saved_value(self, given: TrajectoryData, t: FloatScalar, y: Y) -> tuple[Any, BoolScalar]:
        """Return the saved value of such a state, and whether it is on the manifold, at the true time."""
        success = jnp.asarray(True)
        if self.solver.corrects_output:
            y, info = self.solver.correct(t, y, given.args)
            success = info.success
            y = jtu.tree_map(lambda leaf: jnp.where(success, leaf, jnp.nan), y)
        return self.saveat.subs.fn(t, y, given.args), success

    def outcome(self, given: TrajectoryData, trajectory: Trajectory) -> LaneOutcome:
        result = trajectory.result
        unfinished = (trajectory.tprev < given.t1 * given.direction) & is_okay(result)
        result = RESULTS.where(unfinished, RESULTS.max_steps_reached, result)
        result = update_result(result, trajectory.solver_state.result)
        t = trajectory.tprev * given.direction
        counts = trajectory.num_steps, trajectory.num_accepted
        return LaneOutcome(t, trajectory.y, result, *counts, trajectory.solver_state.statistics)


def end_floor(t0: Array, t1: Array) -> Array:
    """Return the hundredth floating-point number before `t1`, in increasing time: steps that would end
    after it end at `t1`, as in `diffrax.diffeqsolve`. Counted in the integers of their bits."""
    end = lax.stop_gradient(jnp.where(t0 < t1, t1, -t1))
    tiny = jnp.finfo(end.dtype).tiny  # XLA flushes smaller numbers to zero
    first = jnp.where(end == 0, -tiny, jnp.nextafter(end, -jnp.inf))
    bits = lax.bitcast_convert_type(first, f"int{8 * end.dtype.itemsize}")
    bits = jnp.where(first > 0, bits - 99, bits + 99)
    return lax.bitcast_convert_type(bits, end.dtype)
