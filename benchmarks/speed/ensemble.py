"""Many trajectories: `mj.solve_ensemble` next to `jax.vmap` and `jax.lax.map` of `mj.diffeqsolve`, and
to SciPy; double pendulums next to C; and a batch in which a few trajectories take much longer.

`python -m benchmarks.speed.ensemble --json benchmarks/results/ensemble.json`

Projected Tsit5, rtol = atol = 1e-6, the states at the end (and once 101 of them), from disturbed initial values that are made
consistent; microseconds per step and trajectory on one core. `vmap` gets fewer trajectories, as its time
grows with them; SciPy (DOP853, no constraint) gets three. `double_pendulum.c` takes the same steps, with gcc
where there is one.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import (
    compiled,
    CompileTime,
    environment,
    interleaved,
    make_console,
    Timing,
    use_double_precision,
    use_one_core,
    write_json,
)
from . import _double_pendulum as by_hand, _heavy_tail as heavy_tail


TOLERANCE = 1e-6
CONTROLLER = dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE)
DISTURBANCE = 0.1
SAVED = 101
PROBLEMS = ("pendulum", "double_pendulum", "rigid_body", "kepler", "slider_crank", "four_bar")


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    saved: int  # values of each trajectory
    method: str
    trajectories: int
    steps: float  # of a trajectory
    violation: float
    difference: float  # from the same trajectories one by one
    compile_s: float | None
    us_per_trajectory: float
    us_per_step: float


class Outcome(NamedTuple):
    ys: Any
    num_steps: Any


def starts(problem: Problem, size: int) -> Any:
    """Consistent; those that cannot be made so are left out."""
    random = np.random.default_rng(0)
    near = lambda x: np.asarray(x) + DISTURBANCE * random.normal(size=(2 * size, *np.shape(x)))
    args = jtu.tree_map(jnp.asarray, problem.args)
    consistent = lambda y: mj.consistent_state(problem.constraint, problem.t0, y, args, throw=False)
    y0s, info = jax.vmap(consistent)(jtu.tree_map(lambda x: jnp.asarray(near(x)), problem.y0))
    chosen = np.flatnonzero(np.asarray(info.success))[:size]
    return jtu.tree_map(lambda x: x[chosen], y0s)


def times_of(problem: Problem, saved: int) -> Any:
    return np.linspace(problem.t0, problem.t1, saved) if saved > 1 else np.array([problem.t1])


def methods(problem: Problem, saved: int, lanes: int) -> dict[str, Callable]:
    hook = mj.Projected(dfx.Tsit5(), problem.constraint)
    args = jtu.tree_map(jnp.asarray, problem.args)
    common = problem.terms, hook, problem.t0, problem.t1, None
    saveat = dfx.SaveAt(ts=times_of(problem, saved)) if saved > 1 else dfx.SaveAt(t1=True)
    options = {"saveat": saveat, "stepsize_controller": CONTROLLER}

    def one(y0: Any) -> Outcome:
        sol = mj.diffeqsolve(*common, y0, args, throw=False, **options)
        return Outcome(sol.ys, sol.stats["num_steps"])

    def ensemble(y0s: Any) -> Outcome:
        sol = mj.solve_ensemble(*common, y0s, args, args_axes=None, lanes=lanes, **options)
        return Outcome(sol.ys, sol.stats["num_steps"])

    return {
        "solve_ensemble": ensemble,
        "vmap": jax.vmap(one),
        "lax.map in batches of 250": lambda y0s: jax.lax.map(one, y0s, batch_size=250),
        "one by one": lambda y0s: jax.lax.map(one, y0s),
    }


def scipy_row(problem: Problem, saved: int, y0s: Any) -> Row:
    """Of the first three, with the vector field compiled by JAX."""
    args = jtu.tree_map(jnp.asarray, problem.args)
    _, unravel = jfu.ravel_pytree(problem.y0)
    field = jax.jit(lambda t, y: jfu.ravel_pytree(problem.terms.vf(t, unravel(y), args))[0])
    flat = [
        np.asarray(jfu.ravel_pytree(jtu.tree_map(lambda x, i=i: x[i], y0s))[0]) for i in range(3)
    ]
    right_hand_side = lambda t, y: np.asarray(field(t, y))
    span, ts = (problem.t0, problem.t1), times_of(problem, saved)
    solve = lambda y, ts=ts: solve_ivp(
        right_hand_side, span, y, "DOP853", ts, rtol=TOLERANCE, atol=TOLERANCE
    )
    solve(flat[0])
    start = time.perf_counter()
    sols = [solve(y) for y in flat]
    seconds = (time.perf_counter() - start) / len(sols)
    steps = float(np.mean([solve(y, None).t.size - 1 for y in flat]))
    ends = jax.vmap(unravel)(jnp.asarray(np.stack([sol.y[:, -1] for sol in sols])))
    violation = largest_violation(problem, ends)
    us = 1e6 * seconds
    return Row(
        problem.name, saved, "SciPy DOP853", 3, steps, violation, np.nan, None, us, us / steps
    )


def largest_violation(problem: Problem, ends: Any) -> float:
    args = jtu.tree_map(jnp.asarray, problem.args)
    one = lambda y: mj.constraint_violation(problem.constraint, problem.t1, y, args)
    return float(jnp.max(jax.vmap(one)(ends)))


def measure(problem: Problem, saved: int, size: int, lanes: int, repeats: int) -> list[Row]:
    y0s = starts(problem, size)
    few = jtu.tree_map(lambda x: x[: min(size, 1000)], y0s)
    programs: dict[str, tuple[Callable, CompileTime]] = {}
    for name, function in methods(problem, saved, lanes).items():
        programs[name] = compiled(function, y0s if name == "solve_ensemble" else few)
    timings = interleaved({name: run for name, (run, _) in programs.items()}, repeats)
    reference = programs["one by one"][0]()
    rows = [
        row_of(problem, saved, name, run(), reference, seconds, timings[name])
        for name, (run, seconds) in programs.items()
    ]
    return [*rows, scipy_row(problem, saved, y0s)]


def row_of(
    problem: Problem,
    saved: int,
    name: str,
    outcome: Outcome,
    reference: Outcome,
    seconds: CompileTime,
    timing: Timing,
) -> Row:
    size, count = outcome.num_steps.shape[0], reference.num_steps.shape[0]
    ends = jtu.tree_map(lambda x: x[:, -1], outcome.ys)
    difference = max(
        float(jnp.max(jnp.abs(a[:count] - b)))
        for a, b in zip(jtu.tree_leaves(outcome.ys), jtu.tree_leaves(reference.ys), strict=True)
    )
    us = 1e3 * timing.median_ms
    return Row(
        problem.name,
        saved,
        name,
        size,
        float(jnp.mean(outcome.num_steps)),
        largest_violation(problem, ends),
        difference,
        seconds.process_s,
        us / size,
        us / float(jnp.sum(outcome.num_steps)),
    )


def table_of(rows: list[Row]) -> Table:
    table = Table(title="One core", title_justify="left")
    table.add_column("problem", no_wrap=True)
    table.add_column("saved", justify="right")
    table.add_column("method", no_wrap=True)
    headings = ("trajectories", "steps", "max |g|", "difference", "compile, s", "us / trajectory")
    for heading in (*headings, "us / step", "times ours"):
        table.add_column(heading, justify="right")
    ours = 1.0
    for r in rows:
        if r.method == "solve_ensemble":
            table.add_section()
            ours = r.us_per_trajectory
        table.add_row(
            r.problem,
            str(r.saved),
            r.method,
            str(r.trajectories),
            f"{r.steps:.0f}",
            f"{r.violation:.0e}",
            f"{r.difference:.0e}",
            "" if r.compile_s is None else f"{r.compile_s:.1f}",
            f"{r.us_per_trajectory:.3g}",
            f"{r.us_per_step:.3g}",
            f"{r.us_per_trajectory / ours:.1f}",
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    size: Annotated[int, typer.Option(min=4, help="Trajectories.")] = 4000,
    lanes: Annotated[int, typer.Option(min=1, help="That advance together.")] = 128,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 3,
    problems: Annotated[str, typer.Option(metavar="NAME,...")] = ",".join(PROBLEMS),
    saved: Annotated[int, typer.Option(min=2, help="Values of double pendulums, once.")] = SAVED,
    pendulums: Annotated[int, typer.Option(min=1, help="Next to C.")] = 20_000,
) -> None:
    """Measure ensembles next to `vmap`, `lax.map`, SciPy and C."""
    use_one_core()
    use_double_precision()
    console = make_console()
    with console.status("measuring"):
        rows = []
        for name in problems.split(","):
            rows += measure(getattr(mj.problems, name)(), 1, size, lanes, repeats)
        rows += measure(mj.problems.double_pendulum(), saved, size, lanes, repeats)
        pendulum_rows = by_hand.measure(pendulums, lanes, TOLERANCE, repeats)
        tail = heavy_tail.measure(size, lanes, TOLERANCE, repeats)
    console.print(table_of(rows), by_hand.table_of(pendulum_rows))
    console.print(
        f"1 of {heavy_tail.ONE_IN} orbits takes up to {tail.most_steps} steps, the mean is {tail.steps:.0f}: "
        f"{tail.ratio:.2f} times the sum of what each would take in full lanes"
    )
    if json is not None:
        settings = {"rtol": TOLERANCE, "lanes": lanes, "disturbance": DISTURBANCE}
        content = {"environment": environment(), "settings": settings}
        content["rows"] = [dataclasses.asdict(row) for row in rows]
        content["double_pendulums"] = [dataclasses.asdict(row) for row in pendulum_rows]
        write_json(json, content | {"heavy_tail": dataclasses.asdict(tail)})


if __name__ == "__main__":
    typer.run(main)
