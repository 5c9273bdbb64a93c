"""A polymer of 1000 rigid bonds: this library next to RATTLE, and to SciPy without corrections.

`python -m benchmarks.peers.polymer --json benchmarks/results/polymer.json --plot benchmarks/results/polymer.png`

Time of the process for one unit of simulated time, on one core; error of the state after that time;
energy and violation over a longer run. RATTLE is `mj.rattle`, and as in molecular dynamics, compiled by JAX
(`benchmarks/peers/_rattle.py`).
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj
from manifold_jax.problems._rods import rod_field
from manifold_jax.problems.polymer import energy, force, polymer, rods

from ..tools.measure import (
    environment,
    make_console,
    number,
    use_double_precision,
    use_one_core,
    write_json,
)
from . import _rattle


STEPS = (0.04, 0.02, 0.01, 0.005, 0.0025, 0.00125)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
SOLVERS = {"Tsit5": dfx.Tsit5, "Dopri8": dfx.Dopri8}
# Of bonds, `||d|^2 - L^2| / L^2`, at which RATTLE stops.
RATTLE = {"RATTLE, sweeps": (_rattle.Sweeps, 1e-8), "RATTLE, Newton": (_rattle.Newton, 1e-12)}


class Task:
    """The polymer, its fine reference at time 1, and what is measured of a run."""

    def __init__(self, bonds: int, long: float):
        self.problem = polymer(bonds)
        self.y0, self.args, self.long = self.problem.y0, self.problem.args, long
        self.reference = self.problem.reference(1.0)
        self.start_energy = energy(self.as_numpy(self.y0), self.args)

    @staticmethod
    def as_numpy(tree: Any) -> Any:
        return jax.tree.map(np.asarray, tree)

    def row(self, method: str, setting: float, end: Any, ms: float, states: Any, **more) -> dict:
        """`end` at time 1, and `states` of the long run."""
        errors = zip(self.as_numpy(end), self.reference, strict=True)
        energies = [energy((q, v), self.args) for q, v in zip(*states, strict=True)]
        drift = np.max(np.abs(np.array(energies) / self.start_energy - 1))
        row = dict(method=method, setting=setting, ms_per_unit=ms, **more)
        row["state_error"] = float(max(np.abs(a - b).max() for a, b in errors))
        return row | dict(energy_error=float(drift), violation=self.violation(*states))

    def violation(self, q: np.ndarray, v: np.ndarray) -> float:
        """Largest `||d|^2 - 1| / 2` and `|d . d'|`, bonds of length 1."""
        d, rate = np.diff(q, axis=1), np.diff(v, axis=1)
        lengths = np.abs((d * d).sum(axis=2) - 1).max() / 2
        return float(max(lengths, np.abs((d * rate).sum(axis=2)).max()))


def timed(run: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """The result, and milliseconds of the process in the least disturbed run."""
    result, times = run(), []
    for _ in range(repeats):
        start = time.process_time()
        result = jax.block_until_ready(run())
        times.append(1e3 * (time.process_time() - start))
    return result, min(times)


def ours(task: Task, name: str, tolerances: Any, repeats: int) -> list[dict[str, Any]]:
    problem = task.problem
    solver = mj.Projected(SOLVERS[name](), problem.constraint)

    def solve(tolerance, t1, saveat):
        return mj.diffeqsolve(
            problem.terms,
            solver,
            0.0,
            t1,
            None,
            task.y0,
            task.args,
            saveat=saveat,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=100_000,
        )

    one = jax.jit(lambda tolerance: solve(tolerance, 1.0, dfx.SaveAt(t1=True)))
    times = dfx.SaveAt(ts=jnp.linspace(0, task.long, int(task.long) + 1)[1:])
    long = jax.jit(lambda tolerance: solve(tolerance, task.long, times).ys)
    rows = []
    for tolerance in tolerances:
        sol, ms = timed(lambda tol=tolerance: one(tol), repeats)
        end, steps = jax.tree.map(lambda x: x[-1], sol.ys), int(sol.stats["num_steps"])
        states = task.as_numpy(long(tolerance))
        rows.append(task.row(f"projected {name}", tolerance, end, ms, states, steps=steps))
    return rows


def by_mj_rattle(task: Task, steps: Any, repeats: int) -> list[dict[str, Any]]:
    """RATTLE of this library, to round-off. Steps that are too long for it are left out."""
    problem = task.problem
    solver = mj.rattle(problem.system)

    def solve(step, t1, saveat):
        parts = problem.terms, solver, 0.0, t1, step, task.y0, task.args
        return mj.diffeqsolve(*parts, saveat=saveat, max_steps=None, throw=False)

    one = jax.jit(lambda step: solve(step, 1.0, dfx.SaveAt(t1=True)))
    times = dfx.SaveAt(ts=jnp.linspace(0, task.long, int(task.long) + 1)[1:])
    long = jax.jit(lambda step: solve(step, task.long, times))
    rows = []
    for step in steps:
        longer = long(step)
        if longer.result != dfx.RESULTS.successful:
            continue
        sol, ms = timed(lambda step=step: one(step), repeats)
        end, number = jax.tree.map(lambda x: x[-1], sol.ys), int(sol.stats["num_steps"])
        states = task.as_numpy(longer.ys)
        rows.append(task.row("mj.rattle", step, end, ms, states, steps=number))
    return rows


def rattle(task: Task, name: str, step: float, repeats: int) -> dict[str, Any]:
    method, tolerance = RATTLE[name]
    chain = _rattle.Chain(1 / task.args.masses, task.args.lengths)
    of_beads = lambda q: task.problem.system.force(0.0, q, q, task.args)
    steps = round(1 / step)
    build = lambda steps, saved: jax.jit(
        _rattle.rattle(chain, of_beads, step, steps, saved, method(tolerance))
    )
    one, long = build(steps, 1), build(round(task.long / step), int(task.long))
    end, ms = timed(lambda: one(*task.y0), repeats)
    states = task.as_numpy(long(*task.y0))
    end = jax.tree.map(lambda x: x[-1], end)
    return task.row(name, step, end, ms, states, steps=steps)


def by_scipy(task: Task, tolerance: float) -> dict[str, Any]:
    q, v = task.as_numpy(task.y0)
    field = rod_field(rods(task.as_numpy(task.args)), force(task.args), 3)
    y0 = np.concatenate([q, v]).reshape(-1)

    def solve(t1, times):
        return solve_ivp(
            field, (0, t1), y0, method="DOP853", rtol=tolerance, atol=tolerance, t_eval=times
        )

    states = lambda sol: np.moveaxis(sol.y.T.reshape(-1, 2, *q.shape), 1, 0)
    sol, ms = timed(lambda: solve(1.0, None), 1)
    end = tuple(part[-1] for part in states(sol))
    long = states(solve(task.long, np.arange(1.0, task.long + 0.5)))
    return task.row("SciPy DOP853", tolerance, end, ms, long, steps=len(sol.t) - 1)


def table(rows: list[dict[str, Any]]) -> Table:
    out = Table(*rows[0])
    for row in rows:
        out.add_row(*(x if isinstance(x, str) else number(x, ".3g") for x in row.values()))
    return out


def write_figure(path: Path, rows: list[dict[str, Any]], long: float) -> None:
    titles = {
        "state_error": "error of the state at t = 1",
        "energy_error": f"relative error of the energy, t up to {long:g}",
        "violation": f"violation of the bonds, t up to {long:g}",
    }
    figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for axis, (name, title) in zip(axes, titles.items(), strict=True):
        for method, marker in zip(methods, "osPv^D", strict=False):
            own = [row for row in rows if row["method"] == method]
            points = zip(*((row["ms_per_unit"], row[name]) for row in own), strict=True)
            axis.loglog(*points, marker=marker, label=method)
        axis.set(xlabel="ms per unit of time", title=title)
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=9)
    figure.savefig(path, dpi=150)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    bonds: Annotated[int, typer.Option(min=2, help="Rigid bonds.")] = 1000,
    long: Annotated[float, typer.Option(min=1, help="Time span of the longer run.")] = 20.0,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 5,
    quick: Annotated[bool, typer.Option(help="One setting of each method.")] = False,
) -> None:
    """Measure a polymer of rigid bonds."""
    use_one_core()
    use_double_precision()
    task = Task(bonds, long)
    of = lambda settings: settings[1:2] if quick else settings
    rows = [row for name in SOLVERS for row in ours(task, name, of(TOLERANCES), repeats)]
    rows += by_mj_rattle(task, of(STEPS), repeats)
    rows += [rattle(task, name, step, repeats) for name in RATTLE for step in of(STEPS)]
    rows += [by_scipy(task, tolerance) for tolerance in of(TOLERANCES)]
    make_console().print(table(rows))
    if json is not None:
        tolerances = {name: tolerance for name, (_, tolerance) in RATTLE.items()}
        settings = {"bonds": bonds, "long": long, "rattle_tolerances": tolerances}
        write_json(json, {"environment": environment(), "settings": settings, "rows": rows})
    if plot is not None:
        write_figure(plot, rows, long)


if __name__ == "__main__":
    typer.run(main)
