"""Postprocessing of a solve: output on the manifold, statistics, and the result."""

from collections.abc import Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
from diffrax import RESULTS

from .._base.compat import is_okay, nonlinear_failure, update_result
from .._base.types import BoolScalar
from .._constraint.constraint import AbstractConstraint
from .._rosenbrock import MassMatrixTerm
from .._solver.base import AbstractManifoldSolver
from .._solver.interpolation import ManifoldInterpolation
from .outcome import raise_if_failed, result_of_saved, tangency_fault
from .output import project_output, saves_state, saving
from .prepare import Ready
from .setup import Setup


def finish(
    setup: Setup,
    ready: Ready,
    sol: dfx.Solution,
    constraint: AbstractConstraint | None,
    faults: Sequence[tuple[BoolScalar, str]] = (),
) -> dfx.Solution:
    """Correct the saved values and report the solve; with `throw` raise if it failed. `constraint` is
    held by the dense solution; `faults` are further causes of a failure, with their messages."""
    is_hook = isinstance(setup.solver, AbstractManifoldSolver)
    report = _corrected(setup, ready, sol, constraint) if is_hook else _checked(setup, ready, sol)
    if not setup.throw:
        return report
    faults = [*tangency_fault(setup.solver, report, sol.solver_state), *faults]
    # A bad start has raised its own, more precise error.
    failed = ~is_okay(report.result) & ready.start.success
    return raise_if_failed(report, failed, setup.solver, faults)


def _corrected(setup: Setup, ready: Ready, sol: dfx.Solution, constraint: Any) -> dfx.Solution:
    solver, saveat, (_, _, y0, args) = setup.solver, setup.saveat, ready.data
    statistics = sol.solver_state.statistics  # pyright: ignore[reportOptionalMemberAccess]
    ys, failed = project_output(setup, ready.data, sol.ts, sol.ys)
    # Diffrax forgets that a step failed if the solve also has an event.
    result = update_result(sol.result, sol.solver_state.result)  # pyright: ignore[reportOptionalMemberAccess]
    result = update_result(result, RESULTS.where(failed, nonlinear_failure(), RESULTS.successful))
    if not solver.corrects_output:
        result = update_result(result, result_of_saved(saveat, sol.ts, ys))
    result = RESULTS.where(ready.start.success, result, nonlinear_failure())
    interpolation: Any = sol.interpolation
    if interpolation is not None and solver.corrects_output:
        interpolation = ManifoldInterpolation.build(
            interpolation, constraint, solver.projection, ready.data.t0, y0, args
        )
    stats = {
        **sol.stats,
        "initial_correction": ready.start.correction,
        "num_projection_iterations": statistics.iterations,
        "largest_correction": statistics.largest_correction,
        "correction_share": statistics.correction_share,
    }
    solver_state = sol.solver_state if saveat.solver_state else None
    return _replaced(
        sol,
        ys=ys,
        interpolation=interpolation,
        stats=stats,
        result=result,
        solver_state=solver_state,
    )


def _checked(setup: Setup, ready: Ready, sol: dfx.Solution) -> dfx.Solution:
    """Return Diffrax's result, except that a state that is not finite is a failure."""
    result = update_result(sol.result, result_of_saved(saving(setup), sol.ts, sol.ys))
    ts, ys = sol.ts, sol.ys
    if not saves_state(setup.saveat):
        ts, ys = ts[0], ys[0]  # pyright: ignore[reportOptionalSubscript]
    stats = sol.stats
    if isinstance(setup.terms, MassMatrixTerm):
        stats = {**stats, "initial_correction": ready.start.correction}
    return _replaced(sol, ts=ts, ys=ys, result=result, stats=stats)


def _replaced(sol: dfx.Solution, **fields: Any) -> dfx.Solution:
    where = lambda s: [getattr(s, name) for name in fields]
    return eqx.tree_at(where, sol, list(fields.values()), is_leaf=lambda x: x is None)
