"""From the residual of a problem of the board to its solution, and the derivative of that."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

import manifold_jax as mj

from .problem import BoardProblem


MAX_STEPS = 50_000
# Of the parameter, for differences of fourth order.
STEP = 1e-3


class Reduction(NamedTuple):
    problem: BoardProblem
    dae: mj.ReducedDAE
    start: Any
    args: Any
    seconds: float

    @staticmethod
    def of(problem: BoardProblem) -> "Reduction":
        start, args = (jtu.tree_map(jnp.asarray, tree) for tree in (problem.start, problem.args))
        before = time.perf_counter()
        dae = mj.reduce_dae(problem.residual, start, args, form=problem.form)
        return Reduction(problem, dae, start, args, time.perf_counter() - before)

    @property
    def solver(self) -> Any:
        solver = getattr(mj, self.problem.solver, None) or getattr(dfx, self.problem.solver)
        if self.dae.report.num_constraints == 0:
            return solver()
        return mj.Projected(solver(), self.dae.constraint)

    def consistent(self, args: Any) -> Any:
        return self.dae.consistent_state(0.0, self.start, args, throw=False)[0]

    def solve(self, z0: Any, args: Any, t1: float, **options: Any) -> Any:
        problem = self.problem
        controller: Any = dfx.PIDController(rtol=problem.rtol, atol=problem.atol)
        jumps = [t for t in problem.jumps if t < t1]
        if jumps:
            controller = dfx.ClipStepSizeController(controller, jump_ts=jnp.asarray(jumps))
        return mj.diffeqsolve(
            self.dae.terms,
            self.solver,
            0.0,
            t1,
            problem.dt0,
            z0,
            args,
            stepsize_controller=controller,
            max_steps=MAX_STEPS,
            throw=False,
            **options,
        )

    def outputs(self, z: Any, args: Any, t: float) -> Any:
        return self.dae.outputs(t, z, args)[0]

    def violation(self, z: Any, args: Any) -> float:
        if self.dae.report.num_constraints == 0:
            return 0.0
        return float(mj.constraint_violation(self.dae.constraint, self.problem.t1, z, args))


class Gradients(NamedTuple):
    """Of a combination of the unknowns with published values, at the end of the short time, by the
    parameter: relative differences of forward mode and of differences from reverse mode."""

    seconds: float
    forward: float
    differences: float


def gradients(reduction: Reduction) -> Gradients:
    problem = reduction.problem
    t1 = problem.t1 if problem.short is None else problem.short
    if problem.short_tolerance is not None:
        tolerances = dict(rtol=problem.short_tolerance, atol=problem.short_tolerance)
        reduction = reduction._replace(problem=problem._replace(**tolerances))
    value = problem.args[problem.parameter]

    def combination(parameter: Any, **options: Any) -> Any:
        args = {**reduction.args, problem.parameter: parameter}
        sol = reduction.solve(reduction.consistent(args), args, t1, **options)
        x = reduction.outputs(sol.ys[-1], args, t1)
        parts = [jnp.ravel(x[name])[~np.isnan(np.ravel(problem.end[name]))] for name in problem.end]
        every = jnp.concatenate(parts)
        return every @ jnp.cos(jnp.arange(float(every.size)))

    one = jnp.asarray(float(value))
    before = time.perf_counter()
    reverse = float(jax.jit(jax.grad(combination))(one))
    seconds = time.perf_counter() - before
    along = lambda p: combination(p, adjoint=dfx.ForwardMode())
    both = jax.jit(lambda p: jax.jvp(along, (p,), (jnp.ones_like(p),)))
    forward, h = float(both(one)[1]), STEP * value
    near, far = (float(both(one + k * h)[0]) - float(both(one - k * h)[0]) for k in (1, 2))
    differences = (8 * near - far) / (12 * h)
    size = max(abs(reverse), 1e-300)
    return Gradients(seconds, abs(forward - reverse) / size, abs(differences - reverse) / size)


def residual_in_numbers(reduction: Reduction) -> tuple[Callable, np.ndarray, np.ndarray]:
    """`F(t, x, x')` in vectors, for other libraries, with a consistent `x` and `x'`."""
    problem, args = reduction.problem, reduction.args
    x0, xdot0 = reduction.dae.outputs(0.0, reduction.consistent(args), args)
    _, unravel = jfu.ravel_pytree(x0)
    ravel = lambda tree: jfu.ravel_pytree(tree)[0]

    @jax.jit
    def residual(t: Any, x: Any, xdot: Any) -> Any:
        return ravel(problem.residual(jnp.asarray(t, float), unravel(x), unravel(xdot), args))

    return residual, np.asarray(ravel(x0)), np.asarray(ravel(xdot0))
