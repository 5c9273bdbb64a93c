"""Ensembles of any size on the device at hand, in single and double precision: `mj.solve_ensemble` next to
`jax.vmap` of `mj.diffeqsolve`, which for Lorenz' system is that of Diffrax.

`python -m benchmarks.speed.accelerator --sizes 1000,10000,100000,1000000 --json benchmarks/results/accelerator.json`

Lorenz' system with a parameter of its own for each trajectory, Tsit5 alone, t in [0, 1], the published comparison
of ensembles on GPUs (Utkarsh et al., Comput. Methods Appl. Mech. Engrg. 419 (2024) 116591); and double pendulums
with masses of their own, projected, t in [0, 5]. Up to `--lanes` trajectories advance together.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    make_console,
    number,
    use_double_precision,
    write_json,
)
from . import _double_pendulum as double_pendulum


OURS, THEIRS = "solve_ensemble", "vmap"


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    precision: str
    method: str
    trajectories: int
    steps: float  # of a trajectory
    violation: float | None  # None: there is no constraint
    difference: float  # from `mj.solve_ensemble`
    compile_s: float
    ms: float
    trajectories_per_s: float
    steps_per_s: float


class Case(NamedTuple):
    """A problem for many trajectories: the arrays that each has of its own."""

    terms: dfx.AbstractTerm
    constraint: mj.AbstractConstraint | None
    t1: float
    y0s: Any
    args: Any
    args_axes: Any


def lorenz(size: int) -> Case:
    def field(t, y, rho):
        a, b, c = y[0], y[1], y[2]
        return jnp.stack([10.0 * (b - a), a * (rho - c) - b, a * b - 8.0 / 3.0 * c])

    starts = np.tile([1.0, 0.0, 0.0], (size, 1))
    return Case(dfx.ODETerm(field), None, 1.0, starts, np.linspace(0.0, 21.0, size), 0)


def pendulums(size: int) -> Case:
    problem, given = mj.problems.double_pendulum(), double_pendulum.pendulums(size)
    kind = type(problem.args)
    args = kind(given.masses, np.ones(2), np.asarray(9.81))
    args_axes = kind(0, None, None)
    return Case(problem.terms, problem.constraint, 5.0, given.y0s, args, args_axes)


CASES = {"lorenz": lorenz, "double_pendulum": pendulums}


def programs(case: Case, lanes: int, tolerance: float) -> dict[str, Callable]:
    """Functions of `(y0s, args)` that return the last states and the numbers of steps."""
    control = dfx.PIDController(rtol=tolerance, atol=tolerance)
    solver = dfx.Tsit5()
    if case.constraint is not None:
        solver = mj.Projected(solver, case.constraint)

    def ours(y0s: Any, args: Any) -> Any:
        sol = mj.solve_ensemble(
            case.terms,
            solver,
            0.0,
            case.t1,
            None,
            y0s,
            args,
            args_axes=case.args_axes,
            stepsize_controller=control,
            lanes=lanes,
        )
        return sol.ys, sol.stats["num_steps"]

    def one(y0: Any, args: Any) -> Any:
        sol = mj.diffeqsolve(
            case.terms,
            solver,
            0.0,
            case.t1,
            None,
            y0,
            args,
            stepsize_controller=control,
            throw=False,
        )
        return sol.ys, sol.stats["num_steps"]

    return {OURS: ours, THEIRS: jax.vmap(one, in_axes=(0, case.args_axes))}


def measure(
    name: str, precision: str, size: int, lanes: int, tolerance: float, repeats: int
) -> list[Row]:
    """Rows of both methods."""
    jax.config.update("jax_enable_x64", precision == "double")
    case = CASES[name](size)
    given = jtu.tree_map(jnp.asarray, (case.y0s, case.args))
    functions = programs(case, min(lanes, size), tolerance)
    built = {method: compiled(function, *given) for method, function in functions.items()}
    timings = interleaved({method: run for method, (run, _) in built.items()}, repeats)
    ends = {method: jtu.tree_map(np.asarray, run()) for method, (run, _) in built.items()}
    rows = []
    for method, (ys, steps) in ends.items():
        pairs = zip(jtu.tree_leaves(ys), jtu.tree_leaves(ends[OURS][0]), strict=True)
        seconds = timings[method].median_ms / 1e3
        violation = None
        if case.constraint is not None:
            violation = double_pendulum.largest_violation(
                jtu.tree_map(lambda y: y[:, -1].astype(float), ys)
            )
        rows.append(
            Row(
                name,
                precision,
                method,
                size,
                float(np.mean(steps)),
                violation,
                max(float(np.max(np.abs(a - b))) for a, b in pairs),
                built[method][1].wall_s,
                timings[method].median_ms,
                size / seconds,
                float(np.sum(steps)) / seconds,
            )
        )
    return rows


def table_of(rows: list[Row]) -> Table:
    device = jax.devices()[0].device_kind
    table = Table(title=f"Ensembles on {device}", title_justify="left")
    for heading in ("problem", "precision", "method"):
        table.add_column(heading, no_wrap=True)
    headings = ("trajectories", "steps", "max |g|", "difference", "compile, s", "ms")
    for heading in (*headings, "trajectories / s", "steps / s"):
        table.add_column(heading, justify="right")
    for r in rows:
        table.add_row(
            r.problem,
            r.precision,
            r.method,
            str(r.trajectories),
            f"{r.steps:.0f}",
            number(r.violation, ".0e"),
            f"{r.difference:.0e}",
            f"{r.compile_s:.1f}",
            f"{r.ms:.3g}",
            f"{r.trajectories_per_s:.2e}",
            f"{r.steps_per_s:.2e}",
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    sizes: Annotated[str, typer.Option(help="Numbers of trajectories.")] = "1000,10000,100000",
    lanes: Annotated[
        int | None, typer.Option(help="By default 128 on a CPU, 65536 elsewhere.")
    ] = None,
    precisions: Annotated[str, typer.Option(help="single, double or both.")] = "single,double",
    problems: Annotated[str, typer.Option()] = ",".join(CASES),
    tolerance: Annotated[float, typer.Option(help="rtol and atol.")] = 1e-6,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 5,
) -> None:
    """Measure ensembles of several sizes on the device that JAX finds."""
    use_double_precision()
    if lanes is None:
        lanes = 128 if jax.default_backend() == "cpu" else 65536
    console, rows = make_console(), []
    with console.status("measuring"):
        for name in problems.split(","):
            for precision in precisions.split(","):
                for size in sizes.split(","):
                    rows += measure(name, precision, int(size), lanes, tolerance, repeats)
    jax.config.update("jax_enable_x64", True)
    console.print(table_of(rows))
    if json is not None:
        settings = {"tolerance": tolerance, "lanes": lanes}
        content = {"environment": environment(), "settings": settings}
        write_json(json, content | {"rows": [dataclasses.asdict(row) for row in rows]})


if __name__ == "__main__":
    typer.run(main)
