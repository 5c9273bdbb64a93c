"""The front end of ensembles."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._adjoint import StepReplayAdjoint
from .._compat import messages_of_results, number_of_result
from .._custom_types import Args, RealScalarLike, Y
from .._directed_term import DirectedTerm
from .._errors import clear_errors
from .._scalar import NotScalarError
from .._solve.arguments import check_arguments
from .._solve.start import Consistent
from .._solver.base import AbstractManifoldSolver
from .._solver.explicit import is_unrollable
from .arguments import Batch, checked_batch, checked_step, checked_times
from .in_lanes import solve_in_lanes, solve_in_lanes_forwards
from .mapped import solve_mapped
from .solution import EnsembleSolution
from .trajectory import Equations


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
    adjoint: dfx.AbstractAdjoint = StepReplayAdjoint(),
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
    - `lanes`: how many trajectories advance together.
    - `adjoint`: the mode of differentiation: reverse, or `diffrax.ForwardMode()` for `jax.jvp` and
        `jax.jacfwd`. Both make the steps again that the solve made.
    - `throw`: raise a `RuntimeError` if any trajectory fails. By default it has a result code, and
        the others are what they are without it.

    Explicit Runge-Kutta methods with constant steps or `diffrax.PIDController` are advanced so. Other
    solvers, other controllers and systems too large to be written out number by number are solved
    by `diffeqsolve` under `jax.lax.map` in batches of `lanes`.

    **Returns:**

    An [`EnsembleSolution`][]. Reverse mode differentiates with respect to all arrays among the
    arguments (not those that functions close over: pass them in `args`).

    **Raises:**

    As `diffeqsolve`, and `ValueError` for leading axes that disagree.
    """
    check_arguments(terms, solver, dt0, saveat, stepsize_controller, adjoint, None, consistent)
    batch = checked_batch(t0, t1, dt0, y0s, args, in_axes, saveat, lanes)
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(f"`max_steps` must be a positive integer, got {max_steps!r}.")
    saveat, dt0 = checked_times(saveat, batch), checked_step(dt0, batch)
    equations = Equations(
        terms, solver, stepsize_controller, saveat, dt0, adjoint, max_steps, consistent
    )
    forwards = isinstance(adjoint, dfx.ForwardMode)
    in_lanes = solve_in_lanes_forwards if forwards else solve_in_lanes
    solve = in_lanes if _is_for_lanes(equations, batch) else solve_mapped
    try:
        solution = solve((equations, batch), lanes)
    except NotScalarError:
        solution = solve_mapped((equations, batch), lanes)
    return _raise_if_any_failed(solution) if throw else solution


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
        and isinstance(equations.adjoint, StepReplayAdjoint | dfx.ForwardMode)
    )


def _raise_if_any_failed(solution: EnsembleSolution) -> EnsembleSolution:
    failed = solution.failed
    number = jnp.max(jnp.where(failed, number_of_result(solution.result), 0))
    return eqx.branched_error_if(solution, jnp.any(failed), number, messages_of_results())
