"""Ensembles of any size on the device at hand, in single and double precision: `mj.solve_ensemble` next to
`jax.vmap` of `mj.diffeqsolve`, which for Lorenz' system is that of Diffrax.

`python -m benchmarks.speed.accelerator --sizes 1000,10000,100000,1000000 --json benchmarks/results/accelerator.json`

Lorenz' system with a parameter of its own for each trajectory, Tsit5 alone, t in [0, 1], the published comparison
of ensembles on GPUs (Utkarsh et al., Comput. Methods Appl. Mech. Engrg. 419 (2024) 116591); and double pendulums
with masses of their own, projected, t in [0, 5]. With `--mesh` all devices share an ensemble: the cores of a CPU are as many
with `XLA_FLAGS=--xla_force_host_platform_device_count=16`.
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
    lanes: int | None
    devices: int
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


def programs(
    case: Case, lanes: list[int], tolerance: float, mesh: Any = None
) -> dict[tuple[str, int | None], Callable]:
    """Functions of `(y0s, args)` that return the last states and the numbers of steps, by method and lanes."""
    control = dfx.PIDController(rtol=tolerance, atol=tolerance)
    solver = dfx.Tsit5()
    if case.constraint is not None:
        solver = mj.Projected(solver, case.constraint)
    common = case.terms, solver, 0.0, case.t1, None

    def in_lanes(lanes: int) -> Callable:
        def ours(y0s: Any, args: Any) -> Any:
            options = {"lanes": lanes, "mesh": mesh, "stepsize_controller": control}
            sol = mj.solve_ensemble(*common, y0s, args, args_axes=case.args_axes, **options)
            return sol.ys, sol.stats["num_steps"]

        return ours

    def one(y0: Any, args: Any) -> Any:
        sol = mj.diffeqsolve(*common, y0, args, stepsize_controller=control, throw=False)
        return sol.ys, sol.stats["num_steps"]

    found: dict[tuple[str, int | None], Callable] = {(OURS, n): in_lanes(n) for n in lanes}
    if mesh is None:
        found[THEIRS, None] = jax.vmap(one, in_axes=(0, case.args_axes))
    return found


class Built(NamedTuple):
    """Compiled programs of one problem and size."""

    name: str
    precision: str
    size: int
    devices: int
    constrained: bool
    runs: dict[tuple[str, int | None], Callable]
    compile_s: dict[tuple[str, int | None], float]


def build(
    name: str, precision: str, size: int, lanes: list[int], tolerance: float, mesh: Any = None
) -> Built:
    jax.config.update("jax_enable_x64", precision == "double")
    case = CASES[name](size)
    given = jtu.tree_map(jnp.asarray, (case.y0s, case.args))
    devices = 1 if mesh is None else mesh.size
    # More lanes than trajectories are as many as these.
    fitting = sorted({min(n, -(-size // devices)) for n in lanes})
    built = {
        key: compiled(function, *given)
        for key, function in programs(case, fitting, tolerance, mesh).items()
    }
    runs = {key: run for key, (run, _) in built.items()}
    seconds = {key: taken.wall_s for key, (_, taken) in built.items()}
    return Built(name, precision, size, devices, case.constraint is not None, runs, seconds)


def measure(built: Built, repeats: int) -> list[Row]:
    """Rows of all methods."""
    timings = interleaved({str(key): run for key, run in built.runs.items()}, repeats)
    ends = {key: jtu.tree_map(np.asarray, run()) for key, run in built.runs.items()}
    first, rows = next(iter(ends.values())), []
    for key, (ys, steps) in ends.items():
        pairs = zip(jtu.tree_leaves(ys), jtu.tree_leaves(first[0]), strict=True)
        seconds = timings[str(key)].median_ms / 1e3
        violation = None
        if built.constrained:
            violation = double_pendulum.largest_violation(
                jtu.tree_map(lambda y: y[:, -1].astype(float), ys)
            )
        rows.append(
            Row(
                built.name,
                built.precision,
                *key,
                built.devices,
                built.size,
                float(np.mean(steps)),
                violation,
                max(float(np.max(np.abs(a - b))) for a, b in pairs),
                built.compile_s[key],
                timings[str(key)].median_ms,
                built.size / seconds,
                float(np.sum(steps)) / seconds,
            )
        )
    return rows


def table_of(rows: list[Row]) -> Table:
    device = jax.devices()[0].device_kind
    table = Table(title=f"Ensembles on {device}", title_justify="left")
    for heading in ("problem", "precision", "method"):
        table.add_column(heading, no_wrap=True)
    headings = ("lanes", "trajectories", "steps", "max |g|", "difference", "compile, s", "ms")
    for heading in (*headings, "trajectories / s", "steps / s"):
        table.add_column(heading, justify="right")
    for r in rows:
        table.add_row(
            r.problem,
            r.precision,
            r.method,
            number(r.lanes, "d"),
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
        str, typer.Option(help="Of solve_ensemble, separated by commas.")
    ] = "128,4096,65536",
    mesh: Annotated[bool, typer.Option("--mesh", help="Use all devices.")] = False,
    precisions: Annotated[str, typer.Option(help="single, double or both.")] = "single,double",
    problems: Annotated[str, typer.Option()] = ",".join(CASES),
    tolerance: Annotated[float, typer.Option(help="rtol and atol.")] = 1e-6,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 5,
) -> None:
    """Measure ensembles of several sizes on the device that JAX finds."""
    use_double_precision()
    devices = jax.make_mesh((jax.device_count(),), ("trajectories",)) if mesh else None
    numbers = [int(n) for n in lanes.split(",")]
    console, rows = make_console(), []
    with console.status("measuring"):
        for name in problems.split(","):
            for precision in precisions.split(","):
                for size in sizes.split(","):
                    built = build(name, precision, int(size), numbers, tolerance, devices)
                    rows += measure(built, repeats)
    jax.config.update("jax_enable_x64", True)
    console.print(table_of(rows))
    if json is not None:
        settings = {"tolerance": tolerance, "repeats": repeats}
        content = {"environment": environment(), "settings": settings}
        write_json(json, content | {"rows": [dataclasses.asdict(row) for row in rows]})


if __name__ == "__main__":
    typer.run(main)
