"""The front end: `diffrax.diffeqsolve` plus what a solver cannot do by itself."""

from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS

from ._adjoint import LocatingAdjoint, StepReplayAdjoint
from ._arguments import check_arguments, raise_if_unstable
from ._compat import is_okay, nonlinear_failure, save_y, update_result
from ._constraint import check_constraint, check_state
from ._custom_types import Args, RealScalarLike, Y
from ._diagnosis import raise_unless
from ._errors import clear_errors
from ._initial import controller_tolerances, initial_step, start_state, StartInfo
from ._interpolation import ManifoldInterpolation
from ._mechanics.term import DirectedTerm
from ._outcome import fault_messages, raise_if_failed, result_of_saved
from ._output import events_in_true_time, on_manifold_saving, project_output
from ._solver.base import AbstractManifoldSolver
from ._solver.implicit import with_accurate_stages


@clear_errors
@eqx.filter_jit
def diffeqsolve(
    terms: Any,
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
    consistent: Literal["project", "check", "assume"] = "project",
) -> dfx.Solution:
    """Solve a differential equation on a manifold.

    Takes the arguments of `diffrax.diffeqsolve` and returns its `Solution`. In addition the
    initial value is made consistent, and every value handed out is on the manifold: saved
    values, the dense solution `sol.evaluate`, what `SaveAt(fn=...)` and event functions see,
    and the state at an event.

    **Arguments:** as `diffrax.diffeqsolve`, and

    - `solver`: [`Projected`][] or another solver of this library. (Any other Diffrax solver
        is passed on, for comparisons; implicit stages are solved to round-off there, too.)
    - `dt0`: `None` with an adaptive controller chooses the first step from the vector field
        (Hairer, Norsett & Wanner, Solving ODEs I, II.4).
    - `consistent`: what to do with `y0`. `"project"` moves it onto the manifold, `"check"`
        refuses it if it is not there (to `tolerance`), `"assume"` trusts it.
    - `event`: event functions get the true time, also when integrating backwards. With a root
        finder the earliest event ends the solve, whatever the order of `cond_fn`.
    - `adjoint`: how derivatives are computed, by default in reverse mode by
        [`StepReplayAdjoint`][], from the very steps that were made. For forward mode pass
        `diffrax.ForwardMode()`. Diffrax's other adjoints compute steps again, which round
        differently and get other sizes: where tolerances are tight their gradients are less
        accurate than the solution.

    Python numbers among the arguments (`t1`, tolerances) are part of the compiled program; pass
    `jnp.asarray(...)` to solve with other values without compiling again.

    **Returns:**

    A `diffrax.Solution`; `sol.stats` has in addition

    - `initial_correction`: how far `y0` was moved, the largest `|change| / (|y0| + 1)`;
    - `num_projection_iterations`: Newton iterations over all accepted steps;
    - `largest_correction`: the largest such correction of an accepted step;
    - `correction_share`: with [`Projected`][] the part of the steps that the corrections undid,
        their sum over that of the displacements. Where the field is tangent it is as small as the
        tolerance; if it is not, see [`tangent_field`][].

    **Raises:**

    `TypeError` or `ValueError` for arguments that cannot work. With `throw=True` a
    `RuntimeError` where the solve fails; with `throw=False` look at `sol.result`:
    `RESULTS.nonlinear_divergence` is a constraint that could not be satisfied, and
    `RESULTS.nonfinite` a state that is NaN or infinite, also with a solver of Diffrax alone.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193.
    """
    check_arguments(terms, solver, dt0, saveat, stepsize_controller, adjoint, event)
    _check_arguments(adjoint, consistent)
    if event is not None and event.root_finder is not None:
        adjoint = LocatingAdjoint(adjoint)
    options = dict(
        stepsize_controller=stepsize_controller,
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=progress_meter,
        solver_state=solver_state,
        controller_state=controller_state,
        made_jump=made_jump,
    )
    is_fixed = throw and isinstance(stepsize_controller, dfx.ConstantStepSize) and dt0 is not None
    if not isinstance(solver, AbstractManifoldSolver):
        if is_fixed:
            y0 = raise_if_unstable(y0, terms, solver, dt0)
        solver = with_accurate_stages(solver)
        return _solve_without_hook(
            terms, solver, t0, t1, dt0, y0, args, saveat, throw, event=event, **options
        )
    time_dtype = _time_dtype(t0, t1, dt0, saveat)
    y0 = _as_state(y0, time_dtype)
    if is_fixed:
        y0 = raise_if_unstable(y0, terms, solver, dt0)
    t0, t1 = jnp.asarray(t0, time_dtype), jnp.asarray(t1, time_dtype)
    check_constraint(solver.constraint, t0, y0, args)
    solver = _with_tolerances(solver, stepsize_controller)
    if event is None:
        solver = eqx.tree_at(lambda s: s.bend_interpolant, solver, False)
    y0, start = start_state(solver.constraint, t0, y0, args, solver.projection, consistent)
    if throw:
        y0 = raise_unless(start.success, start.cause, y0, "y0")
    if dt0 is None:
        dt0 = _first_step(terms, solver, t0, t1, y0, args, stepsize_controller)

    sol = dfx.diffeqsolve(
        terms,
        solver,
        t0,
        t1,
        dt0,
        y0,
        args,
        saveat=on_manifold_saving(saveat, solver, event),
        event=events_in_true_time(event, terms, t0, t1, dt0),
        throw=False,
        **options,
    )
    statistics = sol.solver_state.statistics
    sol = _finish(sol, solver, saveat, event, y0, args, start)
    if not throw:
        return sol
    faults = fault_messages(sol.result, solver, statistics, sol.stats["num_accepted_steps"])
    # A bad start has raised its own, clearer error.
    return raise_if_failed(sol, ~is_okay(sol.result) & start.success, faults)


def _solve_without_hook(
    terms: Any,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike | None,
    y0: Y,
    args: Args,
    saveat: dfx.SaveAt,
    throw: bool,
    **options: Any,
) -> dfx.Solution:
    """What Diffrax returns, except that a state that is not finite is no success."""
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    unseen = not any(sub.fn is save_y for sub in subs)
    watched = saveat
    if unseen:
        both = saveat.subs, dfx.SubSaveAt(t1=True)
        watched = eqx.tree_at(lambda s: s.subs, saveat, both, is_leaf=lambda x: x is None)
    sol = dfx.diffeqsolve(
        terms, solver, t0, t1, dt0, y0, args, saveat=watched, throw=throw, **options
    )
    result = update_result(sol.result, result_of_saved(watched, sol.ts, sol.ys))
    ts, ys = (sol.ts[0], sol.ys[0]) if unseen else (sol.ts, sol.ys)
    sol = eqx.tree_at(
        lambda s: (s.ts, s.ys, s.result), sol, (ts, ys, result), is_leaf=lambda x: x is None
    )
    return raise_if_failed(sol, ~is_okay(result), []) if throw else sol


def _check_arguments(adjoint: Any, consistent: str) -> None:
    if isinstance(adjoint, dfx.ImplicitAdjoint):
        raise ValueError(
            "`adjoint=ImplicitAdjoint()` inverts df/dy, which is singular on a manifold: it says nothing of the "
            "directions across. Leave `adjoint` out (`mj.StepReplayAdjoint()`), or for the minimum of a function "
            "`mj.gradient_flow`."
        )
    if isinstance(adjoint, dfx.BacksolveAdjoint):
        raise ValueError(
            "`adjoint=BacksolveAdjoint()` loses the gradient through the corrections (it would be silently wrong). "
            "Leave `adjoint` out (`mj.StepReplayAdjoint()`), or use `diffrax.ForwardMode()`."
        )
    if consistent not in ("project", "check", "assume"):
        raise ValueError(
            f"`consistent` must be 'project', 'check' or 'assume', got {consistent!r}."
        )


def _time_dtype(t0: Any, t1: Any, dt0: Any, saveat: dfx.SaveAt) -> Any:
    """The type in which Diffrax will hold times, and the least precision of the state."""
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    times = [t for t in (t0, t1, dt0, *(s.ts for s in subs)) if t is not None]
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*times)
        return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)


def _as_state(y0: Y, time_dtype: Any) -> Y:
    check_state(y0, "y0")
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf, time_dtype)), y0)


def _with_tolerances(solver: AbstractManifoldSolver, controller: Any) -> AbstractManifoldSolver:
    """A solver cannot see the controller's tolerances by itself."""
    tolerances = controller_tolerances(controller)
    if tolerances is None or solver.projection.rtol is not None:
        return solver
    return eqx.tree_at(
        lambda s: (s.projection.rtol, s.projection.atol),
        solver,
        (tolerances.rtol, tolerances.atol),
        is_leaf=lambda x: x is None,
    )


def _first_step(terms, solver, t0, t1, y0, args, controller) -> Any:
    tolerances = controller_tolerances(controller)
    if tolerances is None or not isinstance(terms, dfx.ODETerm | DirectedTerm):
        return None
    return initial_step(terms, solver, t0, t1, y0, args, tolerances)


def _finish(
    sol: dfx.Solution,
    solver: AbstractManifoldSolver,
    saveat: dfx.SaveAt,
    event: dfx.Event | None,
    y0: Y,
    args: Args,
    start: StartInfo,
) -> dfx.Solution:
    """Correct what was saved, and report."""
    ys, failed = project_output(saveat, event, solver, sol.ts, sol.ys, y0, args)
    failed_output = RESULTS.where(failed, nonlinear_failure(), RESULTS.successful)
    # Diffrax forgets that a step failed if it has an event, too.
    result = update_result(sol.result, sol.solver_state.result)
    result = update_result(result, failed_output)
    if not solver.corrects_output:
        result = update_result(result, result_of_saved(saveat, sol.ts, ys))
    result = RESULTS.where(start.success, result, nonlinear_failure())
    interpolation = sol.interpolation
    if interpolation is not None and solver.corrects_output:
        interpolation = ManifoldInterpolation.build(
            interpolation, solver.constraint, solver.projection, sol.t0, y0, args
        )
    statistics = sol.solver_state.statistics
    stats = {
        **sol.stats,
        "initial_correction": start.correction,
        "num_projection_iterations": statistics.iterations,
        "largest_correction": statistics.largest_correction,
        "correction_share": statistics.correction_share,
    }
    return dfx.Solution(
        t0=sol.t0,
        t1=sol.t1,
        ts=sol.ts,
        ys=ys,
        interpolation=interpolation,
        stats=stats,
        result=result,
        solver_state=sol.solver_state if saveat.solver_state else None,
        controller_state=sol.controller_state,
        made_jump=sol.made_jump,
        event_mask=sol.event_mask,
    )
