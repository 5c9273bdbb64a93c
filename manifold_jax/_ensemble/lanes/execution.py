"""The choice between the two ways to solve an ensemble: in lanes if possible, else mapped."""

import dataclasses

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._adjoint import StepReplayAdjoint
from ..._jaxpr.lane_arrays import NotScalarError
from ..._rosenbrock import AbstractRosenbrock
from ..._solver.base import AbstractManifoldSolver
from ..._solver.on_manifold import AbstractStepsOnManifold
from ..._solver.step.explicit import is_unrollable
from ..._solver.terms import DirectedTerm
from ..._solver.unconstrained import Unconstrained
from .in_lanes import solve_in_lanes, solve_in_lanes_forwards
from .mapped import solve_mapped
from .parts import Inputs
from .solution import EnsembleSolution


# Largest number of unknowns for which the elimination of a Rosenbrock method is written out in lanes:
# five (eight) take 0.1 (0.17) of the time of `vmap`, jaxlib 0.12.0.1. More take too long to compile.
LARGEST_STIFF = 8


def solve_on_one_device(inputs: Inputs) -> EnsembleSolution:
    solver = inputs.equations.solver
    if not isinstance(solver, AbstractManifoldSolver):
        # Lanes advance solvers of this library, one of which leaves states unchanged.
        inputs = inputs.with_solver(Unconstrained(solver))
    obstacle = _obstacle(inputs)
    if obstacle is None:
        forwards = isinstance(inputs.equations.adjoint, dfx.ForwardMode)
        solve = solve_in_lanes_forwards if forwards else solve_in_lanes
        written_out, inner = inputs, inputs.equations.solver.inner
        if isinstance(inner, AbstractRosenbrock):
            inner = dataclasses.replace(inner, largest_written_out=LARGEST_STIFF)
            written_out = inputs.with_solver(Unconstrained(inner))
        try:
            return solve(written_out)
        except NotScalarError as error:
            obstacle = str(error)
    execution = f"mapped over, not in lanes: {obstacle}"
    return dataclasses.replace(solve_mapped(inputs), execution=execution)


def _obstacle(inputs: Inputs) -> str | None:
    """Return the reason why trajectories cannot be solved in lanes, if there is one."""
    equations, batch = inputs
    one, saveat, solver = batch.one(), equations.saveat, equations.solver
    if not isinstance(equations.terms, dfx.ODETerm | DirectedTerm):
        return f"`terms` are {type(equations.terms).__name__}, not an ODETerm"
    if isinstance(solver, Unconstrained) and isinstance(solver.inner, AbstractRosenbrock):
        size = sum(jnp.size(leaf) for leaf in jtu.tree_leaves(one.y0))
        if size > LARGEST_STIFF:
            return f"more than {LARGEST_STIFF} unknowns of a stiff system"
    elif not isinstance(solver, AbstractStepsOnManifold) and not is_unrollable(
        solver.inner, equations.terms, one.t0, one.t1, one.y0, one.args
    ):
        return f"{type(solver.inner).__name__} is not an explicit Runge-Kutta method"
    if equations.event is not None:
        return "an `event` is searched for"
    if equations.resets:
        return "there are `resets`"
    if type(equations.controller) not in (dfx.PIDController, dfx.ConstantStepSize):
        return f"`stepsize_controller` is {type(equations.controller).__name__}"
    if not isinstance(equations.adjoint, StepReplayAdjoint | dfx.ForwardMode):
        return f"`adjoint` is {type(equations.adjoint).__name__}"
    others = saveat.solver_state or saveat.controller_state or saveat.made_jump
    if not isinstance(saveat.subs, dfx.SubSaveAt) or others:
        return "`saveat` asks for more than states"
    return "`saveat` asks for steps" if saveat.dense or saveat.subs.steps else None
