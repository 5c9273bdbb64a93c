"""Solving many trajectories in lanes, and the derivatives of that."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array

from ..._adjoint.gradient import with_zeros
from ..._base.compat import nonlinear_failure, update_result
from ..._base.types import BoolScalar
from ..._jaxpr.lane_arrays import NotScalarError
from ..._solve.outcome import result_of_saved
from ..._solver.unconstrained import Unconstrained
from .forward import tangents_in_lanes
from .mapped import gradient_of_mapped, tangents_of_mapped
from .parts import in_steps, Inputs, Parts, times_are_differentiated
from .records import LaneEnds
from .reverse import LaneReverseSweep
from .rows import saved_rows, smooth_rows
from .schedule import LaneRun, Schedule
from .solution import EnsembleSolution


# Largest number of differentiated numbers that are common to all; each has a sum in every lane.
_MOST_IN_COMMON = 200


def gradient_in_lanes(
    inputs: Inputs, differentiated: Any, run: LaneRun, bar: Any, limit: int
) -> Inputs:
    """Return the gradient from `bar`, the cotangents of times and values."""
    parts = Parts.of(inputs, differentiated)
    if sum(x.size for x in jtu.tree_leaves(parts.common)) > _MOST_IN_COMMON:
        raise NotScalarError("too many numbers in common")
    saved, smooth = smooth_rows(parts, run.rows, run.outcome.t, run.values)
    at = parts.each, parts.common, run.start.trajectory.y, run.outcome.y, smooth
    values, pullback = jax.vjp(saved, *at)
    each, common, *bars = pullback(with_zeros(values, bar))
    ends = LaneEnds(run.start.trajectory, run.outcome.num_steps, run.rows, run.states, *bars)
    more = LaneReverseSweep(parts, ends, limit).run()
    each, common = jtu.tree_map(jnp.add, (each, common), more)
    return common._replace(batch=dataclasses.replace(common.batch, each=each))


# Largest number of scalar operations in a start and a step; beyond it trajectories are mapped. A double
# pendulum has 3389; the 16308 of a four-bar linkage take 72 s to compile, and half of the time.
_LONGEST = 8_000
# The same for the reverse sweep, which contains the step twice.
_LONGEST_BACK = 5 * _LONGEST


@eqx.filter_custom_vjp
def solve_in_lanes(inputs: Inputs) -> EnsembleSolution:
    solution, _ = _run(inputs)
    return solution


def _run(inputs: Inputs) -> tuple[EnsembleSolution, LaneRun]:
    equations, batch = inputs
    equations = in_steps(equations)
    run = Schedule(equations, batch.each, batch.complete, _LONGEST).run()
    outcome, statistics = run.outcome, run.outcome.statistics
    stats = {
        "num_steps": outcome.num_steps,
        "num_accepted_steps": outcome.num_accepted,
        "num_rejected_steps": outcome.num_steps - outcome.num_accepted,
    }
    if not isinstance(equations.solver, Unconstrained):
        stats |= {
            "initial_correction": run.start.correction,
            "num_projection_iterations": statistics.iterations,
            "largest_correction": statistics.largest_correction,
            "correction_share": jax.vmap(lambda s: s.correction_share)(statistics),
        }
    ends = run.start.trajectory.y, outcome.y
    ts, ys = saved_rows(equations.saveat.subs, batch, run.rows, outcome.t, *ends, run.values)

    def with_values(result: RESULTS, failed: BoolScalar, ts: Array, ys: Any) -> RESULTS:
        failure = RESULTS.where(failed, nonlinear_failure(), RESULTS.successful)
        result = update_result(result, failure)
        if equations.solver.corrects_output:
            return result
        return update_result(result, result_of_saved(equations.saveat, ts, ys))

    result = jax.vmap(with_values)(outcome.result, run.failed, ts, ys)
    return EnsembleSolution(ts, ys, stats, result), run


@solve_in_lanes.def_fwd
def _forward(perturbed, inputs):
    del perturbed
    return _run(inputs)


@solve_in_lanes.def_bwd
def _backward(run, cotangents, perturbed, inputs):
    bar = cotangents.ts, cotangents.ys
    return _in_lanes_or_mapped(
        perturbed,
        lambda: gradient_in_lanes(inputs, perturbed, run, bar, _LONGEST_BACK),
        lambda: gradient_of_mapped(inputs, perturbed, bar),
    )


def _in_lanes_or_mapped(differentiated: Any, in_lanes: Callable, mapped: Callable) -> Any:
    """Return `in_lanes()`, or `mapped()` for derivatives of times and if lanes would take too long."""
    if not times_are_differentiated(differentiated):
        with contextlib.suppress(NotScalarError):
            return in_lanes()
    return mapped()


@eqx.filter_custom_jvp
def solve_in_lanes_forwards(inputs: Inputs) -> EnsembleSolution:
    """Solve in lanes, differentiated in forward mode."""
    solution, _ = _run(inputs)
    return solution


@solve_in_lanes_forwards.def_jvp
def _tangents(primals, tangents):
    (inputs,), (tangents,) = primals, tangents
    solution, _ = _run(inputs)
    differentiated = jtu.tree_map(lambda x: x is not None, tangents, is_leaf=lambda x: x is None)
    along = _in_lanes_or_mapped(
        differentiated,
        lambda: tangents_in_lanes(inputs, differentiated, tangents, _LONGEST_BACK),
        lambda: tangents_of_mapped(inputs, tangents),
    )
    none = jtu.tree_map(lambda _: None, (solution.stats, solution.result))
    return solution, EnsembleSolution(*along, *none)
