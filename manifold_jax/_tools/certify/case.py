"""The function that is differentiated: the end of a solve as a function of the parameters of a problem."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..._solver.base import AbstractManifoldSolver
from ...problems import Problem
from ..compare.approaches import Approach


# Tolerance of implicit stages with given steps. Their derivative is that of the exact root.
_STAGES = 1e-12
# Limits of steps: Diffrax's default, with which most users run, and a larger one where that does not
# suffice. (Checkpoints depend on it, too.)
_MAX_STEPS, _MORE_STEPS = 4096, 16384


Parameters: TypeAlias = Float[Array, " parameters"]


class Stepping(NamedTuple):
    """The solver, its step size controller, and the limit of steps."""

    solver: dfx.AbstractSolver
    controller: dfx.AbstractStepSizeController
    max_steps: int


@dataclasses.dataclass(frozen=True)
class Case:
    """One problem and approach, solved in two ways.

    The parameters `theta` are those of the problem, or its initial state if it has none. Constraint,
    initial state and vector field are rebuilt for them.

    - `adaptive`: as users do it, the steps chosen anew in each solve.
    - `frozen`: with the steps of one adaptive solve, so that the discrete solution is a smooth
        function of the parameters, which finite differences can be taken of.
    """

    problem: Problem
    approach: Approach
    gain: float
    t1: float
    adaptive: Stepping
    frozen: Stepping

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
        adaptive = Stepping(solver, dfx.PIDController(rtol=tolerance, atol=tolerance), _MORE_STEPS)
        case = Case(problem, approach, gain, t1, adaptive, adaptive)
        saveat = dfx.SaveAt(steps=True)
        sol = jax.jit(lambda theta: case._solve(theta, adaptive, saveat=saveat))(case.theta)
        if sol.result != dfx.RESULTS.successful:
            raise RuntimeError(f"the solve failed: {dfx.RESULTS[sol.result]}")
        ends = np.asarray(sol.ts)
        steps = np.concatenate([[problem.t0], ends[np.isfinite(ends)]])
        if isinstance(solver, dfx.AbstractImplicitSolver):  # has no tolerances from given steps
            exact = optx.Chord(rtol=_STAGES, atol=_STAGES)
            solver = eqx.tree_at(lambda s: s.root_finder, solver, exact)
        if sol.stats["num_steps"] < 0.9 * _MAX_STEPS:
            adaptive = adaptive._replace(max_steps=_MAX_STEPS)
        return dataclasses.replace(
            case,
            adaptive=adaptive,
            frozen=Stepping(solver, dfx.StepTo(ts=jnp.asarray(steps)), len(steps) - 1),
        )

    @property
    def theta(self) -> Parameters:
        parameters = self.problem.y0 if self.problem.args is None else self.problem.args
        return jfu.ravel_pytree(parameters)[0]

    @property
    def is_corrected(self) -> bool:
        """Whether the approach has a hook of this library around the solver."""
        formulation = self.approach.formulate(self.problem, self.adaptive.solver, self.gain)
        return isinstance(formulation.solver, AbstractManifoldSolver)

    def problem_at(self, theta: Parameters) -> Problem:
        if self.problem.args is None:
            return self.problem.with_initial(jfu.ravel_pytree(self.problem.y0)[1](theta))
        return self.problem.with_args(jfu.ravel_pytree(self.problem.args)[1](theta))

    def _solve(self, theta: Parameters, stepping: Stepping, **options: Any) -> dfx.Solution:
        problem = self.problem_at(theta)
        formulation = self.approach.formulate(problem, stepping.solver, self.gain)
        return formulation.solve(
            problem.t0,
            self.t1,
            problem.y0,
            problem.args,
            stepsize_controller=stepping.controller,
            max_steps=stepping.max_steps,
            **options,
        )

    def end(
        self, theta: Parameters, adjoint: dfx.AbstractAdjoint, stepping: Stepping
    ) -> Float[Array, " n"]:
        """Return the last state; not a number if the solve fails."""
        sol = self._solve(theta, stepping, adjoint=adjoint, saveat=dfx.SaveAt(t1=True))
        y = jfu.ravel_pytree(sol.ys)[0]
        return jnp.where(sol.result == dfx.RESULTS.successful, y, jnp.nan)

    def objective(
        self, theta: Parameters, adjoint: dfx.AbstractAdjoint, stepping: Stepping
    ) -> Float[Array, ""]:
        return _weighted_sum(self.end(theta, adjoint, stepping))

    def outcome(
        self, theta: Parameters, adjoint: dfx.AbstractAdjoint, stepping: Stepping
    ) -> tuple[Float[Array, ""], Float[Array, " n"], Float[Array, " m"]]:
        """Return the objective, the last state, and `g` there: its derivative is zero where
        sensitivities are tangent."""
        problem, end = self.problem_at(theta), self.end(theta, adjoint, stepping)
        y = jfu.ravel_pytree(problem.y0)[1](end)
        residual = jfu.ravel_pytree(problem.constraint(self.t1, y, problem.args))[0]
        return _weighted_sum(end), end, residual

    def exact_gradient(self) -> np.ndarray | None:
        """Return the gradient of the exact solution, by differences; `None` if it is not known."""

        def value(theta: np.ndarray) -> float:
            y = self.problem_at(jnp.asarray(theta)).reference(self.t1)
            return float(_weighted_sum(jfu.ravel_pytree(y)[0]))

        if self.problem.args is None:
            return None  # moved off the manifold, where formulas do not hold
        try:
            return differences(value, np.asarray(self.theta))
        except ValueError:
            return None


def _weighted_sum(y: Float[Array, " n"]) -> Float[Array, ""]:
    """The function that is differentiated; the weights have no symmetry."""
    return y @ jnp.cos(1 + jnp.arange(y.size, dtype=y.dtype))


def differences(value: Callable[[np.ndarray], float], theta: np.ndarray) -> np.ndarray:
    """Return central differences of sixth order, with `theta_i` changed by at most 4e-4 of its size.

    Small, as charts are chosen anew along a solution: where that choice changes in between, the
    discrete solution jumps by its own error.
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
