"""The front end of ensembles."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.sharding import Mesh
from jaxtyping import Array

from .._adjoint import StepReplayAdjoint
from .._compat import messages_of_results, number_of_result, update_result
from .._custom_types import Args, RealScalarLike, Y
from .._directed_term import DirectedTerm
from .._errors import clear_errors
from .._scalar import NotScalarError
from .._solve.arguments import check_arguments
from .._solve.diffeqsolve import diffeqsolve
from .._solve.outcome import result_of_saved
from .._solve.start import Consistent
from .._solver.base import AbstractManifoldSolver
from .._solver.explicit import is_unrollable
from .arguments import Batch, checked_batch, checked_step, checked_times
from .axes import anywhere, Axes, largest
from .devices import check_mesh, over_devices
from .rows import saved_rows
from .schedule import Schedule
from .solution import EnsembleSolution
from .trajectory import Equations, Given


# Operations on one number, of a start and a step, beyond which trajectories are mapped over instead. A
# double pendulum has 3389; the 16308 of a four-bar linkage take 72 s to compile, and half of the time.
_LONGEST = 8_000


@clear_errors
@eqx.filter_jit
def solve_ensemble(
    terms: dfx.AbstractTerm,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike | Array,
    t1: RealScalarLike | Array,
    dt0: RealScalarLike | None,
    y0s: Y,
    args: Args = None,
    *,
    saveat: dfx.SaveAt = dfx.SaveAt(t1=True),
    stepsize_controller: dfx.AbstractStepSizeController = dfx.ConstantStepSize(),
    max_steps: int = 4096,
    in_axes: Any = 0,
    lanes: int = 128,
    mesh: Mesh | None = None,
    throw: bool = False,
    consistent: Consistent = "project",
) -> EnsembleSolution:
    """Solve a differential equation on a manifold for many initial values and parameters.

    Each trajectory is that of [`diffeqsolve`][], to rounding: the same accepted steps, and on the
    manifold at every value handed out. `lanes` of them advance together, with steps of their own; one
    that has ended, or failed, makes room for the next at once, so that none waits for the
    longest. Every component of the state is a vector of lanes of its own, in which constants and
    structural zeros are folded before XLA sees them: for small systems more than ten times as fast as
    `jax.vmap` of `diffeqsolve`.

    **Arguments:** as [`diffeqsolve`][], and

    - `y0s`: initial values, any pytree; the leading axis of each leaf is that of the `N`
        trajectories.
    - `t0`, `t1`: common to all, or of shape `(N,)`.
    - `args`, `in_axes`: what of `args` each trajectory has of its own, as in `jax.vmap`: 0 for a
        leading axis, `None` for what is common to all; a prefix of the tree of `args`.
    - `saveat`: the end, `SaveAt(t1=True)`, the start, times (common to all), and functions of them.
    - `lanes`: how many trajectories advance together, on each device.
    - `mesh`: a `jax.sharding.Mesh`, e.g. `jax.make_mesh((jax.device_count(),), ("trajectories",))`: each of
        its devices, over all of its axes, solves an equal share of the trajectories in lanes of its
        own. What is returned is sharded along the trajectories if their number divides among the devices, and
        whole on each of them if not. Nothing is sent between devices until they are done, and for gradients
        with respect to what is common to all one sum. Of several processes (`jax.distributed`) each passes the
        same arguments. For explicit solvers. By default one device solves all.
    - `throw`: raise a `RuntimeError` if any trajectory fails. By default it has a result code, and
        the others are what they are without it.

    Explicit Runge-Kutta methods with constant steps or `diffrax.PIDController` are advanced so. Other
    solvers, other controllers and systems too large to be written out number by number are solved
    by `diffeqsolve` under `jax.lax.map` in batches of `lanes`.

    **Returns:**

    An [`EnsembleSolution`][]. Reverse mode differentiates with respect to all arrays among the
    arguments (not those that functions close over: pass them in `args`).

    **Raises:**

    As `diffeqsolve`, `ValueError` for leading axes that disagree, and for a `mesh` without devices or
    with an implicit solver, and `TypeError` for a `mesh` that is none.
    """
    if mesh is not None:
        check_mesh(mesh, solver)
    adjoint = StepReplayAdjoint()
    check_arguments(terms, solver, dt0, saveat, stepsize_controller, adjoint, None, consistent)
    batch = checked_batch(t0, t1, dt0, y0s, args, in_axes, saveat, lanes)
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(f"`max_steps` must be a positive integer, got {max_steps!r}.")
    equations = Equations(terms, solver, stepsize_controller, saveat, dt0, max_steps, consistent)

    def solve(inputs: tuple[Equations, Batch], axes: Axes = ()) -> EnsembleSolution:
        equations, batch = inputs
        saveat = checked_times(equations.saveat, batch, axes)
        dt0 = checked_step(equations.dt0, batch, axes)
        inputs = dataclasses.replace(equations, saveat=saveat, dt0=dt0), batch
        solution = _on_one_device(inputs, lanes)
        return _raise_if_any_failed(solution, axes) if throw else solution

    inputs = equations, batch
    return solve(inputs) if mesh is None else over_devices(solve, inputs, mesh)


def _on_one_device(inputs: tuple[Equations, Batch], lanes: int) -> EnsembleSolution:
    solve = _in_lanes if _is_for_lanes(*inputs) else _mapped
    try:
        return solve(inputs, lanes)
    except NotScalarError:
        return _mapped(inputs, lanes)


def _is_for_lanes(equations: Equations, batch: Batch) -> bool:
    one, saveat, solver = batch.one(), equations.saveat, equations.solver
    return (
        isinstance(solver, AbstractManifoldSolver)
        and isinstance(equations.terms, dfx.ODETerm | DirectedTerm)
        and is_unrollable(solver.inner, equations.terms, one.t0, one.t1, one.y0, one.args)
        and type(equations.controller) in (dfx.PIDController, dfx.ConstantStepSize)
        and isinstance(saveat.subs, dfx.SubSaveAt)
        and not (saveat.dense or saveat.subs.steps or saveat.solver_state)
        and not (saveat.controller_state or saveat.made_jump)
    )


@eqx.filter_custom_vjp
def _in_lanes(inputs: tuple[Equations, Batch], lanes: int) -> EnsembleSolution:
    equations, batch = inputs
    solver = equations.solver.within(equations.controller, bends_interpolant=False)
    equations = dataclasses.replace(equations, solver=solver)
    run = Schedule(equations, batch.each, batch.complete, lanes, _LONGEST).run()
    outcome, statistics = run.outcome, run.outcome.statistics
    stats = {
        "num_steps": outcome.num_steps,
        "num_accepted_steps": outcome.num_accepted,
        "num_rejected_steps": outcome.num_steps - outcome.num_accepted,
        "initial_correction": run.start.correction,
        "num_projection_iterations": statistics.iterations,
        "largest_correction": statistics.largest_correction,
        "correction_share": jax.vmap(lambda s: s.correction_share)(statistics),
    }
    ts, ys = saved_rows(equations.saveat.subs, batch, run)
    result = outcome.result
    if not solver.corrects_output:
        finite = jax.vmap(lambda ts, ys: result_of_saved(equations.saveat, ts, ys))(ts, ys)
        result = jax.vmap(update_result)(result, finite)
    return EnsembleSolution(ts, ys, stats, result)


@_in_lanes.def_fwd
def _in_lanes_fwd(perturbed, inputs, lanes):
    del perturbed
    return _in_lanes(inputs, lanes), None


@_in_lanes.def_bwd
def _in_lanes_bwd(residuals, cotangents, perturbed, inputs, lanes):
    """Through the same trajectories, each by the way back of `diffeqsolve`."""
    del residuals
    smooth, rest = eqx.partition(inputs, perturbed)

    def saved(smooth: Any) -> Any:
        solution = _mapped(eqx.combine(smooth, rest), lanes)
        return eqx.filter((solution.ts, solution.ys), eqx.is_inexact_array)

    values, pullback = jax.vjp(saved, smooth)
    bar = jtu.tree_map(
        lambda x, b: jnp.zeros_like(x) if b is None else b,
        values,
        (cotangents.ts, cotangents.ys),
    )
    return pullback(bar)[0]


def _mapped(inputs: tuple[Equations, Batch], lanes: int) -> EnsembleSolution:
    equations, batch = inputs

    def one(of_each: Any) -> tuple[Any, ...]:
        given: Given = batch.complete(of_each)
        sol = diffeqsolve(
            equations.terms,
            equations.solver,
            given.t0,
            given.t1,
            equations.dt0,
            given.y0,
            given.args,
            saveat=equations.saveat,
            stepsize_controller=equations.controller,
            max_steps=equations.max_steps,
            consistent=equations.consistent,
            throw=False,
        )
        stats = {name: x for name, x in sol.stats.items() if name != "max_steps"}
        return sol.ts, sol.ys, stats, sol.result

    return EnsembleSolution(*jax.lax.map(one, batch.each, batch_size=min(lanes, batch.size)))


def _raise_if_any_failed(solution: EnsembleSolution, axes: Axes) -> EnsembleSolution:
    number = largest(jnp.where(solution.failed, number_of_result(solution.result), 0), axes)
    failed = anywhere(solution.failed, axes)
    return eqx.branched_error_if(solution, failed, number, messages_of_results())
