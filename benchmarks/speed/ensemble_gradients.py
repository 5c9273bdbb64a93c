"""Gradients through many trajectories: `mj.solve_ensemble` in lanes, next to `jax.lax.map` and `jax.vmap`
of `mj.diffeqsolve`.

`python -m benchmarks.speed.ensemble_gradients --json benchmarks/results/ensemble_gradients.json`

The gradient of the mean of |y|^2 at the end with respect to the parameters (common to all trajectories)
and to the initial values; projected Tsit5, rtol = atol = 1e-6, one core. `difference` is the largest one
from the gradient of `vmap`, relative to its largest component.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)
from .ensemble import CONTROLLER, starts, TOLERANCE


PROBLEMS = ("pendulum", "double_pendulum", "kepler")
# Of the time span of each problem: the derivatives of chaotic motion grow.
SPAN = 0.2


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    trajectories: int
    method: str
    steps: float  # of a trajectory
    solve_ms: float
    gradient_ms: float
    solve_compile_s: float
    gradient_compile_s: float
    difference: float


def solves(problem: Problem) -> dict[str, Callable]:
    """States at the end, and numbers of steps."""
    hook = mj.Projected(dfx.Tsit5(), problem.constraint)
    t1 = problem.t0 + SPAN * (problem.t1 - problem.t0)
    common = problem.terms, hook, problem.t0, t1, None

    def one(y0: Any, args: Any) -> tuple[Any, Any]:
        sol = mj.diffeqsolve(*common, y0, args, stepsize_controller=CONTROLLER, throw=False)
        return sol.ys, sol.stats["num_steps"]

    def ensemble(y0s: Any, args: Any) -> tuple[Any, Any]:
        sol = mj.solve_ensemble(*common, y0s, args, args_axes=None, stepsize_controller=CONTROLLER)
        return sol.ys, sol.stats["num_steps"]

    def mapped(y0s: Any, args: Any) -> tuple[Any, Any]:
        return jax.lax.map(lambda y0: one(y0, args), y0s, batch_size=128)

    return {
        "solve_ensemble": ensemble,
        "lax.map in batches of 128": mapped,
        "vmap": jax.vmap(one, (0, None)),
    }


def measure(problem: Problem, size: int, repeats: int) -> list[Row]:
    inputs = starts(problem, size), jtu.tree_map(jnp.asarray, problem.args)
    runs, seconds = {}, {}
    for name, solve in solves(problem).items():

        def mean(inputs: Any, solve: Callable = solve) -> tuple[Any, Any]:
            ys, num_steps = solve(*inputs)
            return sum(jnp.sum(y**2) for y in jtu.tree_leaves(ys)) / size, num_steps

        runs[name, "solve"], seconds[name, "solve"] = compiled(mean, inputs)
        gradient = jax.grad(mean, has_aux=True)
        runs[name, "gradient"], seconds[name, "gradient"] = compiled(gradient, inputs)
    timings = interleaved(runs, repeats)
    gradients = {name: runs[name, "gradient"]() for name, _ in runs}
    flat = {name: jfu.ravel_pytree(gradient)[0] for name, (gradient, _) in gradients.items()}
    scale = jnp.max(jnp.abs(flat["vmap"]))
    return [
        Row(
            problem.name,
            size,
            name,
            float(jnp.mean(num_steps)),
            timings[name, "solve"].median_ms,
            timings[name, "gradient"].median_ms,
            seconds[name, "solve"].process_s,
            seconds[name, "gradient"].process_s,
            float(jnp.max(jnp.abs(flat[name] - flat["vmap"])) / scale),
        )
        for name, (_, num_steps) in gradients.items()
    ]


def table_of(rows: list[Row]) -> Table:
    table = Table(title="One core", title_justify="left")
    table.add_column("problem", no_wrap=True)
    table.add_column("method", no_wrap=True)
    headings = ("trajectories", "steps", "solve, ms", "gradient, ms", "gradient / solve")
    for heading in (*headings, "times ours", "compile, s", "difference"):
        table.add_column(heading, justify="right")
    ours = 1.0
    for r in rows:
        if r.method == "solve_ensemble":
            table.add_section()
            ours = r.gradient_ms
        table.add_row(
            r.problem,
            r.method,
            str(r.trajectories),
            f"{r.steps:.0f}",
            f"{r.solve_ms:.3g}",
            f"{r.gradient_ms:.3g}",
            f"{r.gradient_ms / r.solve_ms:.1f}",
            f"{r.gradient_ms / ours:.1f}",
            f"{r.solve_compile_s:.1f}, {r.gradient_compile_s:.1f}",
            f"{r.difference:.0e}",
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    sizes: Annotated[str, typer.Option(metavar="N,...", help="Trajectories.")] = "256,1000",
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 5,
    problems: Annotated[str, typer.Option(metavar="NAME,...")] = ",".join(PROBLEMS),
) -> None:
    """Measure gradients of ensembles."""
    use_one_core()
    use_double_precision()
    console = make_console()
    with console.status("measuring"):
        rows = []
        for name in problems.split(","):
            for size in map(int, sizes.split(",")):
                rows += measure(getattr(mj.problems, name)(), size, repeats)
    console.print(table_of(rows))
    if json is not None:
        settings = {"rtol": TOLERANCE, "span": SPAN}
        content = {"environment": environment(), "settings": settings}
        write_json(json, {**content, "rows": [dataclasses.asdict(row) for row in rows]})


if __name__ == "__main__":
    typer.run(main)
