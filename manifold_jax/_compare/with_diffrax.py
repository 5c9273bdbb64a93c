"""Diffrax's solvers, plain and wrapped by this library."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from .._diffeqsolve import diffeqsolve
from .._solver import Projected
from .task import as_rows, Run, SolveFailed, Task
from .timing import median_ms


# Those with an error estimate that take one vector field (KenCarp and Sil3 take two).
SOLVERS: dict[str, type[dfx.AbstractSolver]] = {
    solver.__name__.lower(): solver
    for solver in (
        dfx.Heun,
        dfx.Midpoint,
        dfx.Ralston,
        dfx.Bosh3,
        dfx.Tsit5,
        dfx.Dopri5,
        dfx.Dopri8,
        dfx.ImplicitEuler,
        dfx.Kvaerno3,
        dfx.Kvaerno4,
        dfx.Kvaerno5,
    )
}

# Diffrax has to know the number of steps beforehand: the limit starts at Diffrax's own
# default and is doubled until the solve finishes, up to about a minute of steps.
FIRST_MAX_STEPS = 4096
LAST_MAX_STEPS = 2**20


class _Solve(NamedTuple):
    """How a task is solved.

    - `function`, `solver`: the function that solves, and what to pass to it.
    - `extra_evaluations`: of the vector field, before the solver starts.
    """

    function: Callable[..., dfx.Solution]
    solver: dfx.AbstractSolver
    extra_evaluations: int


class _Outcome(NamedTuple):
    ts: Any
    ys: Any
    stats: dict[str, Any]
    result: dfx.RESULTS


def run_plain(task: Task) -> Run:
    """`diffrax.diffeqsolve` with the solver as it is."""
    return _run(task, _Solve(dfx.diffeqsolve, SOLVERS[task.solver](), 0))


def run_projected(task: Task) -> Run:
    """`mj.diffeqsolve` with the solver projected."""
    solver = Projected(SOLVERS[task.solver](), task.problem.constraint)
    # two evaluations choose the first step (Diffrax starts with 0.01 whatever the problem)
    return _run(task, _Solve(diffeqsolve, solver, 2))


def _run(task: Task, solve: _Solve) -> Run:
    saveat, max_steps = dfx.SaveAt(ts=jnp.asarray(task.grid)), FIRST_MAX_STEPS
    program, seconds = _compiled(task, solve, saveat, max_steps)
    outcome = program()
    if outcome.result == dfx.RESULTS.max_steps_reached:
        max_steps = _sufficient_max_steps(task, solve)
        program, seconds = _compiled(task, solve, saveat, max_steps)
        outcome = program()
    _raise_if_failed(outcome)
    run_ms = median_ms(program)
    step_times, steps, counted = _steps(task, solve, max_steps)
    stats = {name: int(outcome.stats[f"num_{name}_steps"]) for name in ("accepted", "rejected")}
    evaluations = _explicit_evaluations(task, solve, sum(stats.values()))
    return Run(
        output=as_rows(outcome.ys),
        step_times=step_times,
        steps=steps,
        **stats,
        evaluations=counted if evaluations is None else evaluations,
        run_ms=run_ms,
        compile_s=seconds,
        max_steps=max_steps,
    )


def _compiled(
    task: Task,
    solve: _Solve,
    saveat: dfx.SaveAt,
    max_steps: int,
    terms: dfx.AbstractTerm | None = None,
) -> tuple[Callable[[], _Outcome], float]:
    """The program, ready to run to its end, and the seconds it took to trace and compile."""
    problem = task.problem

    def run(y0, args):
        sol = solve.function(
            problem.terms if terms is None else terms,
            solve.solver,
            task.t0,
            task.t1,
            None,
            y0,
            args,
            saveat=saveat,
            stepsize_controller=dfx.PIDController(rtol=task.rtol, atol=task.atol),
            max_steps=max_steps,
            throw=False,
        )
        return _Outcome(sol.ts, sol.ys, sol.stats, sol.result)

    # Otherwise the second method profits from what was traced for the first.
    jax.clear_caches()
    start = time.perf_counter()
    program = jax.jit(run).lower(problem.y0, problem.args).compile()
    seconds = time.perf_counter() - start
    return lambda: jax.block_until_ready(program(problem.y0, problem.args)), seconds


def _sufficient_max_steps(task: Task, solve: _Solve) -> int:
    """The first of 4096, 8192, ... with which the solve finishes.

    Found by one solve that keeps the end only, as each limit is another program to compile.
    """
    program, _ = _compiled(task, solve, dfx.SaveAt(t1=True), LAST_MAX_STEPS)
    outcome = program()
    _raise_if_failed(outcome)
    max_steps = FIRST_MAX_STEPS
    while max_steps < int(outcome.stats["num_steps"]):
        max_steps *= 2
    return max_steps


def _raise_if_failed(outcome: _Outcome) -> None:
    if outcome.result == dfx.RESULTS.max_steps_reached:
        raise SolveFailed(f"not finished after {LAST_MAX_STEPS} steps")
    if outcome.result == dfx.RESULTS.dt_min_reached:
        raise SolveFailed("the step size became too small")
    if outcome.result == dfx.RESULTS.nonlinear_divergence:
        raise SolveFailed("a nonlinear equation (implicit stage or constraint) was not solved")
    if outcome.result != dfx.RESULTS.successful:
        raise SolveFailed(dfx.RESULTS[outcome.result] or "failed")


def _steps(task: Task, solve: _Solve, max_steps: int) -> tuple[np.ndarray, np.ndarray, int | None]:
    """Ends of the accepted steps, states there, and the evaluations of the vector field.

    The latter for implicit solvers only, counted as they happen.
    """
    count = 0

    def increment():
        nonlocal count
        count += 1

    def counting_field(t, y, args):
        jax.debug.callback(increment)
        return task.problem.terms.vf(t, y, args)

    # A callback takes some 10 us, so that explicit solvers are better off with a formula.
    implicit = isinstance(SOLVERS[task.solver](), dfx.AbstractImplicitSolver)
    terms = dfx.ODETerm(counting_field) if implicit else None
    program, _ = _compiled(task, solve, dfx.SaveAt(steps=True), max_steps, terms)
    outcome = program()
    jax.effects_barrier()
    _raise_if_failed(outcome)
    used = np.isfinite(np.asarray(outcome.ts))
    return np.asarray(outcome.ts)[used], as_rows(outcome.ys)[used], count if implicit else None


def _explicit_evaluations(task: Task, solve: _Solve, steps: int) -> int | None:
    """Evaluations of the vector field by an explicit solver in so many steps, accepted or not.

    The last stage is the first one of the next step if the tableau says so.
    """
    solver = SOLVERS[task.solver]()
    if not isinstance(solver, dfx.AbstractERK):
        return None
    tableau = solver.tableau
    assert isinstance(tableau, dfx.ButcherTableau)  # several are for several vector fields
    reused = tableau.fsal and tableau.ssal
    in_steps = 1 + (tableau.num_stages - 1) * steps if reused else tableau.num_stages * steps
    return in_steps + solve.extra_evaluations
