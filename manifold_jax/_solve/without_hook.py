"""A solver of Diffrax alone, for comparisons."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.tree_util as jtu

from .._compat import is_okay, save_y, update_result
from .._custom_types import Args, RealScalarLike, Y
from .._solver.implicit import with_accurate_stages
from .outcome import raise_if_failed, result_of_saved


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
    **options: Any,
) -> dfx.Solution:
    """What Diffrax returns, except that implicit stages are accurate and a state that is not finite
    is no success."""
    solver = with_accurate_stages(solver)
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
