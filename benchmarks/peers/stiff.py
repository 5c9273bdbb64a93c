"""Stiff systems and DAEs of index 1: Rosenbrock methods next to Diffrax's implicit ones, SciPy and,
where they are installed, pydiffsol, CasADi and scikit-sundae.

`python -m benchmarks.peers.stiff --json benchmarks/results/stiff.json`

The state at the end, with the digits of its worst component against the published solution. SciPy
solves what has a regular mass matrix; the solvers of CasADi and scikit-sundae that are meant for it
(IDAS, IDA) the others. Then a batch of Robertson's reactions, with rates spread over two decades.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    make_console,
    milliseconds,
    number,
    Timing,
    use_double_precision,
    write_json,
)
from ..tools.stiff_problems import (
    MECHANISM_START,
    PROBLEMS,
    stiff_mechanism,
    stiff_mechanism_reference,
    StiffProblem,
)
from ._stiff_peers import peers


METHODS = {
    "Rodas5P": mj.Rodas5P(),
    "Rodas3P": mj.Rodas3P(),
    "Kvaerno5 (Diffrax)": dfx.Kvaerno5(),
}
MAX_STEPS = 50_000


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    method: str
    steps: int | None
    digits: float | None  # None if the solve failed
    run: Timing


@dataclasses.dataclass(frozen=True)
class BatchRow:
    method: str
    trajectories: int
    ms_per_trajectory: Timing
    largest_difference: float  # from one solve at a time, relative


def terms_of(problem: StiffProblem) -> dfx.AbstractTerm:
    field = problem.field(jnp)
    return dfx.ODETerm(field) if problem.mass is None else mj.MassMatrixTerm(field, problem.mass)


def solve(problem: StiffProblem, solver: dfx.AbstractSolver, args: Any) -> Any:
    """Its last state, number of steps and whether it succeeded."""
    run = mj.diffeqsolve if isinstance(solver, dfx.AbstractImplicitSolver) else dfx.diffeqsolve
    dt0 = 1e-4 if problem.t1 > 1 else 1e-6
    sol = run(
        terms_of(problem),
        solver,
        0.0,
        problem.t1,
        dt0,
        jnp.asarray(problem.y0),
        args,
        stepsize_controller=dfx.PIDController(rtol=problem.rtol, atol=problem.atol),
        max_steps=MAX_STEPS,
        throw=False,
    )
    return sol.ys[0], sol.stats["num_steps"], sol.result == dfx.RESULTS.successful


def digits(problem: StiffProblem, end: np.ndarray) -> float:
    return float(-np.log10(np.max(np.abs(np.asarray(end) / problem.end - 1))))


def with_scipy(problem: StiffProblem, method: str) -> Callable[[], Any]:
    field = problem.field(np)

    def run():
        sol = solve_ivp(
            lambda t, y: field(t, y, problem.args),
            (0.0, problem.t1),
            problem.y0,
            method=method,
            rtol=problem.rtol,
            atol=problem.atol,
        )
        return sol.y[:, -1], len(sol.t) - 1, sol.success

    return run


def measure_problem(name: str, problem: StiffProblem, repeats: int, console: Console) -> list[Row]:
    runs: dict[str, Callable[[], Any]] = {}
    for method, solver in METHODS.items():
        if problem.mass is None or not isinstance(solver, dfx.AbstractImplicitSolver):
            program = lambda args, solver=solver: solve(problem, solver, args)
            runs[method], _ = compiled(program, problem.args)
    if problem.mass is None:
        for method in ("Radau", "BDF", "LSODA"):
            runs[f"SciPy {method}"] = with_scipy(problem, method)
    runs |= peers(problem, console)
    rows = []
    timings = interleaved(runs, repeats)
    for method, run in runs.items():
        end, steps, success = run()
        found = digits(problem, end) if success else None
        rows.append(
            Row(name, method, None if steps is None else int(steps), found, timings[method])
        )
    return rows


def measure_mechanism(repeats: int) -> list[Row]:
    """On its manifold; the digits are absolute ones of the positions."""
    system, t1 = stiff_mechanism(), 0.5
    reference = stiff_mechanism_reference(t1)
    start = jnp.asarray(MECHANISM_START), jnp.zeros((2, 2))
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8)
    runs = {}
    for method, solver in {**METHODS, "Tsit5 (Diffrax)": dfx.Tsit5()}.items():
        hook = mj.Projected(solver, system.constraint)
        options = dict(stepsize_controller=controller, max_steps=MAX_STEPS * 20, throw=False)
        run = lambda y0, hook=hook, options=options: mj.diffeqsolve(
            system.terms, hook, 0.0, t1, 1e-6, y0, **options
        )
        last = lambda y0, run=run: (
            lambda sol: (sol.ys[0][0], sol.stats["num_steps"], sol.result == dfx.RESULTS.successful)
        )(run(y0))
        runs[f"projected {method}"], _ = compiled(last, start)
    timings = interleaved(runs, repeats)
    rows = []
    for method, run in runs.items():
        q, steps, success = run()
        found = float(-np.log10(np.max(np.abs(q - reference)))) if success else None
        rows.append(Row("stiff mechanism", method, int(steps), found, timings[method]))
    return rows


def measure_batch(size: int, repeats: int) -> list[BatchRow]:
    problem = PROBLEMS["Robertson"]
    spread = np.random.default_rng(0).uniform(-1, 1, (size, 3))
    args = jnp.asarray(problem.args * 10**spread)
    rows = []
    for method in ("Rodas5P", "Kvaerno5 (Diffrax)"):
        one = lambda args, method=method: solve(problem, METHODS[method], args)[0]
        single = jax.jit(one)
        loop = lambda single=single: [jax.block_until_ready(single(a)) for a in args]
        runs = {"vmap": compiled(jax.vmap(one), args)[0], "loop": loop}
        if method == "Rodas5P":
            runs["mj.solve_ensemble"], _ = compiled(in_lanes, args)
        timings = interleaved(runs, repeats)
        alone = np.stack(loop())
        for kind, run in runs.items():
            difference = float(np.max(np.abs(np.asarray(run()) / alone - 1)))
            each = Timing(*(value / size for value in dataclasses.astuple(timings[kind])))
            rows.append(BatchRow(f"{method}, {kind}", size, each, difference))
    return rows


def in_lanes(args: Any) -> Any:
    problem = PROBLEMS["Robertson"]
    starts = jnp.tile(jnp.asarray(problem.y0), (args.shape[0], 1))
    controller = dfx.PIDController(rtol=problem.rtol, atol=problem.atol)
    options = dict(stepsize_controller=controller, max_steps=MAX_STEPS)
    terms, solver = terms_of(problem), METHODS["Rodas5P"]
    return mj.solve_ensemble(
        terms, solver, 0.0, problem.t1, 1e-4, starts, args, **options, args_axes=0
    ).ys[:, 0]


def print_tables(console: Console, rows: list[Row], batch: list[BatchRow]) -> None:
    table = Table("problem", "method", "steps", "digits", "ms")
    for row in rows:
        steps, found = number(row.steps, "d"), number(row.digits, ".1f")
        table.add_row(row.problem, row.method, steps, found, milliseconds(row.run.median_ms))
    console.print(table)
    table = Table("batch", "trajectories", "ms per trajectory", "difference")
    for row in batch:
        each = milliseconds(row.ms_per_trajectory.median_ms)
        table.add_row(row.method, str(row.trajectories), each, f"{row.largest_difference:.1e}")
    console.print(table)


def main(
    repeats: Annotated[int, typer.Option(help="timed runs of each program")] = 7,
    trajectories: Annotated[int, typer.Option(help="size of the batch")] = 1000,
    json: Annotated[Path | None, typer.Option(help="where to write the result")] = None,
) -> None:
    use_double_precision()
    console = make_console()
    rows = []
    for name, problem in PROBLEMS.items():
        rows += measure_problem(name, problem, repeats, console)
    rows += measure_mechanism(repeats)
    batch = measure_batch(trajectories, min(repeats, 3))
    print_tables(console, rows, batch)
    if json is not None:
        content = {
            "environment": environment("pydiffsol", "casadi", "scikit-sundae"),
            "problems": [dataclasses.asdict(row) for row in rows],
            "batch": [dataclasses.asdict(row) for row in batch],
        }
        write_json(json, content)


if __name__ == "__main__":
    typer.run(main)
