"""The function that is differentiated: the end of a solve, of the parameters of a problem."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._compare.approaches import Approach
from .._solver.base import AbstractManifoldSolver
from ..problems import Problem


# Tolerance of implicit stages. Their derivative is that of the exact root.
_STAGES = 1e-12


@dataclasses.dataclass(frozen=True)
class Case:
    """One problem, approach and solver, with the steps of an adaptive solve.

    The parameters `theta` are those of the problem, or its initial state if it has none. What
    depends on them is rebuilt: constraint, initial state, vector field. The steps are given,
    so that the discrete solution is a smooth function of them.
    """

    problem: Problem
    approach: Approach
    solver: dfx.AbstractSolver
    gain: float
    t1: float
    steps: np.ndarray

    @staticmethod
    def build(
        problem: Problem,
        approach: Approach,
        solver: dfx.AbstractSolver,
        gain: float,
        t1: float,
        tolerance: float,
    ) -> "Case":
        """Solve once, adaptively, and keep the steps. Raises `RuntimeError` if that fails."""
        if isinstance(solver, dfx.AbstractImplicitSolver):  # has no tolerances from given steps
            exact = optx.Chord(rtol=_STAGES, atol=_STAGES)
            solver = eqx.tree_at(lambda s: s.root_finder, solver, exact)
        case = Case(problem, approach, solver, gain, t1, np.empty(0))
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        sol = jax.jit(
            lambda theta: case.solve(
                theta, dfx.RecursiveCheckpointAdjoint(), controller, dfx.SaveAt(steps=True), 16384
            )
        )(case.theta)
        if sol.result != dfx.RESULTS.successful:
            raise RuntimeError(f"the solve failed: {dfx.RESULTS[sol.result]}")
        ends = np.asarray(sol.ts)
        steps = np.concatenate([[problem.t0], ends[np.isfinite(ends)]])
        return dataclasses.replace(case, steps=steps)

    @property
    def theta(self) -> Float[Array, " parameters"]:
        parameters = self.problem.y0 if self.problem.args is None else self.problem.args
        return jfu.ravel_pytree(parameters)[0]

    @property
    def is_corrected(self) -> bool:
        """Whether the approach has a hook of this library around the solver."""
        formulation = self.approach.formulate(self.problem, self.solver, self.gain)
        return isinstance(formulation.solver, AbstractManifoldSolver)

    def problem_at(self, theta: Float[Array, " parameters"]) -> Problem:
        if self.problem.args is None:
            return self.problem.with_initial(jfu.ravel_pytree(self.problem.y0)[1](theta))
        return self.problem.with_args(jfu.ravel_pytree(self.problem.args)[1](theta))

    def solve(
        self,
        theta: Float[Array, " parameters"],
        adjoint: dfx.AbstractAdjoint,
        controller: dfx.AbstractStepSizeController,
        saveat: dfx.SaveAt,
        max_steps: int,
    ) -> dfx.Solution:
        problem = self.problem_at(theta)
        function, terms, solver = self.approach.formulate(problem, self.solver, self.gain)
        return function(
            terms,
            solver,
            problem.t0,
            self.t1,
            None,
            problem.y0,
            problem.args,
            saveat=saveat,
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=max_steps,
            throw=False,
        )

    def end(
        self, theta: Float[Array, " parameters"], adjoint: dfx.AbstractAdjoint
    ) -> Float[Array, " n"]:
        """The last state, with the given steps."""
        controller = dfx.StepTo(ts=jnp.asarray(self.steps))
        num_steps = len(self.steps) - 1
        sol = self.solve(theta, adjoint, controller, dfx.SaveAt(t1=True), num_steps)
        return jfu.ravel_pytree(sol.ys)[0]

    def objective(self, adjoint: dfx.AbstractAdjoint) -> Callable[[Any], Float[Array, ""]]:
        """A weighted sum of the last state; the weights have no symmetry."""

        def value(theta):
            y = self.end(theta, adjoint)
            return y @ jnp.cos(1 + jnp.arange(y.size, dtype=y.dtype))

        return value

    def residual(
        self, theta: Float[Array, " parameters"], adjoint: dfx.AbstractAdjoint
    ) -> Float[Array, " m"]:
        """`g` of the last state: its derivative is zero where sensitivities are tangent."""
        problem = self.problem_at(theta)
        y = jfu.ravel_pytree(problem.y0)[1](self.end(theta, adjoint))
        return jfu.ravel_pytree(problem.constraint(self.t1, y, problem.args))[0]

    def exact_gradient(self) -> np.ndarray | None:
        """Of the exact solution instead, by differences of it; `None` where it is not known."""

        def value(theta: np.ndarray) -> float:
            y = self.problem_at(jnp.asarray(theta)).reference(self.t1)
            row = np.concatenate([np.ravel(leaf) for leaf in jax.tree_util.tree_leaves(y)])
            return float(row @ np.cos(1 + np.arange(row.size)))

        if self.problem.args is None:
            return None  # moved off the manifold, where formulas do not hold
        try:
            return differences(value, np.asarray(self.theta))
        except ValueError:
            return None


def differences(value: Callable[[np.ndarray], float], theta: np.ndarray) -> np.ndarray:
    """Central differences of sixth order, `theta_i` changed by at most 4e-4 of its size.

    Small, as charts are chosen anew along a solution: where a choice falls differently in
    between, the discrete solution jumps by its own error.
    """
    gradient = np.empty_like(theta)
    for i, size in enumerate(np.maximum(np.abs(theta), 0.1)):
        unit = np.eye(theta.size)[i]

        def slope(h: float, unit: np.ndarray = unit) -> float:
            return (value(theta + h * unit) - value(theta - h * unit)) / (2 * h)

        h = 1e-4 * size
        fine, middle, coarse = slope(h), slope(2 * h), slope(4 * h)
        better, good = (4 * fine - middle) / 3, (4 * middle - coarse) / 3
        gradient[i] = (16 * better - good) / 15
    return gradient
