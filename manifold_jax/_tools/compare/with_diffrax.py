"""Diffrax's solvers, plain and in the approaches of this library."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from ..._solve import diffeqsolve
from ..._solver import Stabilized
from .approaches import Approach, Formulation, with_vector_field
from .task import as_rows, compiled, median_ms, Run, SolveFailed, Task


# Those with an error estimate that take one vector field (KenCarp and Sil3 take two).
SOLVERS: dict[str, type[dfx.AbstractSolver]] = {
    solver.__name__.lower(): solver
    for solver in (
        dfx.Heun, dfx.Midpoint, dfx.Ralston, dfx.Bosh3, dfx.Tsit5, dfx.Dopri5, dfx.Dopri8,
        dfx.ImplicitEuler, dfx.Kvaerno3, dfx.Kvaerno4, dfx.Kvaerno5,
    )
}  # fmt: skip

# Diffrax has to know the number of steps beforehand: the limit starts at Diffrax's own default and is
# doubled until the solve finishes, up to about a minute of steps.
FIRST_MAX_STEPS = 4096
LAST_MAX_STEPS = 2**20


def run_diffrax(task: Task, approach: Approach) -> Run:
    """Run the solver that the task names, within one of the approaches."""
    solve = approach.formulate(task.problem, SOLVERS[task.solver](), task.gain)
    # The ends of the steps, too: another program for them would take as long to compile.
    saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(ts=jnp.asarray(task.grid)), dfx.SubSaveAt(steps=True)])
    max_steps = FIRST_MAX_STEPS
    program, seconds = _compiled(task, solve, saveat, max_steps)
    outcome = program()
    if outcome.result == dfx.RESULTS.max_steps_reached:
        max_steps = _sufficient_max_steps(task, solve)
        program, seconds = _compiled(task, solve, saveat, max_steps)
        outcome = program()
    _raise_if_failed(outcome)
    costs = {name: int(outcome.stats[f"num_{name}_steps"]) for name in ("accepted", "rejected")}
    evaluations = _explicit_evaluations(task, solve, sum(costs.values()))
    if evaluations is None:
        evaluations = _counted_evaluations(task, solve, max_steps)
    costs |= {"evaluations": evaluations, "run_ms": median_ms(program), "compile_s": seconds}
    output, steps = outcome.ys
    step_times = np.asarray(outcome.ts[1])
    used = np.isfinite(step_times)
    return Run(
        output=as_rows(output),
        step_times=step_times[used],
        steps=as_rows(steps)[used],
        costs=costs,
        max_steps=max_steps,
    )


def solve_task(
    task: Task, formulation: Formulation, y0: Any, args: Any, saveat: dfx.SaveAt, max_steps: int
) -> dfx.Solution:
    """Solve over the time span of the task and with its tolerances."""
    controller = dfx.PIDController(rtol=task.rtol, atol=task.atol)
    options = dict(saveat=saveat, stepsize_controller=controller, max_steps=max_steps)
    return formulation.solve(task.t0, task.t1, y0, args, **options)


def _compiled(
    task: Task, solve: Formulation, saveat: dfx.SaveAt, max_steps: int
) -> tuple[Callable[[], Any], float]:
    """Return the program, ready to run to its end, and the seconds it took to trace and compile."""
    problem = task.problem
    run = lambda y0, args: solve_task(task, solve, y0, args, saveat, max_steps)
    # Otherwise the second method would profit from what was traced for the first.
    jax.clear_caches()
    program, seconds = compiled(jax.jit(run), problem.y0, problem.args)
    return lambda: jax.block_until_ready(program(problem.y0, problem.args)), seconds


def _sufficient_max_steps(task: Task, solve: Formulation) -> int:
    """Return the first of 4096, 8192, ... with which the solve finishes.

    Found by one solve that keeps the end only, as each limit is another program to compile.
    """
    program, _ = _compiled(task, solve, dfx.SaveAt(t1=True), LAST_MAX_STEPS)
    outcome = program()
    _raise_if_failed(outcome)
    max_steps = FIRST_MAX_STEPS
    while max_steps < int(outcome.stats["num_steps"]):
        max_steps *= 2
    return max_steps


def _raise_if_failed(outcome: dfx.Solution) -> None:
    if outcome.result == dfx.RESULTS.max_steps_reached:
        raise SolveFailed(f"not finished after {LAST_MAX_STEPS} steps")
    if outcome.result == dfx.RESULTS.dt_min_reached:
        raise SolveFailed("the step size became too small")
    if outcome.result == dfx.RESULTS.nonlinear_divergence:
        raise SolveFailed("a nonlinear equation (implicit stage or constraint) was not solved")
    if outcome.result != dfx.RESULTS.successful:
        raise SolveFailed(dfx.RESULTS[outcome.result] or "failed")


def _counted_evaluations(task: Task, solve: Formulation, max_steps: int) -> int:
    """Count evaluations of the vector field as they happen."""
    count = 0

    def increment():
        nonlocal count
        count += 1

    def counting(field):
        def counted(t, y, args):
            jax.debug.callback(increment)
            return field(t, y, args)

        return counted

    solve = solve._replace(terms=with_vector_field(solve.terms, counting))
    program, _ = _compiled(task, solve, dfx.SaveAt(t1=True), max_steps)
    outcome = program()
    jax.effects_barrier()
    _raise_if_failed(outcome)
    return count


def _explicit_evaluations(task: Task, solve: Formulation, steps: int) -> int | None:
    """Return the number of evaluations of the vector field by an explicit solver in so many steps,
    accepted or not.

    One for each stage, in every approach; the last stage is the first one of the next step if the
    tableau says so. (A callback that counts takes some 10 us.)
    """
    solver = SOLVERS[task.solver]()
    if not isinstance(solver, dfx.AbstractERK) or solve.resets:
        return None
    tableau = solver.tableau
    assert isinstance(tableau, dfx.ButcherTableau)  # several are for several vector fields
    reused = tableau.fsal and tableau.ssal
    in_steps = 1 + (tableau.num_stages - 1) * steps if reused else tableau.num_stages * steps
    if solve.function is not diffeqsolve:
        return in_steps
    # Two evaluations choose the first step (Diffrax starts with 0.01 whatever the problem), of which
    # the first is the one at the start, unless the step needs the stabilized field there.
    shared = reused and not isinstance(solve.solver, Stabilized)
    return in_steps + (1 if shared else 2)
