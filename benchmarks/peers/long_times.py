"""A million steps: RATTLE and symmetric projection, projected Runge-Kutta methods and SciPy; and what is left of
single precision.

`python -m benchmarks.peers.long_times --json benchmarks/results/long_times.json --plot benchmarks/results/long_times.png`

RATTLE and the projected methods evaluate the forces of a mechanism a million times, over the same time; SciPy has a
tolerance, and a tenth of the time for mechanisms whose equations take it long. Errors of positions are those at the first
of 1000 saved times. The trend of a conserved quantity is the slope of the means of 20 parts of the run, with its standard
error.
"""

import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
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
from ._long_time_body import quaternion_top
from ._long_time_molecule import molecule
from ._long_time_picture import write_figure
from ._long_time_planets import planet, solar_system
from ._long_time_rods import chain, pendulum, spherical_pendulum, top
from ._long_time_single import single_precision
from ._long_time_task import Task


SAMPLES = 1000
PARTS = 20
TOLERANCE = 1e-8  # of SciPy
QUANTITIES = ("energy", "angular momentum", "linear momentum")
MECHANISMS = (pendulum, spherical_pendulum, chain, top, quaternion_top, solar_system, molecule)
IN_SINGLE_PRECISION = (pendulum, top)


def row(task: Task, method: str, times: Any, states: Any, seconds: float, **more: Any) -> dict:
    """Summarize states at `times`; the samples are for the picture. The error is that of the positions at the
    first time."""
    q, v = states
    start = tuple(np.asarray(leaf) for leaf in task.y0)
    changes = {name: of(q, v) - of(*start) for name, of in task.conserved.items()}
    observed = changes[task.observed]
    means = [mean(part) for part in np.array_split(observed, PARTS)]
    middles = [mean(part) for part in np.array_split(times, PARTS)]
    (slope, _), covariance = np.polyfit(middles, means, 1, cov=True)
    out = dict(problem=task.name, method=method, **more, seconds=seconds)
    out["error"] = float(np.abs(q[0] - reference(task, float(times[0]))).max())
    for name in QUANTITIES:
        change = changes.get(name)
        out[name] = None if change is None else float(np.abs(change).max())
    out |= dict(
        observed=task.observed, trend=float(slope), trend_noise=float(np.sqrt(covariance[0, 0]))
    )
    out["violation"] = float(task.violation(q, v).max())
    largest = [float(np.abs(part).max()) for part in np.array_split(observed, 5 * PARTS)]
    return out | dict(end=float(times[-1]), samples=largest)


REFERENCES: dict[tuple[str, float], np.ndarray] = {}


def reference(task: Task, t: float) -> np.ndarray:
    """Return positions at `t` by SciPy, from equations of their own, at the tightest tolerance."""
    if (task.name, t) not in REFERENCES:
        options = dict(method="DOP853", rtol=1e-13, atol=1e-13)
        sol = solve_ivp(task.field, (0, t), as_vector(task.y0), **options)
        REFERENCES[task.name, t] = sol.y[: sol.y.shape[0] // 2, -1].reshape(task.y0[0].shape)
    return REFERENCES[task.name, t]


def as_vector(y: Any) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in y])


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
    """DOP853 without corrections."""
    times = task.share * task.step * evaluations * np.arange(1, SAMPLES + 1) / SAMPLES
    options = dict(method="DOP853", rtol=TOLERANCE, atol=TOLERANCE, t_eval=times)
    start = time.process_time()
    sol = solve_ivp(task.field, (0, times[-1]), as_vector(task.y0), **options)
    seconds = time.process_time() - start
    shape = (-1, *task.y0[0].shape)
    states = tuple(part.T.reshape(shape) for part in np.split(sol.y, 2))
    more = dict(step=None, steps=None)  # they vary
    return row(task, "SciPy DOP853", times, states, seconds, **more)


def by_jax_md(task: Task, evaluations: int) -> dict[str, Any] | None:
    """Return a row of the molecule as a rigid body of jax-md, or nothing where that is not installed."""
    try:
        from ._jax_md import run_molecule
    except ModuleNotFoundError as error:
        make_console().print(f"without jax-md: {error}")
        return None
    every = evaluations // SAMPLES
    run = run_molecule(task.step, every, SAMPLES)
    start = time.process_time()
    states = jax.block_until_ready(run())
    seconds = time.process_time() - start
    states = tuple(np.asarray(leaf) for leaf in states)
    times = task.step * every * np.arange(1, SAMPLES + 1)
    more = dict(step=task.step, steps=every * SAMPLES)
    return row(task, "jax-md", times, states, seconds, **more)


def table(rows: list[dict[str, Any]]) -> Table:
    names = [name for name in rows[0] if name not in ("samples", "end", "observed")]
    out = Table(*names)
    text = lambda x: str(x) if isinstance(x, str | bool) else number(x, ".3g")
    for row in rows:
        out.add_row(*(text(row[name]) for name in names))
    return out


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    evaluations: Annotated[
        int, typer.Option(min=16_000, help="Of forces, in a mechanism.")
    ] = 1_000_000,
    quick: Annotated[bool, typer.Option(help="Two problems, and two methods.")] = False,
) -> None:
    """Measure long runs of mechanisms."""
    use_one_core()
    use_double_precision()
    mechanisms = (pendulum,) if quick else MECHANISMS
    rows = []
    for build in (*mechanisms, planet):
        task = build()
        rows += [
            constant_steps(task, method, evaluations)
            for method in list(task.methods)[:: 4 if quick else 1]
        ]
        rows.append(by_scipy(task, evaluations))
        if build is molecule:
            rows += [row for row in (by_jax_md(task, evaluations),) if row]
    singles = [build for build in IN_SINGLE_PRECISION if build in mechanisms]
    single = [row for build in singles for row in single_precision(build, evaluations)]
    console = make_console()
    console.print(table(rows))
    console.print(table(single))
    if json is not None:
        settings = dict(evaluations=evaluations, tolerance=TOLERANCE)
        write_json(
            json,
            dict(
                environment=environment("jax-md"),
                settings=settings,
                rows=rows,
                single_precision=single,
            ),
        )
    if plot is not None:
        write_figure(plot, rows, single)


if __name__ == "__main__":
    typer.run(main)
