"""Many trajectories in lanes, with their derivatives."""

from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
from diffrax import RESULTS

from .._compat import nonlinear_failure, update_result
from .._custom_types import BoolScalar
from .._scalar import NotScalarError
from .._solve.outcome import result_of_saved
from .forward import tangents_in_lanes
from .gradient import gradient_in_lanes
from .mapped import gradient_of_mapped, tangents_of_mapped
from .parts import in_steps, Inputs, times_are_differentiated
from .rows import saved_rows
from .schedule import Run, Schedule
from .solution import EnsembleSolution
from .unconstrained import Unconstrained


# Operations on one number, of a start and a step, beyond which trajectories are mapped over instead. A
# double pendulum has 3389; the 16308 of a four-bar linkage take 72 s to compile, and half of the time.
_LONGEST = 8_000
# Of the way back, which has the step twice.
_LONGEST_BACK = 5 * _LONGEST


@eqx.filter_custom_vjp
def solve_in_lanes(inputs: Inputs, lanes: int) -> EnsembleSolution:
    solution, _ = _run(inputs, lanes)
    return solution


def _run(inputs: Inputs, lanes: int) -> tuple[EnsembleSolution, Run]:
    equations, batch = inputs
    equations = in_steps(equations)
    run = Schedule(equations, batch.each, batch.complete, lanes, _LONGEST).run()
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
    ts, ys = saved_rows(equations.saveat.subs, batch, run)
    result = jax.vmap(_unless_failed)(outcome.result, run.failed)
    if not equations.solver.corrects_output:
        finite = jax.vmap(lambda ts, ys: result_of_saved(equations.saveat, ts, ys))(ts, ys)
        result = jax.vmap(update_result)(result, finite)
    return EnsembleSolution(ts, ys, stats, result), run


def _unless_failed(result: RESULTS, failed: BoolScalar) -> RESULTS:
    """`failed`: whether a value could not be corrected."""
    failure = RESULTS.where(failed, nonlinear_failure(), RESULTS.successful)
    return update_result(result, failure)


@solve_in_lanes.def_fwd
def _forward(perturbed, inputs, lanes):
    del perturbed
    return _run(inputs, lanes)


@solve_in_lanes.def_bwd
def _backward(run, cotangents, perturbed, inputs, lanes):
    bar = cotangents.ts, cotangents.ys
    if not times_are_differentiated(perturbed):
        try:
            return gradient_in_lanes(inputs, perturbed, run, bar, lanes, _LONGEST_BACK)
        except NotScalarError:
            pass
    return gradient_of_mapped(inputs, perturbed, bar, lanes)


@eqx.filter_custom_jvp
def solve_in_lanes_forwards(inputs: Inputs, lanes: int) -> EnsembleSolution:
    """With forward mode instead."""
    solution, _ = _run(inputs, lanes)
    return solution


@solve_in_lanes_forwards.def_jvp
def _tangents(primals, tangents):
    (inputs, lanes), (tangents, _) = primals, tangents
    solution, _ = _run(inputs, lanes)
    differentiated = jtu.tree_map(lambda x: x is not None, tangents, is_leaf=lambda x: x is None)
    along = None
    if not times_are_differentiated(differentiated):
        try:
            along = tangents_in_lanes(inputs, tangents, lanes, _LONGEST_BACK)
        except NotScalarError:
            pass
    if along is None:
        along = tangents_of_mapped(inputs, tangents, lanes)
    ts, ys = along
    return solution, EnsembleSolution(ts, ys, *_none((solution.stats, solution.result)))


def _none(tree: Any) -> Any:
    return jtu.tree_map(lambda _: None, tree)
