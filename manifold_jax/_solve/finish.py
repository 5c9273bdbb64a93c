"""What is done after the loop: output on the manifold, statistics, and the result."""

import diffrax as dfx
from diffrax import RESULTS

from .._base.compat import is_okay, nonlinear_failure, update_result
from .._base.types import Args, Y
from .._solver.base import AbstractManifoldSolver
from .._solver.interpolation import ManifoldInterpolation
from .outcome import raise_if_failed, result_of_saved, tangency_fault
from .output import project_output
from .start import StartInfo


def finish(
    sol: dfx.Solution,
    solver: AbstractManifoldSolver,
    given: AbstractManifoldSolver,
    saveat: dfx.SaveAt,
    event: dfx.Event | None,
    y0: Y,
    args: Args,
    start: StartInfo,
    throw: bool,
) -> dfx.Solution:
    """Correct what was saved, and report; with `throw` raise what went wrong. `saveat` is what was
    asked for, `given` the solver that the user passed, and `sol.solver_state` has to be there."""
    statistics = sol.solver_state.statistics  # pyright: ignore[reportOptionalMemberAccess]
    sol = _corrected(sol, solver, given, saveat, event, y0, args, start)
    if not throw:
        return sol
    faults = tangency_fault(sol.result, solver, statistics, sol.stats["num_accepted_steps"])
    # A bad start has raised its own, clearer error.
    return raise_if_failed(sol, ~is_okay(sol.result) & start.success, solver, faults)


def _corrected(
    sol: dfx.Solution,
    solver: AbstractManifoldSolver,
    given: AbstractManifoldSolver,
    saveat: dfx.SaveAt,
    event: dfx.Event | None,
    y0: Y,
    args: Args,
    start: StartInfo,
) -> dfx.Solution:
    ys, failed = project_output(saveat, event, solver, sol.ts, sol.ys, y0, args)
    failed_output = RESULTS.where(failed, nonlinear_failure(), RESULTS.successful)
    # Diffrax forgets that a step failed if it has an event, too.
    result = update_result(sol.result, sol.solver_state.result)  # pyright: ignore[reportOptionalMemberAccess]
    result = update_result(result, failed_output)
    if not solver.corrects_output:
        result = update_result(result, result_of_saved(saveat, sol.ts, ys))
    result = RESULTS.where(start.success, result, nonlinear_failure())
    interpolation = sol.interpolation
    if interpolation is not None and solver.corrects_output:
        interpolation = ManifoldInterpolation.build(
            interpolation,
            given.constraint,
            solver.projection,
            sol.t0,  # pyright: ignore[reportArgumentType]
            y0,
            args,  # pyright: ignore[reportArgumentType]
        )
    statistics = sol.solver_state.statistics  # pyright: ignore[reportOptionalMemberAccess]
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
        interpolation=interpolation,  # pyright: ignore[reportArgumentType]
        stats=stats,
        result=result,
        solver_state=sol.solver_state if saveat.solver_state else None,
        controller_state=sol.controller_state,
        made_jump=sol.made_jump,
        event_mask=sol.event_mask,
    )
