"""What users wait for first: tracing and compiling a projected solve, next to a plain one.

`python -m benchmarks.speed.compile_time --json benchmarks/results/compile_time.json`

Tsit5, rtol = atol = 1e-8, 41 saved states; and the gradient of the sum of their squares with respect
to the parameters. Four mechanisms, of 2 to 9 coordinates. Seconds of the process on one core, as
those by the clock depend on what else the machine does.
"""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.andrews import andrews, AndrewsArgs, initial_state
from ..tools.measure import (
    environment,
    interleaved,
    make_console,
    milliseconds,
    Timing,
    use_double_precision,
    use_one_core,
    write_json,
)


TOLERANCE = 1e-8
POINTS = 41
MAX_STEPS = 4096

# At most so many times as long as plain Diffrax.
SOLVE_GOAL = 1.5
GRADIENT_GOAL = 2.0


class Case(NamedTuple):
    """A mechanism, how long it is solved, and from where."""

    terms: dfx.AbstractTerm
    constraint: Any
    t1: float
    y0: Any
    args: Any


@dataclasses.dataclass(frozen=True)
class Seconds:
    """Of the process: Python to jaxpr, and jaxpr to program."""

    trace: float
    compile: float

    @property
    def total(self) -> float:
        return self.trace + self.compile


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    program: str
    seconds: Seconds
    run: Timing


@dataclasses.dataclass(frozen=True)
class Ratio:
    """Of the projected program to the plain one: seconds to compile, and time of a run."""

    problem: str
    program: str
    compile: float
    run: float
    goal: float

    @property
    def met(self) -> bool:
        return self.compile <= self.goal


def cases() -> dict[str, Case]:
    problems = mj.problems.pendulum(), mj.problems.slider_crank(), mj.problems.four_bar()
    found = {
        p.name: Case(p.terms, p.constraint, p.t1, p.y0, jtu.tree_map(jnp.asarray, p.args))
        for p in problems
    }
    system, args = andrews(), jtu.tree_map(jnp.asarray, AndrewsArgs())
    found["andrews"] = Case(system.terms, system.constraint, 0.03, initial_state(), args)
    return found


def solve(case: Case, projected: bool, args: Any) -> Any:
    """The saved states. Diffrax needs to be told the first step, ours is chosen."""
    solver = dfx.Tsit5()
    return (mj.diffeqsolve if projected else dfx.diffeqsolve)(
        case.terms,
        mj.Projected(solver, case.constraint) if projected else solver,
        0.0,
        case.t1,
        None if projected else 1e-3 * case.t1,
        case.y0,
        args,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, case.t1, POINTS)),
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=MAX_STEPS,
    ).ys


def sum_of_squares(case: Case, projected: bool, args: Any) -> Any:
    return sum(jnp.sum(leaf**2) for leaf in jtu.tree_leaves(solve(case, projected, args)))


def programs(case: Case) -> dict[str, Callable]:
    return {
        f"{name}{kind}": wrap(functools.partial(function, case, projected))
        for kind, function, wrap in (
            ("", solve, lambda f: f),
            (" gradient", sum_of_squares, jax.grad),
        )
        for name, projected in (("plain", False), ("projected", True))
    }


def compiled(function: Callable, args: Any) -> tuple[Any, Seconds]:
    """The program, from empty caches."""
    jax.clear_caches()
    start = time.process_time()
    traced = jax.jit(function).trace(args)
    middle = time.process_time()
    program = traced.lower().compile()
    return program, Seconds(middle - start, time.process_time() - middle)


def median_seconds(several: list[Seconds]) -> Seconds:
    median = lambda name: statistics.median(getattr(s, name) for s in several)
    return Seconds(median("trace"), median("compile"))


def measure(name: str, case: Case, compilations: int, repeats: int) -> list[Row]:
    functions = programs(case)
    seconds: dict[str, list[Seconds]] = {program: [] for program in functions}
    runs = {}
    for _ in range(compilations):
        for program, function in functions.items():
            run, elapsed = compiled(function, case.args)
            seconds[program].append(elapsed)
            runs[program] = lambda run=run: jax.block_until_ready(run(case.args))
    timings = interleaved(runs, repeats)
    return [
        Row(name, program, median_seconds(seconds[program]), timings[program])
        for program in functions
    ]


def ratios(rows: list[Row]) -> list[Ratio]:
    by_name = {(row.problem, row.program): row for row in rows}
    found = []
    for kind, goal in (("", SOLVE_GOAL), (" gradient", GRADIENT_GOAL)):
        for problem in dict.fromkeys(row.problem for row in rows):
            plain, ours = (by_name[problem, f"{name}{kind}"] for name in ("plain", "projected"))
            seconds = ours.seconds.total / plain.seconds.total
            run = ours.run.median_ms / plain.run.median_ms
            found.append(Ratio(problem, f"projected{kind}", seconds, run, goal))
    return found


def row_table(rows: list[Row]) -> Table:
    table = Table(title="Seconds of the process, and of a run", title_justify="left")
    table.add_column("problem", no_wrap=True)
    table.add_column("program", no_wrap=True)
    for heading in ("trace", "lower, compile", "both", "run, ms (quartiles)"):
        table.add_column(heading, justify="right", no_wrap=True)
    problem = None
    for row in rows:
        if row.problem != problem:
            table.add_section()
        s, run = row.seconds, row.run
        table.add_row(
            row.problem if row.problem != problem else "",
            row.program,
            *(f"{x:.2f}" for x in (s.trace, s.compile, s.total)),
            f"{milliseconds(run.median_ms)} ({milliseconds(run.low_ms)}-{milliseconds(run.high_ms)})",
        )
        problem = row.problem
    return table


def ratio_table(found: list[Ratio]) -> Table:
    table = Table(title="Projected / plain", title_justify="left")
    table.add_column("problem", no_wrap=True)
    table.add_column("program", no_wrap=True)
    for heading in ("run", "compile", "goal", "goal met"):
        table.add_column(heading, justify="right", no_wrap=True)
    for r in found:
        met = "[green]yes[/green]" if r.met else "[red]no[/red]"
        table.add_row(
            r.problem, r.program, f"{r.run:.2f}", f"{r.compile:.2f}", f"<= {r.goal:g}", met
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    compilations: Annotated[int, typer.Option(min=1, help="Compilations of each program.")] = 1,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 21,
    only: Annotated[str | None, typer.Option(help="One problem: its name.")] = None,
) -> None:
    """Measure how long a projected solve takes to compile, and compare with the goals."""
    use_one_core()
    use_double_precision()
    console = make_console()
    chosen = {name: case for name, case in cases().items() if only in (None, name)}
    with console.status("measuring"):
        first = next(iter(chosen.values()))
        for function in programs(first).values():  # JAX itself imports on the way
            compiled(function, first.args)
        rows = [r for n, c in chosen.items() for r in measure(n, c, compilations, repeats)]
    found = ratios(rows)
    console.print(row_table(rows), ratio_table(found), sep="\n")
    if json is not None:
        settings = {"rtol": TOLERANCE, "points": POINTS, "max_steps": MAX_STEPS}
        settings |= {"compilations": compilations, "repeats": repeats}
        content = {"environment": environment(), "settings": settings}
        content["rows"] = [dataclasses.asdict(row) for row in rows]
        content["ratios"] = [{**dataclasses.asdict(r), "met": r.met} for r in found]
        write_json(json, content)


if __name__ == "__main__":
    typer.run(main)
