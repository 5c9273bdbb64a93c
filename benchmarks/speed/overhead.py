"""What projection costs: times of projected solves next to the same solves left plain.

`python -m benchmarks.speed.overhead --json benchmarks/results/overhead.json`

The planar pendulum in Cartesian coordinates, Tsit5, rtol = atol = 1e-6, ten seconds; and a batch of
double pendulums (`_mechanics_overhead`).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import (
    compiled,
    CompileTime,
    environment,
    interleaved,
    largest_difference,
    make_console,
    median_compile_times,
    milliseconds,
    number,
    pendulum_violations,
    Timing,
    use_double_precision,
    write_json,
)
from ._mechanics_overhead import BATCH, time_accelerations, time_solves


TOLERANCE = 1e-6
POINTS = 1001
ANGLES = (0.3, 1.5)  # of the batch: starts at rest, measured from the downward vertical

# The most that a projected solve should take, as a multiple of the plain one.
RUN_GOAL = 1.3
COMPILE_STEPS_GOAL = 2.0
COMPILE_SAVED_GOAL = 2.5
MECHANICS_GOAL = 1.2
LOCAL_GOAL = 4.0
ACCELERATIONS_GOAL = 0.25


class Variant(NamedTuple):
    """How to solve: through which function, and whether the solver is projected."""

    diffeqsolve: Callable[..., dfx.Solution]
    projected: bool


PLAIN = Variant(dfx.diffeqsolve, False)
STEPS = Variant(dfx.diffeqsolve, True)  # projects the steps, but not what is between them
FULL = Variant(mj.diffeqsolve, True)

END = dfx.SaveAt(t1=True)


class Outcome(NamedTuple):
    ys: Any
    accepted: Any
    rejected: Any


@dataclasses.dataclass(frozen=True)
class Row:
    """A variant of a group of solves: its time, its steps (means of a batch), its accuracy."""

    group: str
    variant: str
    median_ms: float
    low_ms: float
    high_ms: float
    accepted: float
    rejected: float
    violation: float
    error: float
    us_per_step: float
    gradient_error: float | None = None


@dataclasses.dataclass(frozen=True)
class Ratio:
    """A quotient of two medians; without a goal it is for information."""

    name: str
    ratio: float
    goal: float | None = None

    @property
    def met(self) -> bool | None:
        return None if self.goal is None else self.ratio <= self.goal


Programs = Mapping[str, tuple[Callable, tuple[Any, ...]]]


def solve(
    variant: Variant,
    problem: Problem,
    saveat: dfx.SaveAt,
    y0: Any,
    args: Any,
    adjoint: dfx.AbstractAdjoint | None = None,
) -> Outcome:
    solver = dfx.Tsit5()
    sol = variant.diffeqsolve(
        problem.terms,
        mj.Projected(solver, problem.constraint) if variant.projected else solver,
        problem.t0,
        problem.t1,
        None,
        y0,
        args,
        saveat=saveat,
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        **({} if adjoint is None else {"adjoint": adjoint}),
    )
    return Outcome(sol.ys, sol.stats["num_accepted_steps"], sol.stats["num_rejected_steps"])


def saved_points(problem: Problem, *, projected_one_by_one: bool = False) -> dfx.SaveAt:
    """All points of the grid; alternatively each is projected at the time it is saved."""
    ts = jnp.linspace(problem.t0, problem.t1, POINTS)
    if not projected_one_by_one:
        return dfx.SaveAt(ts=ts)
    project = mj.NewtonProjection()
    return dfx.SaveAt(
        ts=ts, fn=lambda t, y, args: problem.constraint.correct(project, t, y, args)[0]
    )


def measure(
    group: str,
    programs: Programs,
    reference: np.ndarray,
    repeats: int,
    *,
    exact_gradient: float | None = None,
) -> list[Row]:
    """Compile the programs of a group, check what they return, time them in turn.

    `reference` has the shape of the states, `(..., 4)`. With `exact_gradient` the programs
    return the gradient (or `None`) and an outcome, else an outcome.
    """
    runs = {name: compiled(function, *args)[0] for name, (function, args) in programs.items()}
    results = {name: run() for name, run in runs.items()}
    timings = interleaved(runs, repeats)
    rows = []
    for name, result in results.items():
        gradient, outcome = (None, result) if exact_gradient is None else result
        error = None if gradient is None else abs(float(gradient) - exact_gradient)
        row = _row(group, name, timings[name], outcome, reference)
        rows.append(dataclasses.replace(row, gradient_error=error))
    return rows


def _row(group: str, variant: str, timing: Timing, outcome: Outcome, reference: np.ndarray) -> Row:
    states = np.concatenate([np.asarray(leaf) for leaf in outcome.ys], axis=-1)
    accepted, rejected = np.asarray(outcome.accepted), np.asarray(outcome.rejected)
    return Row(
        group,
        variant,
        **dataclasses.asdict(timing),
        accepted=float(np.mean(accepted)),
        rejected=float(np.mean(rejected)),
        violation=max(pendulum_violations(states)),
        error=largest_difference(states, reference),
        us_per_step=1e3 * timing.median_ms / float(np.sum(accepted + rejected)),
    )


def reference_states(problem: Problem, times: Any) -> np.ndarray:
    return np.concatenate(problem.reference(times), axis=-1)


def single_trajectory(problem: Problem, repeats: int) -> list[Row]:
    inputs = (problem.y0, problem.args)
    programs = {
        name: (functools.partial(solve, variant, problem, END), inputs)
        for name, variant in (("plain", PLAIN), ("projected", FULL))
    }
    return measure("end", programs, reference_states(problem, [problem.t1]), repeats)


def batch_of_trajectories(problem: Problem, size: int, repeats: int) -> list[Row]:
    angles = np.linspace(*ANGLES, size)
    q0 = np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    y0s = (jnp.asarray(q0), jnp.zeros((size, 2)))
    reference = np.stack(
        [reference_states(problem.with_initial((q, np.zeros(2))), [problem.t1]) for q in q0]
    )

    def batched(variant: Variant) -> Callable:
        return jax.vmap(functools.partial(solve, variant, problem, END), in_axes=(0, None))

    programs = {
        name: (batched(variant), (y0s, problem.args))
        for name, variant in (("plain", PLAIN), ("projected", FULL))
    }
    return measure(f"batch of {size}", programs, reference, repeats)


def many_saved_points(problem: Problem, repeats: int) -> list[Row]:
    points = saved_points(problem)
    one_by_one = saved_points(problem, projected_one_by_one=True)
    inputs = (problem.y0, problem.args)
    programs = {
        "plain": (functools.partial(solve, PLAIN, problem, points), inputs),
        "projected steps, raw output": (functools.partial(solve, STEPS, problem, points), inputs),
        "projected": (functools.partial(solve, FULL, problem, points), inputs),
        "projected one by one": (functools.partial(solve, STEPS, problem, one_by_one), inputs),
    }
    reference = reference_states(problem, np.linspace(problem.t0, problem.t1, POINTS))
    return measure(f"{POINTS} points", programs, reference, repeats)


def gradients(problem: Problem, repeats: int) -> list[Row]:
    """`d x(t1) / d gravity`, forwards and backwards, with the default adjoint of each front end."""

    def position(variant: Variant, adjoint: dfx.AbstractAdjoint | None, gravity: Any) -> Any:
        args = problem.args._replace(gravity=gravity)
        outcome = solve(variant, problem, END, problem.y0, args, adjoint)
        return outcome.ys[0][-1, 0], outcome

    def value(variant: Variant, gravity: Any) -> Any:
        return None, position(variant, None, gravity)[1]

    def forward(variant: Variant, gravity: Any) -> Any:
        f = functools.partial(position, variant, dfx.ForwardMode())
        return jax.jvp(f, (gravity,), (jnp.ones_like(gravity),), has_aux=True)[1:]

    def reverse(variant: Variant, gravity: Any) -> Any:
        f = functools.partial(position, variant, None)
        (_, outcome), gradient = jax.value_and_grad(f, has_aux=True)(gravity)
        return gradient, outcome

    programs = {
        f"{name}, {kind}": (functools.partial(function, variant), (problem.args.gravity,))
        for kind, function in (("value", value), ("forward", forward), ("reverse", reverse))
        for name, variant in (("plain", PLAIN), ("projected", FULL))
    }
    reference = reference_states(problem, [problem.t1])
    # From rest, q(t) depends on sqrt(gravity) t alone.
    exact = reference[0, 2] * problem.t1 / (2 * float(problem.args.gravity))
    return measure("gradient", programs, reference, repeats, exact_gradient=float(exact))


def compile_times(problem: Problem, repeats: int) -> dict[str, CompileTime]:
    points, inputs = saved_points(problem), (problem.y0, problem.args)
    cases = {
        "plain, end": (PLAIN, END),
        "projected steps, end": (STEPS, END),
        "projected, end": (FULL, END),
        f"plain, {POINTS} points": (PLAIN, points),
        f"projected, {POINTS} points": (FULL, points),
    }
    programs = {
        name: (functools.partial(solve, variant, problem, saveat), inputs)
        for name, (variant, saveat) in cases.items()
    }
    return median_compile_times(programs, repeats)


def run_ratios(
    single: list[Row], batch: list[Row], points: list[Row], gradient: list[Row]
) -> list[Ratio]:
    ratios = []
    for rows in (single, batch):
        plain, projected = rows
        name = f"{plain.group}: projected / plain"
        ratios += [
            Ratio(name, projected.median_ms / plain.median_ms, RUN_GOAL),
            Ratio(f"{name}, per step", projected.us_per_step / plain.us_per_step),
        ]
    plain, raw, projected, one_by_one = (row.median_ms for row in points)
    ratios += [
        Ratio(f"{POINTS} points: projected / raw output", projected / raw, RUN_GOAL),
        Ratio(f"{POINTS} points: one by one / raw output", one_by_one / raw),
        Ratio(f"{POINTS} points: projected / plain", projected / plain),
    ]
    ms = {row.variant: row.median_ms for row in gradient}
    for kind in ("forward", "reverse"):
        for name in ("plain", "projected"):
            quotient = ms[f"{name}, {kind}"] / ms[f"{name}, value"]
            ratios.append(Ratio(f"gradient: {kind} / value, {name}", quotient))
        quotient = ms[f"projected, {kind}"] / ms[f"plain, {kind}"]
        ratios.append(Ratio(f"gradient, {kind}: projected / plain", quotient))
    return ratios


def mechanics_ratios(accelerations: dict[str, Timing], solves: dict[str, Timing]) -> list[Ratio]:
    ours, dense = (timing.median_ms for timing in accelerations.values())
    ms = {name: timing.median_ms for name, timing in solves.items()}
    name = f"batch of {BATCH} double pendulums"
    return [
        Ratio("accelerations: ours / dense solve", ours / dense, ACCELERATIONS_GOAL),
        Ratio(f"{name}: projected / plain", ms["projected"] / ms["plain"], MECHANICS_GOAL),
        Ratio(
            f"{name}: local coordinates / projected",
            ms["local coordinates"] / ms["projected"],
            LOCAL_GOAL,
        ),
    ]


def compile_ratios(times: dict[str, CompileTime]) -> list[Ratio]:
    """Goals are for the time by the clock."""
    cases = (
        ("projected steps, end", "plain, end", COMPILE_STEPS_GOAL),
        ("projected, end", "plain, end", None),
        (f"projected, {POINTS} points", f"plain, {POINTS} points", COMPILE_SAVED_GOAL),
    )
    ratios = []
    for name, base, goal in cases:
        wall = times[name].wall_s / times[base].wall_s
        process = times[name].process_s / times[base].process_s
        ratios += [
            Ratio(f"compile: {name} / plain", wall, goal),
            Ratio(f"compile: {name} / plain, process time", process),
        ]
    return ratios


def run_table(rows: list[Row]) -> Table:
    table = Table(title="Run time: median (quartiles), steps, accuracy", title_justify="left")
    table.add_column("solve", no_wrap=True)
    table.add_column("variant", no_wrap=True)
    for heading in ("ms", "us/step", "accepted", "rejected", "max |g|", "error", "of gradient"):
        table.add_column(heading, justify="right", no_wrap=True)
    group = None
    for row in rows:
        if row.group != group:
            table.add_section()
        quartiles = f"({milliseconds(row.low_ms)}-{milliseconds(row.high_ms)})"
        table.add_row(
            row.group if row.group != group else "",
            row.variant,
            f"{milliseconds(row.median_ms)} {quartiles}",
            number(row.us_per_step, ".3f"),
            number(row.accepted, ".4g"),
            number(row.rejected, ".4g"),
            number(row.violation, ".1e"),
            number(row.error, ".1e"),
            number(row.gradient_error, ".1e"),
        )
        group = row.group
    return table


def compile_table(times: dict[str, CompileTime]) -> Table:
    table = Table(title="Tracing and compiling: median seconds", title_justify="left")
    table.add_column("program")
    table.add_column("wall", justify="right")
    table.add_column("process", justify="right")
    for name, seconds in times.items():
        table.add_row(name, f"{seconds.wall_s:.2f}", f"{seconds.process_s:.2f}")
    return table


def ratio_table(ratios: list[Ratio]) -> Table:
    table = Table(title="Ratios", title_justify="left")
    table.add_column("ratio of", no_wrap=True)
    for heading in ("is", "goal", "met"):
        table.add_column(heading, justify="right")
    marks = {True: "[green]yes[/green]", False: "[red]no[/red]", None: ""}
    for ratio in ratios:
        goal = "" if ratio.goal is None else f"<= {ratio.goal:g}"
        table.add_row(ratio.name, f"{ratio.ratio:.2f}", goal, marks[ratio.met])
    return table


def settings(problem: Problem, batch: int, repeats: int, compile_repeats: int) -> dict[str, Any]:
    return {
        "problem": problem.name,
        "solver": "Tsit5",
        "rtol": TOLERANCE,
        "atol": TOLERANCE,
        "t0": problem.t0,
        "t1": problem.t1,
        "dtype": "float64",
        "points": POINTS,
        "batch": batch,
        "batch_angles": ANGLES,
        "repeats": repeats,
        "compile_repeats": compile_repeats,
    }


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    batch: Annotated[int, typer.Option(min=1, help="Trajectories in the batch.")] = 1000,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 101,
    compile_repeats: Annotated[int, typer.Option(min=1, help="Timed compilations of each.")] = 5,
) -> None:
    """Measure what projection costs in time, and compare with the goals."""
    use_double_precision()
    problem = mj.problems.pendulum()
    console = make_console()
    with console.status("measuring"):
        single = single_trajectory(problem, repeats)
        many = batch_of_trajectories(problem, batch, repeats)
        points = many_saved_points(problem, repeats)
        gradient = gradients(problem, repeats)
        jax.clear_caches()  # memory held by the programs so far slows large batches
        double = mj.problems.double_pendulum()
        accelerations = time_accelerations(double, repeats)
        solves = time_solves(double, max(1, repeats // 5))
        seconds = compile_times(problem, compile_repeats)
    rows = [*single, *many, *points, *gradient]
    ratios = [
        *run_ratios(single, many, points, gradient),
        *mechanics_ratios(accelerations, solves),
        *compile_ratios(seconds),
    ]
    for table in (run_table(rows), compile_table(seconds), ratio_table(ratios)):
        console.print(table)
    if json is not None:
        content = {
            "environment": environment(),
            "settings": settings(problem, batch, repeats, compile_repeats),
            "runs": [dataclasses.asdict(row) for row in rows],
            "mechanics": {
                name: dataclasses.asdict(timing)
                for name, timing in {**accelerations, **solves}.items()
            },
            "compilations": {name: dataclasses.asdict(s) for name, s in seconds.items()},
            "ratios": [{**dataclasses.asdict(ratio), "met": ratio.met} for ratio in ratios],
        }
        write_json(json, content)


if __name__ == "__main__":
    typer.run(main)
