"""A solver alone: one of Diffrax for comparisons, or a Rosenbrock method."""

import warnings
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.tree_util as jtu

from .._base.compat import is_okay, save_y, update_result
from .._base.types import Args, RealScalarLike, Y
from .._rosenbrock import AbstractRosenbrock, MassMatrixTerm
from .._solver.step.implicit import with_accurate_stages, with_tolerances_of_stages
from .._solver.unconstrained import Unconstrained
from .mass_matrix import trusting
from .outcome import raise_if_failed, result_of_saved
from .prepare import prepare
from .start import Consistent


def solve_without_hook(
    terms: Any,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike | None,
    y0: Y,
    args: Args,
    saveat: dfx.SaveAt,
    throw: bool,
    consistent: Consistent,
    **options: Any,
) -> dfx.Solution:
    """What Diffrax returns, except that implicit stages are accurate, a state that is not finite is
    no success, and Rosenbrock methods get a consistent start and a first step."""
    _warn_of_unknown_hook(solver)
    solver, moved = with_accurate_stages(solver), None
    solver = with_tolerances_of_stages(solver, options["stepsize_controller"], y0)
    if isinstance(solver, AbstractRosenbrock):
        solver = trusting(solver, consistent)
        ready = prepare(
            terms,
            Unconstrained(solver),
            t0,
            t1,
            dt0,
            y0,
            args,
            saveat,
            options["stepsize_controller"],
            consistent,
            throw,
        )
        t0, t1, dt0, y0 = ready.t0, ready.t1, ready.dt0, ready.y0
        if isinstance(terms, MassMatrixTerm):
            moved = ready.start.correction
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    unseen = not any(sub.fn is save_y for sub in subs)
    watched = saveat
    if unseen:
        both = saveat.subs, dfx.SubSaveAt(t1=True)
        watched = eqx.tree_at(lambda s: s.subs, saveat, both, is_leaf=lambda x: x is None)
    sol = dfx.diffeqsolve(
        terms, solver, t0, t1, dt0, y0, args, saveat=watched, throw=False, **options
    )
    result = update_result(sol.result, result_of_saved(watched, sol.ts, sol.ys))
    ts, ys = (sol.ts[0], sol.ys[0]) if unseen else (sol.ts, sol.ys)  # pyright: ignore[reportOptionalSubscript]
    sol = eqx.tree_at(
        lambda s: (s.ts, s.ys, s.result), sol, (ts, ys, result), is_leaf=lambda x: x is None
    )
    if moved is not None:
        sol = eqx.tree_at(lambda s: s.stats, sol, {**sol.stats, "initial_correction": moved})
    return raise_if_failed(sol, ~is_okay(result), solver) if throw else sol


def _warn_of_unknown_hook(solver: dfx.AbstractSolver) -> None:
    if isinstance(solver, dfx.HalfSolver) or not isinstance(solver, dfx.AbstractWrappedSolver):
        return
    name = type(solver).__name__
    warnings.warn(
        f"`solver` is a {name}, a wrapper of your own: `mj.diffeqsolve` does not know its constraint, and corrects "
        "neither `y0` nor values between steps (`SaveAt(ts=)`, events, the dense solution). Write "
        f"`mj.Projected({name}(...), constraint)`, derive it from `mj.AbstractManifoldSolver`, or call "
        "`diffrax.diffeqsolve`.",
        stacklevel=2,
    )
