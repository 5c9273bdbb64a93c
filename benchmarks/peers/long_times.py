"""A million steps: RATTLE and symmetric projection, projected Runge-Kutta methods and SciPy; and what is left of
single precision.

`python -m benchmarks.peers.long_times --json benchmarks/results/long_times.json --plot benchmarks/results/long_times.png`

RATTLE and the projected methods evaluate the forces of a mechanism a million times, over the same time; SciPy has a
tolerance. The trend of a conserved quantity is the slope of the means of 20 parts of the run, with its standard error.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    number,
    use_double_precision,
    use_one_core,
    write_json,
)
from ._long_time_problems import pendulum, planet, Task, top


SAMPLES = 1000
PARTS = 20
TOLERANCE = 1e-8  # of SciPy


def row(task: Task, method: str, times: Any, states: Any, seconds: float, **more: Any) -> dict:
    """Summarize states at `times`; the samples are for the picture."""
    q, v = states
    start = tuple(np.asarray(leaf) for leaf in task.y0)
    changes = {"energy": task.energy(q, v) - task.energy(*start)}
    if task.momentum is not None:
        changes["momentum"] = task.momentum(q, v) - task.momentum(*start)
    observed = changes[task.observed]
    means = [mean(part) for part in np.array_split(observed, PARTS)]
    middles = [mean(part) for part in np.array_split(times, PARTS)]
    (slope, _), covariance = np.polyfit(middles, means, 1, cov=True)
    out = dict(problem=task.name, method=method, **more, seconds=seconds)
    out |= {name: float(np.abs(change).max()) for name, change in changes.items()}
    out.setdefault("momentum", None)
    out |= dict(
        observed=task.observed, trend=float(slope), trend_noise=float(np.sqrt(covariance[0, 0]))
    )
    out["violation"] = float(task.violation(q, v).max())
    largest = [float(np.abs(part).max()) for part in np.array_split(observed, 5 * PARTS)]
    return out | dict(end=float(times[-1]), samples=largest)


def mean(part: np.ndarray) -> float:
    """With weights that vanish at both ends: the oscillation that is cut there does not count."""
    return float(np.average(part, weights=np.hanning(len(part) + 2)[1:-1]))


def constant_steps(task: Task, method: str, evaluations: int) -> dict[str, Any]:
    each, solver = task.methods[method]
    steps = evaluations // each // SAMPLES * SAMPLES
    h, every = each * task.step, steps // SAMPLES

    @jax.jit
    def solve(y0):
        saveat = dfx.SaveAt(steps=every)
        options = dict(saveat=saveat, max_steps=steps + every)
        return mj.diffeqsolve(task.terms, solver, 0.0, steps * h, h, y0, **options)

    program = solve.lower(task.y0).compile()
    start = time.process_time()
    sol = jax.block_until_ready(program(task.y0))
    seconds = time.process_time() - start
    assert sol.stats["num_steps"] == steps
    states = tuple(np.asarray(leaf)[:SAMPLES] for leaf in sol.ys)
    times = np.asarray(sol.ts)[:SAMPLES]
    return row(task, method, times, states, seconds, step=h, steps=steps)


def by_scipy(task: Task, evaluations: int) -> dict[str, Any]:
    """DOP853 without corrections, over the same time."""
    times = task.step * evaluations * np.arange(1, SAMPLES + 1) / SAMPLES
    y0 = np.concatenate([np.ravel(leaf) for leaf in task.y0])
    options = dict(method="DOP853", rtol=TOLERANCE, atol=TOLERANCE, t_eval=times)
    start = time.process_time()
    sol = solve_ivp(task.field, (0, times[-1]), y0, **options)
    seconds = time.process_time() - start
    shape = (-1, *task.y0[0].shape)
    states = tuple(part.T.reshape(shape) for part in np.split(sol.y, 2))
    more = dict(step=None, steps=None)  # they vary
    return row(task, "SciPy DOP853", times, states, seconds, **more)


def every_state(build: Callable[[], Task], steps: int, double: bool, carries: bool) -> Any:
    """Return the states after all steps of order 2. Without `carries` the solver forgets, after each step, what
    rounding has taken from the state."""
    with jax.enable_x64(double):
        task = build()
        _, solver = task.methods["RATTLE 2"]
        made = dict(
            terms=task.terms, t0=0.0, t1=task.step, args=None
        )  # forces do not depend on time

        def advance(carry, _):
            y, state = carry
            y1, _, _, after, _ = solver.step(**made, y0=y, solver_state=state, made_jump=False)
            return (y1, after if carries else state), y1

        start = task.y0, solver.init(**made, y0=task.y0)
        run = jax.jit(lambda start: jax.lax.scan(advance, start, length=steps)[1])
        return task, tuple(np.asarray(leaf) for leaf in run(start))


def single_precision(build: Callable[[], Task], steps: int) -> list[dict[str, Any]]:
    """Compare with the same steps in double precision."""
    _, exact = every_state(build, steps, True, True)
    rows, unit = [], float(np.finfo(np.float32).eps)
    for carries in (True, False):
        task, (q, v) = every_state(build, steps, False, carries)
        q, v = q.astype(float), v.astype(float)
        error = np.abs(q - exact[0]).reshape(steps, -1).max(axis=1)
        out = dict(problem=task.name, compensated=carries, steps=steps)
        out["violation_in_units"] = float(task.violation(q, v).max() / unit)
        out |= dict(error=float(error.max()), end=steps * task.step)
        energy = np.abs(task.energy(q, v) - task.energy(*exact)).max()
        largest = [float(part.max()) for part in np.array_split(error, 5 * PARTS)]
        rows.append(out | dict(energy=float(energy), samples=largest))
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    names = [name for name in rows[0] if name not in ("samples", "end")]
    out = Table(*names)
    text = lambda x: str(x) if isinstance(x, str | bool) else number(x, ".3g")
    for row in rows:
        out.add_row(*(text(row[name]) for name in names))
    return out


def write_figure(path: Path, rows: list[dict[str, Any]], single: list[dict[str, Any]]) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(12, 8), layout="constrained")
    axes = axes.ravel()
    names = list(dict.fromkeys(row["problem"] for row in rows))
    colors = dict(zip("246", ("C0", "C1", "C2"), strict=True))
    colors |= {"projected Dopri5": "C3", "projected Dopri8": "C4", "SciPy DOP853": "C5"}

    color_of = lambda method: colors.get(method) or colors[method[-1]]

    def draw(axis: Any, row: dict[str, Any], label: str, **style: Any) -> None:
        times = row["end"] * np.arange(1, len(row["samples"]) + 1) / len(row["samples"])
        axis.loglog(times, row["samples"], label=label, **style)

    for axis, name in zip(axes, names, strict=False):
        for row in rows:
            if row["problem"] == name:
                draw(axis, row, row["method"], color=color_of(row["method"]))
        observed = next(row["observed"] for row in rows if row["problem"] == name)
        axis.set(title=f"{name}: largest relative error of the {observed}", xlabel="time")
        axis.legend(fontsize=8)
    for row in single:
        words = "compensated" if row["compensated"] else "not compensated"
        color = "C0" if row["problem"] == names[0] else "C3"
        style = dict(color=color, linestyle="-" if row["compensated"] else ":")
        draw(axes[3], row, f"{row['problem']}, {words}", **style)
    axes[3].set(title="RATTLE 2 in single precision: error of positions", xlabel="time")
    axes[3].legend(fontsize=8)
    for axis in axes:
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    evaluations: Annotated[
        int, typer.Option(min=16_000, help="Of forces, in a mechanism.")
    ] = 1_000_000,
    quick: Annotated[bool, typer.Option(help="Without the top, and two methods.")] = False,
) -> None:
    """Measure long runs of mechanisms."""
    use_one_core()
    use_double_precision()
    mechanisms = (pendulum,) if quick else (pendulum, top)
    rows = []
    for build in (*mechanisms, planet):
        task = build()
        rows += [
            constant_steps(task, method, evaluations)
            for method in list(task.methods)[:: 4 if quick else 1]
        ]
        rows.append(by_scipy(task, evaluations))
    single = [row for build in mechanisms for row in single_precision(build, evaluations)]
    console = make_console()
    console.print(table(rows))
    console.print(table(single))
    if json is not None:
        settings = dict(evaluations=evaluations, tolerance=TOLERANCE)
        write_json(
            json,
            dict(environment=environment(), settings=settings, rows=rows, single_precision=single),
        )
    if plot is not None:
        write_figure(plot, rows, single)


if __name__ == "__main__":
    typer.run(main)
