"""The front end: `diffrax.diffeqsolve` plus what a solver cannot do on its own."""

from typing import Any

import diffrax as dfx
import equinox as eqx

from .._adjoint import CheckedStartAdjoint, LocatingAdjoint, StepReplayAdjoint
from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, RealScalarLike, Terms, Y
from .._base.user_functions import evaluated
from .._constraint.checks import check_leaves
from .._resets.reset import check_resets
from .._solver.base import AbstractManifoldSolver
from .._solver.step.implicit import with_accurate_stages, with_tolerances_of_stages
from .._solver.terms import traced_once
from .arguments import (
    check_arguments,
    check_field,
    check_max_steps,
    check_shape_of_tolerances,
    raise_if_unstable,
    warn_of_rounding,
    warn_of_unknown_hook,
    with_positive_tolerance,
    without_idle_hook,
)
from .finish import finish
from .given_numbers import checking_numbers
from .mass_matrix import trusting
from .output import events_in_true_time, saving
from .prepare import prepare, time_dtype
from .resets import finish_resets, LoopArguments, with_resets
from .setup import Consistent, ProblemData, Setup
from .solution import Solution
from .times import refusing_missing_times


@clear_errors
@checking_numbers()
@numbers_as_arrays("y0", "args", times=("t0", "t1", "dt0"))
@eqx.filter_jit
@refusing_missing_times
def diffeqsolve(
    terms: Terms,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike | None,
    y0: Y,
    args: Args = None,
    *,
    saveat: dfx.SaveAt = dfx.SaveAt(t1=True),
    stepsize_controller: dfx.AbstractStepSizeController = dfx.ConstantStepSize(),
    adjoint: dfx.AbstractAdjoint = StepReplayAdjoint(),
    event: dfx.Event | None = None,
    max_steps: int | None = 4096,
    throw: bool = True,
    progress_meter: dfx.AbstractProgressMeter = dfx.NoProgressMeter(),
    solver_state: Any = None,
    controller_state: Any = None,
    made_jump: Any = None,
    consistent: Consistent = "project",
    resets: Any = (),
    max_resets: int = 100,
) -> Solution:
    """Solve a differential equation on a manifold.

    Takes the arguments of `diffrax.diffeqsolve` and returns its `Solution`. In addition the
    initial value is made consistent, and every value returned is on the manifold: saved values, the
    dense solution `sol.evaluate`, the arguments of `SaveAt(fn=...)` and of event functions, and the
    state at an event.

    **Arguments:** as `diffrax.diffeqsolve`, and

    - `solver`: [`Projected`][] or another solver of this library; if its constraint has no equations the
        solver inside it is used alone. (Any other solver of Diffrax is used as it is, for comparisons,
        also with implicit stages solved to round-off.) [`Rodas5P`][], [`Rodas3P`][] and
        [`RadauIIA5`][], alone or wrapped, for stiff equations; they take a [`MassMatrixTerm`][].
    - `dt0`: `None` with an adaptive controller chooses the first step from the vector field
        (Hairer, Norsett & Wanner, Solving ODEs I, II.4).
    - `consistent`: what to do with `y0`. `"project"` moves it onto the manifold, `"check"`
        refuses it if it is not there (to `tolerance`), `"assume"` trusts it. The same for the
        algebraic equations of a [`MassMatrixTerm`][], which is checked to half of the digits.
    - `event`: event functions get the true time, also when integrating backwards. With a root
        finder the earliest event ends the solve, whatever the order of `cond_fn`.
    - `adjoint`: how derivatives are computed, by default in both modes by [`StepReplayAdjoint`][], from
        the steps that were made. Diffrax's own adjoints compute steps again, which round differently
        and get other sizes: with tight tolerances their gradients are less accurate than the solution.

    - `resets`: jumps of the state at events ([`Reset`][]) or at known times ([`ResetAt`][]), a tuple. The
        solution then has `sol.resets` ([`Resets`][]). Dense output and saved values are those
        between the jumps; at a time of a jump the one after it is saved. Events from `t1` on are not met.
    - `max_resets`: room is made for so many jumps, and for one more at each known time of [`ResetAt`][].
        Another jump beyond all of these ends the solve with `RESULTS.max_steps_reached`.

    Python floats in `y0` and `args`, and all numbers in `t0`, `t1` and `dt0`, become arrays: other values do
    not cause another compilation. Integers in `args`, which may be shapes, and tolerances are part of the
    compiled program; pass `jnp.asarray(...)` if they vary.

    **Returns:**

    A [`Solution`][]; `sol.stats` has in addition to what Diffrax reports

    - `initial_correction`: the distance by which `y0` was moved, the largest `|change| / (|y0| + 1)`;
    - `num_projection_iterations`: Newton iterations over all accepted steps;
    - `largest_correction`: the largest such correction of an accepted step;
    - `correction_share`: with [`Projected`][] the fraction of the steps that the corrections undid,
        their sum over that of the displacements. For a tangent field it is as small as the tolerance;
        otherwise see [`tangent_field`][].
    - `num_nondifferentiable_resets`, with `resets`: how many of them have no derivative, because a
        condition only touches zero, or crosses it at the time of another event.

    **Raises:**

    `TypeError` or `ValueError` for invalid arguments. With `throw=True` a `RuntimeError` if the solve
    fails; with `throw=False` look at `sol.result`: `RESULTS.nonlinear_divergence` means that a constraint
    could not be satisfied or was NaN, `RESULTS.nonfinite_input` that a time was NaN, and
    `RESULTS.nonfinite` that a state became NaN or infinite otherwise, with a constant step size also for
    a solver of Diffrax alone.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193.
    """
    check_arguments(terms, solver, dt0, saveat, stepsize_controller, adjoint, event, consistent)
    check_leaves(y0, "y0")
    check_field(terms, t0, y0, args)
    check_shape_of_tolerances(stepsize_controller, y0)
    check_max_steps(max_steps)
    check_resets(resets, max_resets, controller_state)
    warn_of_rounding(y0, time_dtype(t0, t1, dt0, saveat), stepsize_controller)
    stepsize_controller = with_positive_tolerance(stepsize_controller, y0)
    constraint = getattr(solver, "constraint", None)
    if isinstance(solver, AbstractManifoldSolver):
        terms, solver = evaluated((terms, solver), args)
    terms = traced_once(terms)
    solver = without_idle_hook(solver, t0, y0, args)
    if throw and isinstance(stepsize_controller, dfx.ConstantStepSize) and dt0 is not None:
        y0 = raise_if_unstable(y0, terms, solver, dt0)
    solver = _as_in_steps(
        solver, stepsize_controller, bool(resets) or event is not None, consistent, y0
    )
    setup = Setup(
        terms, solver, dt0, saveat, stepsize_controller, consistent, throw, event, max_steps
    )
    ready = prepare(setup, ProblemData(t0, t1, y0, args))
    t0, t1, y0, _ = ready.data
    adjoint = CheckedStartAdjoint(adjoint, solver_state is not None, saveat.solver_state)
    if event is not None and event.root_finder is not None:
        adjoint = LocatingAdjoint(adjoint)
    run = LoopArguments(solver, stepsize_controller, saving(setup), ready.solver_state, y0)
    if solver_state is not None:
        run = run._replace(solver_state=solver_state)
    event = events_in_true_time(setup, ready)
    if resets:
        run = with_resets(run, resets, max_resets, setup, ready, event)
    sol = dfx.diffeqsolve(
        terms,
        run.solver,
        t0,
        t1,
        ready.dt0,
        run.y0,
        args,
        saveat=run.saveat,
        stepsize_controller=run.controller,
        adjoint=adjoint,
        event=event,
        max_steps=max_steps,
        throw=False,
        progress_meter=progress_meter,
        solver_state=run.solver_state,
        controller_state=controller_state,
        made_jump=made_jump,
    )
    # The dense solution, which is returned, holds the original constraint.
    if resets:
        keeps_state = saveat.controller_state
        return finish_resets(setup, ready, sol, run.is_time_nan, constraint, keeps_state)
    return Solution.of(finish(setup, ready, sol, constraint))


def _as_in_steps(
    solver: Any,
    controller: dfx.AbstractStepSizeController,
    has_events: bool,
    consistent: Consistent,
    y0: Y,
) -> Any:
    """Return the solver with the tolerances of the controller, and accurate implicit stages."""
    if isinstance(solver, AbstractManifoldSolver):
        # All interpolated values are corrected, except those with which an event is searched for.
        solver = solver.within(controller, bends_interpolant=has_events)
    else:
        warn_of_unknown_hook(solver)
        solver = with_accurate_stages(solver)
    return with_tolerances_of_stages(trusting(solver, consistent), controller, y0)
