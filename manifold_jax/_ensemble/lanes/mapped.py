"""Solving many trajectories with `diffeqsolve` under `jax.lax.map`, in batches."""

from typing import Any

import equinox as eqx
import jax

from ..._adjoint.gradient import with_zeros
from ..._solve.diffeqsolve import diffeqsolve
from ..._solver.unconstrained import Unconstrained
from .parts import Inputs
from .solution import EnsembleSolution


def solve_mapped(inputs: Inputs) -> EnsembleSolution:
    equations, batch = inputs
    solver = equations.solver
    solver = solver.inner if isinstance(solver, Unconstrained) else solver

    def one(of_each: Any) -> EnsembleSolution:
        given = batch.complete(of_each)
        times = given.t0, given.t1, equations.dt0
        sol = diffeqsolve(
            equations.terms,
            solver,
            *times,
            given.y0,
            given.args,
            saveat=equations.saveat,
            stepsize_controller=equations.controller,
            max_steps=equations.max_steps,
            adjoint=equations.adjoint,
            consistent=equations.consistent,
            event=equations.event,
            resets=equations.resets,
            max_resets=equations.max_resets,
            throw=False,
        )
        stats = {name: x for name, x in sol.stats.items() if name != "max_steps"}
        return EnsembleSolution(
            sol.ts,
            sol.ys,
            stats,
            sol.result,
            event_mask=sol.event_mask,
            resets=getattr(sol, "resets", None),
        )

    at_a_time = min(equations.lanes, batch.size)
    return jax.lax.map(one, batch.each, batch_size=at_a_time)


def _times_and_values(inputs: Inputs) -> Any:
    solution = solve_mapped(inputs)
    return eqx.filter((solution.ts, solution.ys), eqx.is_inexact_array)


def gradient_of_mapped(inputs: Inputs, differentiated: Any, bar: Any) -> Any:
    """Return the gradient from the cotangents of times and values, by the sweep of `diffeqsolve`."""
    smooth, rest = eqx.partition(inputs, differentiated)
    saved = lambda smooth: _times_and_values(eqx.combine(smooth, rest))
    values, pullback = jax.vjp(saved, smooth)
    return pullback(with_zeros(values, bar))[0]


def tangents_of_mapped(inputs: Inputs, tangents: Any) -> Any:
    """Return the tangents of times and values; those of the inputs are `None` where there are none."""
    return eqx.filter_jvp(_times_and_values, (inputs,), (tangents,))[1]
