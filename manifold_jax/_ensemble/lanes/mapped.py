"""The ordinary way: `diffeqsolve` for each trajectory, some of them at a time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._solve.diffeqsolve import diffeqsolve
from ..._solver.unconstrained import Unconstrained
from .parts import Inputs
from .solution import EnsembleSolution


def solve_mapped(inputs: Inputs, lanes: int) -> EnsembleSolution:
    equations, batch = inputs
    solver = equations.solver
    solver = solver.inner if isinstance(solver, Unconstrained) else solver

    def one(of_each: Any) -> tuple[Any, ...]:
        given = batch.complete(of_each)
        sol = diffeqsolve(
            equations.terms,
            solver,
            given.t0,
            given.t1,
            equations.dt0,
            given.y0,
            given.args,
            saveat=equations.saveat,
            stepsize_controller=equations.controller,
            max_steps=equations.max_steps,
            adjoint=equations.adjoint,
            consistent=equations.consistent,
            throw=False,
        )
        stats = {name: x for name, x in sol.stats.items() if name != "max_steps"}
        return sol.ts, sol.ys, stats, sol.result

    return EnsembleSolution(*jax.lax.map(one, batch.each, batch_size=min(lanes, batch.size)))


def gradient_of_mapped(inputs: Inputs, differentiated: Any, bar: Any, lanes: int) -> Any:
    """Return the gradient from the cotangents of times and values, each trajectory by the reverse
    sweep of `diffeqsolve`."""
    smooth, rest = eqx.partition(inputs, differentiated)

    def saved(smooth: Any) -> Any:
        solution = solve_mapped(eqx.combine(smooth, rest), lanes)
        return eqx.filter((solution.ts, solution.ys), eqx.is_inexact_array)

    values, pullback = jax.vjp(saved, smooth)
    bar = jtu.tree_map(lambda x, b: jnp.zeros_like(x) if b is None else b, values, bar)
    return pullback(bar)[0]


def tangents_of_mapped(inputs: Inputs, tangents: Any, lanes: int) -> Any:
    """Return the tangents of times and values; `tangents` of the inputs have `None` where there is
    none."""

    def saved(inputs: Inputs) -> Any:
        solution = solve_mapped(inputs, lanes)
        return solution.ts, solution.ys

    return eqx.filter_jvp(saved, (inputs,), (tangents,))[1]
