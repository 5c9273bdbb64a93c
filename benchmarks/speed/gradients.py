"""What a gradient costs: reverse mode of this library, next to Diffrax's own and to casadi.

`python -m benchmarks.speed.gradients --json benchmarks/results/gradients.json`

The planar pendulum in Cartesian coordinates, projected Tsit5, rtol = atol = 1e-8, ten seconds:
`d x(10) / d gravity`, which is known exactly. Plain Tsit5 of Diffrax without projection is next to it,
and a slider-crank of which 41 states are saved. How far all ways to a gradient agree is shown by
`manifold-jax certify`.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

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
from .overhead import Ratio, ratio_table


TOLERANCE = 1e-8
BATCH = 256
PROBLEM = mj.problems.pendulum
EVERY_STATE = 4096
ADJOINTS: dict[str, dfx.AbstractAdjoint] = {
    "Diffrax default": dfx.RecursiveCheckpointAdjoint(),
    "Diffrax, checkpoints=max_steps": dfx.RecursiveCheckpointAdjoint(checkpoints=EVERY_STATE),
    "replay": mj.StepReplayAdjoint(),
    "replay, 64 checkpoints": mj.StepReplayAdjoint(checkpoints=64),
}
# The most that a gradient should take, as a multiple of its solve, and of Diffrax's default.
SINGLE_GOAL, BATCH_GOAL = 10.0, 7.0
DEFAULT_GOAL = 1.0


@dataclasses.dataclass(frozen=True)
class Row:
    """A way to the gradient: its time, its error, and the memory of the program."""

    group: str
    variant: str
    timing: Timing
    steps: int | None
    error: float | None
    memory_kb: float | None
    compile_s: float | None = None


def position(
    gravity: Any, adjoint: dfx.AbstractAdjoint, max_steps: int = 4096, projected: bool = True
) -> Any:
    """`x(10)`, and the number of steps."""
    problem, solver, diffeqsolve = PROBLEM(), dfx.Tsit5(), dfx.diffeqsolve
    if projected:
        solver, diffeqsolve = mj.Projected(solver, problem.constraint), mj.diffeqsolve
    sol = diffeqsolve(
        problem.terms,
        solver,
        problem.t0,
        problem.t1,
        None,
        problem.y0,
        problem.args._replace(gravity=gravity),
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        adjoint=adjoint,
        max_steps=max_steps,
    )
    return sol.ys[0][-1, 0], sol.stats["num_steps"]


def exact_gradient(gravity: Any) -> np.ndarray:
    """From rest, `q(t)` depends on `sqrt(gravity) t` alone: `v_x t / (2 gravity)`."""
    problem = PROBLEM()
    values = []
    for g in np.atleast_1d(gravity):
        at = problem.with_args(problem.args._replace(gravity=jnp.asarray(g)))
        values.append(at.reference(problem.t1)[1][0] * problem.t1 / (2 * g))
    return np.asarray(values)


def measure(group: str, gravity: Any, vectorize: Callable, repeats: int) -> list[Row]:
    solve = vectorize(functools.partial(position, adjoint=dfx.RecursiveCheckpointAdjoint()))
    functions: dict[str, Callable] = {"solve": solve}
    functions["forward mode"] = vectorize(
        jax.jacfwd(functools.partial(position, adjoint=dfx.ForwardMode()), has_aux=True)
    )
    for name, adjoint in ADJOINTS.items():
        gradient = jax.grad(functools.partial(position, adjoint=adjoint), has_aux=True)
        functions[name] = vectorize(gradient)
    plain = functools.partial(position, projected=False)
    default = ADJOINTS["Diffrax default"]
    functions["plain, solve"] = vectorize(functools.partial(plain, adjoint=default))
    for name in ("Diffrax default", "replay"):
        gradient = jax.grad(functools.partial(plain, adjoint=ADJOINTS[name]), has_aux=True)
        functions[f"plain, {name}"] = vectorize(gradient)
    exact = exact_gradient(gravity)
    runs = {name: compiled(function, gravity)[0] for name, function in functions.items()}
    timings = interleaved(runs, repeats)
    rows = []
    for name, run in runs.items():
        value, steps = run()
        error = None if name.endswith("solve") else float(np.max(np.abs(np.asarray(value) - exact)))
        memory = memory_kb(functions[name], gravity)
        rows.append(Row(group, name, timings[name], int(np.max(steps)), error, memory))
    return rows


def memory_kb(function: Callable, *args: Any) -> float | None:
    analysis = jax.jit(function).lower(*args).compile().memory_analysis()
    return None if analysis is None else analysis.temp_size_in_bytes / 1e3


def memory_growth(gravity: Any) -> list[dict[str, float | None]]:
    """Memory of the compiled gradient for more and more room for steps."""
    rows = []
    for max_steps in (1024, 4096, 16384, 65536):
        row: dict[str, float | None] = {"max_steps": max_steps}
        for name, checkpoints in (("replay", None), ("replay, 64 checkpoints", 64)):
            adjoint = mj.StepReplayAdjoint(checkpoints=checkpoints)
            end = functools.partial(position, adjoint=adjoint, max_steps=max_steps)
            row[name] = memory_kb(jax.grad(end, has_aux=True), gravity)
        rows.append(row)
    return rows


def casadi_rows(gravity: float, repeats: int) -> list[Row]:
    """SUNDIALS through casadi, forward and adjoint sensitivities; none if it is missing."""
    try:
        import casadi as ca
    except ImportError:
        return []
    y, multiplier, g = ca.SX.sym("y", 4), ca.SX.sym("mu"), ca.SX.sym("g")
    q, v = y[:2], y[2:]
    free = ca.vertcat(0, -g)
    rate = ca.vertcat(v, free - multiplier * q)
    condition = ca.dot(q, free - multiplier * q) + ca.dot(v, v)
    reduced = ca.substitute(rate, multiplier, (ca.dot(q, free) + ca.dot(v, v)) / ca.dot(q, q))
    systems = {
        "idas": {"x": y, "z": multiplier, "p": g, "ode": rate, "alg": condition},
        "cvodes": {"x": y, "p": g, "ode": reduced},
    }
    options = {"reltol": TOLERANCE, "abstol": TOLERANCE, "max_num_steps": 10**6}
    exact = exact_gradient(gravity)[0]
    rows = []
    for name, system in systems.items():
        end = ca.integrator("end", name, system, 0.0, PROBLEM().t1, options)
        parameter = ca.MX.sym("g")
        x = end(x0=[1, 0, 0, 0], p=parameter)["xf"][0]
        ways = {
            "forward": ca.jtimes(x, parameter, ca.MX(1)),
            "adjoint": ca.jtimes(x, parameter, ca.MX(1), True),
        }
        for way, expression in ways.items():
            gradient = ca.Function("gradient", [parameter], [expression])
            durations = []
            for _ in range(max(3, repeats // 10)):
                start = time.perf_counter()
                value = float(gradient(gravity))
                durations.append(1e3 * (time.perf_counter() - start))
            low, high = np.quantile(durations, (0.25, 0.75))
            timing = Timing(float(np.median(durations)), float(low), float(high))
            rows.append(
                Row("single", f"casadi {name}, {way}", timing, None, abs(value - exact), None)
            )
    return rows


def outputs(push: Any, adjoint: dfx.AbstractAdjoint) -> Any:
    """A number of 41 states of a slider-crank, to differentiate by the push, and the number of steps."""
    problem = mj.problems.slider_crank()
    sol = mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        problem.t0,
        problem.t1,
        None,
        problem.y0,
        problem.args._replace(push=push),
        saveat=dfx.SaveAt(ts=jnp.linspace(problem.t0, problem.t1, 41)),
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        adjoint=adjoint,
    )
    return sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(sol.ys)), sol.stats["num_steps"]


def measure_outputs(repeats: int) -> list[Row]:
    """Errors are differences from forward mode."""
    group, push = "slider-crank", jnp.asarray(1.0)
    by_forward = jax.jit(jax.jacfwd(lambda p: outputs(p, dfx.ForwardMode()), has_aux=True))
    exact, _ = by_forward(push)
    functions = {"solve": lambda p: outputs(p, ADJOINTS["Diffrax default"])}
    for name in ("Diffrax default", "replay"):
        functions[name] = jax.grad(functools.partial(outputs, adjoint=ADJOINTS[name]), has_aux=True)
    programs = {name: compiled(function, push) for name, function in functions.items()}
    timings = interleaved({name: run for name, (run, _) in programs.items()}, repeats)
    rows = []
    for name, (run, compiling) in programs.items():
        value, steps = run()
        error = None if name == "solve" else float(abs(value - exact))
        memory = memory_kb(functions[name], push)
        row = Row(group, name, timings[name], int(steps), error, memory, compiling.wall_s)
        rows.append(row)
    return rows


def ratios(single: list[Row], batch: list[Row], saved: list[Row]) -> list[Ratio]:
    out = []
    for rows, goal in ((single, SINGLE_GOAL), (batch, BATCH_GOAL), (saved, None)):
        ms = {row.variant: row.timing.median_ms for row in rows}
        group = rows[0].group
        for ours, other, limit in (
            ("replay", "solve", goal),
            ("Diffrax default", "solve", None),
            ("replay", "Diffrax default", DEFAULT_GOAL),
            ("replay, 64 checkpoints", "Diffrax default", None),
            ("replay", "plain, Diffrax default", DEFAULT_GOAL),
            ("plain, replay", "plain, Diffrax default", DEFAULT_GOAL),
        ):
            if ours in ms and other in ms:
                out.append(Ratio(f"{group}: {ours} / {other}", ms[ours] / ms[other], limit))
    compiling = {row.variant: row.compile_s for row in saved}
    ratio = compiling["replay"] / compiling["Diffrax default"]
    out.append(Ratio("slider-crank, compiling: replay / Diffrax default", ratio, None))
    return out


def table(rows: list[Row]) -> Table:
    table = Table(title="Gradients: median (quartiles)", title_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("variant", no_wrap=True)
    for heading in ("ms", "steps", "error", "memory kB"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        quartiles = f"({milliseconds(row.timing.low_ms)}-{milliseconds(row.timing.high_ms)})"
        table.add_row(
            row.group,
            row.variant,
            f"{milliseconds(row.timing.median_ms)} {quartiles}",
            "-" if row.steps is None else str(row.steps),
            number(row.error, ".1e"),
            number(row.memory_kb, ".0f"),
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    batch: Annotated[int, typer.Option(min=2, help="Trajectories of the batch.")] = BATCH,
    repeats: Annotated[int, typer.Option(min=3, help="Timed runs per program.")] = 30,
) -> None:
    """Time gradients of one trajectory, of a batch and of many outputs, with Diffrax's adjoints and casadi."""
    use_double_precision()
    console = make_console()
    gravity = jnp.asarray(9.81)
    single = measure("single", gravity, lambda f: f, repeats)
    several = measure(f"batch of {batch}", jnp.linspace(9.0, 10.0, batch), jax.vmap, repeats // 3)
    peers = casadi_rows(float(gravity), repeats)
    if not peers:
        console.print("casadi is not installed (`pip install 'manifold_jax\\[peers]'`): left out.")
    growth = memory_growth(gravity)
    saved = measure_outputs(repeats)
    quotients = ratios(single, several, saved)
    console.print(table(single + peers + several + saved))
    console.print(ratio_table(quotients))
    for row in growth:
        console.print("memory of the gradient in kB:", row)
    if json is not None:
        settings = {"problem": "pendulum", "tolerance": TOLERANCE, "batch": batch, "t1": 10.0}
        rows = [dataclasses.asdict(row) for row in single + peers + several + saved]
        named = [dataclasses.asdict(r) | {"met": r.met} for r in quotients]
        content = dict(
            settings=settings,
            environment=environment("casadi"),
            rows=rows,
            ratios=named,
            memory=growth,
        )
        write_json(json, content)


if __name__ == "__main__":
    typer.run(main)
