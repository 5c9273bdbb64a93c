"""The ways to solve a problem that `benchmarks.peers.approaches` compares: prepared once, run at any
tolerance."""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import scipy.integrate

from manifold_jax._tools.compare.approaches import Approach, default_gain, Formulation
from manifold_jax._tools.compare.task import as_rows
from manifold_jax.problems import Problem

from ..tools.measure import compiled_for_any
from ._counting import Counter, Evaluations


# Times of the output: few, as interpolating and correcting it takes time, too.
OUTPUT_POINTS = 21
MAX_STEPS = 2**15
SCIPY_METHODS = ("RK45", "DOP853")


class Examined(NamedTuple):
    """What a second, untimed solve finds: the ends of the accepted steps and the states there,
    and what it cost; `None` where a number is not known."""

    times: np.ndarray
    states: np.ndarray
    evaluations: Evaluations
    rejected: int | None = None
    iterations_per_step: float | None = None


class Candidate(Protocol):
    """Prepared for one problem; raises `RuntimeError` where a solve fails."""

    compile_s: float | None

    def program(self, tolerance: float) -> Callable[[], Any]:
        """What is timed: solves with output, and blocks until that is there."""
        ...

    def states(self, result: Any) -> np.ndarray:
        """Of the result of that program: the states at the output times, `(times, n)`."""
        ...

    def examine(self, tolerance: float) -> Examined: ...


def output_times(problem: Problem) -> np.ndarray:
    return np.linspace(problem.t0, problem.t1, OUTPUT_POINTS)


class _Outcome(NamedTuple):
    ts: Any
    ys: Any
    stats: dict[str, Any]
    result: dfx.RESULTS


def _integrate(
    problem: Problem,
    formulation: Formulation,
    saveat: dfx.SaveAt,
    tolerance: Any,
    y0: Any,
    args: Any,
) -> _Outcome:
    sol = formulation.function(
        formulation.terms,
        formulation.solver,
        problem.t0,
        problem.t1,
        None,
        y0,
        args,
        saveat=saveat,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=MAX_STEPS,
        throw=False,
    )
    return _Outcome(sol.ts, sol.ys, sol.stats, sol.result)


def _inputs(problem: Problem, tolerance: float) -> tuple[Any, Any, Any]:
    return jnp.asarray(tolerance), problem.y0, problem.args


def _checked(outcome: _Outcome) -> _Outcome:
    if outcome.result != dfx.RESULTS.successful:
        raise RuntimeError(dfx.RESULTS[outcome.result].partition("\n")[0] or "failed")
    return outcome


@dataclasses.dataclass
class OfDiffrax:
    """A Diffrax solver in one of the approaches. Two programs: one to be timed, and one that
    counts evaluations and keeps the steps. The tolerance is an argument of both."""

    problem: Problem
    timed: Callable[..., _Outcome]
    counted: Callable[..., _Outcome]
    counter: Counter
    compile_s: float | None

    @staticmethod
    def prepare(problem: Problem, approach: Approach, solver: dfx.AbstractSolver) -> "OfDiffrax":
        counter, gain = Counter(), default_gain(problem)
        at_output = dfx.SaveAt(ts=jnp.asarray(output_times(problem)))
        plain = approach.formulate(problem, solver, gain)
        watched = approach.formulate(counter.with_counted_constraint(problem), solver, gain)
        watched = counter.with_counted_field(watched)
        inputs = _inputs(problem, 1e-3)
        timed = functools.partial(_integrate, problem, plain, at_output)
        timed, seconds = compiled_for_any(timed, *inputs)
        counted = functools.partial(_integrate, problem, watched, dfx.SaveAt(steps=True))
        # not timed: half the time to compile
        counted = jax.jit(counted).lower(*inputs)
        counted = counted.compile(compiler_options={"xla_backend_optimization_level": "0"})
        return OfDiffrax(problem, timed, counted, counter, seconds.wall_s)

    def program(self, tolerance: float) -> Callable[[], _Outcome]:
        return functools.partial(self.timed, *_inputs(self.problem, tolerance))

    def states(self, result: _Outcome) -> np.ndarray:
        return as_rows(_checked(result).ys)

    def examine(self, tolerance: float) -> Examined:
        self.counter.reset()
        outcome = jax.block_until_ready(self.counted(*_inputs(self.problem, tolerance)))
        jax.effects_barrier()
        stats = _checked(outcome).stats
        times = np.asarray(outcome.ts)
        used = np.isfinite(times)
        iterations = stats.get("num_projection_iterations")
        if iterations is not None:
            iterations = float(iterations) / int(stats["num_accepted_steps"])
        return Examined(
            times[used],
            as_rows(outcome.ys)[used],
            self.counter.evaluations(),
            int(stats["num_rejected_steps"]),
            iterations,
        )


@dataclasses.dataclass
class OfScipy:
    """`scipy.integrate.solve_ivp`, which calls the compiled vector field from Python."""

    problem: Problem
    method: str
    field: Callable
    compile_s: float | None = None

    @staticmethod
    def prepare(problem: Problem, method: str) -> "OfScipy":
        unravel = jfu.ravel_pytree(problem.y0)[1]

        @jax.jit
        def field(t: Any, x: Any) -> Any:
            return jfu.ravel_pytree(problem.terms.vf(t, unravel(x), problem.args))[0]

        return OfScipy(problem, method, field)

    def program(self, tolerance: float) -> Callable[[], Any]:
        return functools.partial(self._solve, tolerance, output_times(self.problem))

    def states(self, result: Any) -> np.ndarray:
        if not result.success:
            raise RuntimeError(result.message)
        return result.y.T

    def examine(self, tolerance: float) -> Examined:
        result = self._solve(tolerance, None)
        states = self.states(result)
        return Examined(result.t[1:], states[1:], Evaluations(int(result.nfev), 0, 0, 0))

    def _solve(self, tolerance: float, times: np.ndarray | None) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # steps that fail: the result says it, too
            return scipy.integrate.solve_ivp(
                lambda t, x: np.asarray(self.field(t, x)),
                (self.problem.t0, self.problem.t1),
                np.asarray(jfu.ravel_pytree(self.problem.y0)[0]),
                self.method,
                times,
                rtol=tolerance,
                atol=tolerance,
            )
