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

from ..._adjoint import StepReplayAdjoint
from ..._base.errors import clear_errors, refuse_old_names
from ..._base.numbers import numbers_as_arrays
from ..._base.types import Args, RealScalarLike, Y
from ..._resets.reset import check_resets
from ..._solve.arguments import (
    check_arguments,
    check_field,
    check_shape_of_tolerances,
    warn_of_rounding,
    with_positive_tolerance,
    without_idle_hook,
)
from ..._solve.given_numbers import checking_numbers
from ..._solve.setup import Consistent
from ..lanes.arguments import (
    anywhere,
    Axes,
    Batch,
    checked_batch,
    checked_step,
    checked_times,
    largest,
)
from ..lanes.execution import solve_on_one_device
from ..lanes.parts import Inputs
from ..lanes.solution import EnsembleSolution, messages_of
from ..lanes.trajectory import LaneEquations
from .devices import check_mesh, default_lanes, over_devices


@refuse_old_names(in_axes="args_axes")
@clear_errors
@checking_numbers(several_times=True)
@numbers_as_arrays("y0s", "args", times=("t0", "t1", "dt0"))
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
    event: dfx.Event | None = None,
    resets: Any = (),
    max_resets: int = 100,
    args_axes: Any = None,
    lanes: int | None = None,
    adjoint: dfx.AbstractAdjoint = StepReplayAdjoint(),
    mesh: Mesh | None = None,
    throw: bool = False,
    consistent: Consistent = "project",
) -> EnsembleSolution:
    """Solve a differential equation on a manifold for many initial values and parameters.

    Each trajectory is that of [`diffeqsolve`][], to rounding: the same accepted steps, and on the
    manifold at every value returned. `lanes` of them advance together, with steps of their own; one
    that has ended, or failed, makes room for the next at once, so that none waits for the
    longest. Every component of the state is a vector of lanes of its own, in which constants and
    structural zeros are folded before XLA sees them: four to eight times as fast as `jax.vmap` of
    `diffeqsolve` for double pendulums, twice as fast for a rigid body.

    **Arguments:** as [`diffeqsolve`][], and

    - `y0s`: initial values, any pytree; the leading axis of each leaf is that of the `N` trajectories.
    - `t0`, `t1`: common to all, or of shape `(N,)`.
    - `args`, `args_axes`: a prefix of the tree of `args` with 0 for leaves that have a leading axis of
        trajectories, and `None` for those common to all; by default all are common.
    - `saveat`: the end, `SaveAt(t1=True)`, the start, times (common to all), and functions of them.
    - `event`, `resets`, `max_resets`: as of [`diffeqsolve`][], for each trajectory on its own. What differs
        between trajectories, such as `mj.ResetAt(lambda args: args["doses"], jump)`, is in `args`.
    - `lanes`: how many trajectories advance together, on each device; by default 128 on a CPU, 262144 on others.
    - `adjoint`: the mode of differentiation: reverse, or `diffrax.ForwardMode()` for `jax.jvp` and
        `jax.jacfwd`. Both make the steps again that the solve made.
    - `mesh`: a `jax.sharding.Mesh`, e.g. `jax.make_mesh((jax.device_count(),), ("trajectories",))`: each of
        its devices, over all of its axes, solves an equal share of the trajectories in its own lanes.
        Results are sharded along the trajectories if their number is a multiple of that of the devices, and
        replicated otherwise. Nothing is sent between devices until they are done; gradients with respect
        to common arguments take one sum. All processes (`jax.distributed`) pass the same arguments. For
        explicit solvers. By default one device solves all.
    - `throw`: raise a `RuntimeError` if any trajectory fails. By default it gets a result code, and
        the others are not affected.

    Explicit Runge-Kutta methods, in a hook or alone, [`rattle`][], [`SymmetricProjection`][] and [`Relaxation`][],
    and [`Rodas5P`][] and [`Rodas3P`][] alone for up to eight unknowns, with constant steps or
    `diffrax.PIDController`, are advanced in lanes. Other solvers, mass matrices, other controllers, events, resets
    and systems too large to be written out number by number are solved by `diffeqsolve` under `jax.lax.map` in
    batches of `lanes`. `execution` of the solution says which of the two was used, and why.

    **Returns:**

    An [`EnsembleSolution`][]. Reverse mode differentiates with respect to all arrays among the
    arguments (not those that functions close over: pass them in `args`).

    **Raises:**

    As `diffeqsolve`, `ValueError` for leading axes that disagree, and for a `mesh` without devices or
    with an implicit solver, and `TypeError` for a `mesh` of another type.
    """
    if mesh is not None:
        check_mesh(mesh, solver)
    lanes = default_lanes(mesh) if lanes is None else lanes
    check_arguments(terms, solver, dt0, saveat, stepsize_controller, adjoint, event, consistent)
    check_resets(resets, max_resets, None)
    batch = checked_batch(t0, t1, dt0, y0s, args, args_axes, saveat, lanes)
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(f"`max_steps` must be a positive integer, got {max_steps!r}.")
    one = jax.eval_shape(batch.one)
    try:
        check_field(terms, one.t0, one.y0, one.args)
    except ValueError as error:
        raise ValueError(f"{error}{_common_rows(batch)}") from None
    check_shape_of_tolerances(stepsize_controller, one.y0)
    warn_of_rounding(one.y0, batch.dtype, stepsize_controller)
    solver = without_idle_hook(solver, one.t0, one.y0, one.args)
    equations = LaneEquations(
        terms,
        solver,
        with_positive_tolerance(stepsize_controller, one.y0),
        saveat,
        dt0,
        adjoint,
        max_steps,
        lanes,
        consistent,
        event,
        resets,
        max_resets,
    )

    def solve(inputs: Inputs, axes: Axes = ()) -> EnsembleSolution:
        equations, batch = inputs
        saveat = checked_times(equations.saveat, batch, axes)
        dt0 = checked_step(equations.dt0, batch, axes)
        equations = dataclasses.replace(equations, saveat=saveat, dt0=dt0)
        try:
            solution = solve_on_one_device(Inputs(equations, batch))
        except Exception as error:
            error.add_note(_example(batch))
            raise
        solution = dataclasses.replace(solution, messages=messages_of(solver, bool(resets)))
        if not throw:
            return solution
        number, failed = largest(solution.reasons(), axes), anywhere(solution.failed, axes)
        return eqx.branched_error_if(solution, failed, number, solution.messages)

    inputs = Inputs(equations, batch)
    return solve(inputs) if mesh is None else over_devices(solve, inputs, mesh)


def _example(batch: Batch) -> str:
    """Describe one trajectory, for errors in the user's functions."""
    one = jax.eval_shape(batch.one)
    return (
        f"Of the {batch.size} trajectories of `y0s` each has a state of shapes {jtu.tree_map(jnp.shape, one.y0)}: the "
        f"leading axes are the trajectories. One alone is solved by `mj.diffeqsolve`.{_common_rows(batch)}"
    )


def _common_rows(batch: Batch) -> str:
    """Name what is common to all trajectories although it has as many rows as there are trajectories."""
    leaves = jtu.tree_leaves_with_path(batch.common.args)
    found = [
        f"`args{jtu.keystr(path)}`"
        for path, x in leaves
        if getattr(x, "shape", ())[:1] == (batch.size,)
    ]
    if not found:
        return ""
    return (
        f" All {batch.size} trajectories get the whole of {', '.join(found[:5])}: if it has one row for each of them, mark it "
        "by 0 in `args_axes`, such as `args_axes=0`."
    )
