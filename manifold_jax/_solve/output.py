"""Output on the manifold: saved values, user functions and events."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.compat import save_y
from .._base.types import Args, BoolScalar, Y
from .._solver.base import AbstractManifoldSolver
from .prepare import Ready
from .setup import ProblemData, Setup


# Largest number of outputs that are corrected one by one, in a program that compiles in two thirds of
# the time; with 1001 of the pendulum each takes 1.2 us more. `python -m benchmarks.speed.compile_time`.
MOST_ONE_BY_ONE = 128


def _is_sub(x: Any) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def _is_interpolated(sub: dfx.SubSaveAt, event: dfx.Event | None) -> bool:
    """Whether values are interpolated, also that at an event. Only these need a correction: steps end
    on the manifold."""
    return sub.ts is not None or event is not None


def saves_state(saveat: dfx.SaveAt) -> bool:
    """Whether some states are saved as they are."""
    return any(sub.fn is save_y for sub in jtu.tree_leaves(saveat.subs, is_leaf=_is_sub))


def saving(setup: Setup) -> dfx.SaveAt:
    """Return the `SaveAt` for Diffrax.

    The state itself is corrected after the solve, which is cheaper than in Diffrax's loop over outputs;
    only a user's function has to see corrected states inside it. The state of a hook is always kept,
    for its statistics. Without a hook the last state is saved in any case, to check that it is finite.
    """
    saveat, solver = setup.saveat, setup.solver
    replaced = lambda where, value: eqx.tree_at(where, saveat, value, is_leaf=lambda x: x is None)
    if not isinstance(solver, AbstractManifoldSolver):
        both = saveat.subs, dfx.SubSaveAt(t1=True)
        return saveat if saves_state(saveat) else replaced(lambda s: s.subs, both)

    def wrap(sub: dfx.SubSaveAt) -> dfx.SubSaveAt:
        if sub.fn is save_y or not _is_interpolated(sub, setup.event):
            return sub

        def fn(t, y, args):
            corrected, info = solver.correct(t, y, args)
            return sub.fn(t, _nan_unless(info.success, corrected), args), info.success

        return eqx.tree_at(lambda s: s.fn, sub, fn)

    subs = saveat.subs
    if solver.corrects_output:
        subs = jtu.tree_map(wrap, subs, is_leaf=_is_sub)
    return replaced(lambda s: (s.subs, s.solver_state), (subs, True))


def events_in_true_time(setup: Setup, ready: Ready) -> dfx.Event | None:
    """Return the event with functions that get the true time and the arguments of the solve.

    Diffrax passes negated times to an event function when integrating backwards; with the original
    terms and times it is consistent again. States at the ends of steps are on the manifold.
    """
    event, data = setup.event, ready.data
    if event is None:
        return None
    known = dict(
        terms=setup.terms,
        solver=setup.solver,
        t0=data.t0,
        t1=data.t1,
        dt0=ready.dt0,
        saveat=setup.saveat,
        stepsize_controller=setup.controller,
        max_steps=setup.max_steps,
    )
    direction = data.direction

    def wrap(cond_fn: Callable) -> Callable:
        return lambda t, y, args, **kwargs: cond_fn(t * direction, y, args, **{**kwargs, **known})

    cond_fn = jtu.tree_map(wrap, event.cond_fn, is_leaf=callable)
    return dfx.Event(cond_fn, event.root_finder, event.direction)


def project_output(setup: Setup, data: ProblemData, ts: Any, ys: Any) -> tuple[Any, BoolScalar]:
    """Return the saved values, corrected, and whether any of them could not be corrected."""
    solver, failed = setup.solver, jnp.asarray(False)
    if not solver.corrects_output:
        return ys, failed

    def correct(sub: dfx.SubSaveAt, ts: Array, ys: Any) -> Any:
        nonlocal failed
        if not _is_interpolated(sub, setup.event):
            return ys
        if sub.fn is not save_y:
            values, successes = ys
            failed |= jnp.any(jnp.isfinite(ts) & ~successes)
            return values
        one = lambda t, y: _corrected(solver, t, y, data.y0, data.args)
        if ts.size <= MOST_ONE_BY_ONE:
            out, failures = jax.lax.map(lambda ty: one(*ty), (ts, ys))
        else:
            out, failures = jax.vmap(one)(ts, ys)
        failed |= jnp.any(failures)
        return out

    ys = jtu.tree_map(correct, setup.saveat.subs, ts, ys, is_leaf=_is_sub)
    return ys, failed


def _corrected(
    solver: AbstractManifoldSolver, t: Array, y: Y, y0: Y, args: Args
) -> tuple[Y, BoolScalar]:
    """Return one saved value, corrected, and whether that failed.

    Entries that were not reached hold infinity and stay so. They are replaced before the projection,
    not after it, as the derivative of a NaN is never zero.
    """
    used = jnp.isfinite(t)
    y = jtu.tree_map(lambda a, b: jnp.where(used, a, b), y, y0)
    corrected, info = solver.correct(jnp.where(used, t, jnp.zeros_like(t)), y, args)
    missing = jnp.where(used, jnp.nan, jnp.inf)
    valid = used & info.success
    out = jtu.tree_map(lambda a: jnp.where(valid, a, missing.astype(a.dtype)), corrected)
    return out, used & ~info.success


def _nan_unless(success: BoolScalar, y: Y) -> Y:
    return jtu.tree_map(lambda leaf: jnp.where(success, leaf, jnp.nan), y)
