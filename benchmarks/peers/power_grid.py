"""A short circuit in the IEEE 14-bus system: angles of the machines beside ANDES and SciPy, and when they fall out of step.

`python -m benchmarks.peers.power_grid --json FILE --plot FILE`

Differential equations of five machines and algebraic ones of the network, written as residuals. A short circuit at bus 2
is switched on and off at given times. The longest after which the machines stay in step, the critical clearing time, is
found by root finding, with its derivatives by the inertias.
"""

import dataclasses
import functools
import itertools
import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import manifold_jax as mj

from ..tools.measure import environment, make_console, use_double_precision, write_json
from . import _power_grid_andes as andes
from ._power_grid_model import FAULT_REACTANCE, MACHINE_UNKNOWNS
from ._power_grid_task import BUS, CLEARING, critical_times, OUT_OF_STEP, START, Task


LAST = 2.0
TS = np.linspace(0.0, LAST, 81)
STEPS = (4e-3, 1e-3, 2.5e-4, 1.25e-4)  # of ANDES
TOLERANCES = (1e-4, 1e-6, 1e-8)


@dataclasses.dataclass(frozen=True)
class Row:
    """`error` is that of the angles (rad) at all output times, for ANDES their difference; `violation` the
    largest residual of the network's equations (per unit). SciPy solves them exactly in every evaluation."""

    method: str
    setting: float
    steps: int
    seconds: float
    compile_s: float | None
    error: float
    violation: float | None


def by_scipy(task: Task, method: str, tolerance: float) -> tuple[np.ndarray, int, float]:
    """Return angles, steps and seconds of SciPy, restarted at both switching times, voltages eliminated by hand."""
    start = {name: task.grid.start[name] for name in MACHINE_UNKNOWNS}
    flat, unflatten = jfu.ravel_pytree(start)

    @functools.partial(jax.jit, static_argnums=1)
    def field(y: Any, fault: float) -> Any:
        rates = task.grid.derivatives(unflatten(y), fault, task.machines)
        return jfu.ravel_pytree(rates)[0]

    for fault in (0.0, 1.0):
        field(flat, fault)
    begin = time.perf_counter()
    y, steps, angles = np.asarray(flat), 0, np.empty((TS.size, task.machines.M.size))
    edges = (0.0, *task.parameters.times, LAST)
    for number, (t0, t1) in enumerate(itertools.pairwise(edges)):
        right = lambda t, y, fault=float(number == 1): np.asarray(field(y, fault))
        sol = solve_ivp(
            right, (t0, t1), y, method=method, rtol=tolerance, atol=tolerance, dense_output=True
        )
        y, steps = sol.y[:, -1], steps + sol.t.size - 1
        inside = (t0 <= TS) & (t1 >= TS)
        angles[inside] = [unflatten(jnp.asarray(row))["delta"] for row in sol.sol(TS[inside]).T]
    return angles, steps, time.perf_counter() - begin


def compare(task: Task, stiff: Task) -> list[Row]:
    """Return rows of this library and of SciPy, with errors against SciPy's DOP853 at 1e-12."""
    projected = mj.Projected(dfx.Dopri8(), task.dae.constraint)
    best, *_ = by_scipy(task, "DOP853", 1e-12)
    rows = []
    for name, of, solver in (
        ("projected Dopri8", task, projected),
        ("Rodas5P", stiff, mj.Rodas5P()),
    ):
        function = jax.jit(
            lambda tolerance, of=of, solver=solver: of.angles(solver, of.parameters, TS, tolerance)
        )
        begin = time.perf_counter()
        run = function.lower(1e-6).compile()
        compile_s = time.perf_counter() - begin
        for tolerance in TOLERANCES:
            jax.block_until_ready(run(tolerance))
            begin = time.perf_counter()
            angles, violation, steps = jax.block_until_ready(run(tolerance))
            seconds = time.perf_counter() - begin
            error = float(np.abs(angles - best).max())
            rows.append(
                Row(name, tolerance, int(steps), seconds, compile_s, error, float(violation))
            )
    for method in ("DOP853", "Radau"):
        for tolerance in TOLERANCES:
            angles, steps, seconds = by_scipy(task, method, tolerance)
            error = float(np.abs(angles - best).max())
            rows.append(Row(f"SciPy {method}", tolerance, steps, seconds, None, error, None))
    return rows


def beside_andes(task: Task) -> list[Row]:
    """Return rows of ANDES, whose angles are compared at its own times."""
    solver = mj.Projected(dfx.Dopri8(), task.dae.constraint)
    times = (START, START + CLEARING)
    rows = []
    for step in STEPS:
        ts, found, seconds, steps = andes.solve(BUS, times, LAST, step, FAULT_REACTANCE)
        away = np.min(np.abs(ts[:, None] - np.array(times)), axis=1) > 1e-3
        chosen = np.flatnonzero(away)[:: round(8e-3 / step)]
        angles, *_ = task.angles(solver, task.parameters, ts[chosen], 1e-12)
        error = float(np.abs(found[chosen] - angles).max())
        rows.append(Row("ANDES, trapezoidal rule", step, steps, seconds, None, error, None))
    return rows


def critical_by_andes(later: float, step: float) -> float:
    """Return the same clearing time by ANDES, from its simulations alone."""

    def excess(clearing: float) -> float:
        times = (START, START + clearing)
        _, angles, *_ = andes.solve(BUS, times, times[1] + later, step, FAULT_REACTANCE)
        return float(np.ptp(angles[-1]) - OUT_OF_STEP)

    return brentq(excess, 0.24, 0.247, xtol=1e-6)  # it does not reach the end after 0.3 s


def show(console: Any, rows: list[Row], critical: dict[str, Any]) -> None:
    table = Table("method", "setting", "steps", "s", "to compile, s", "error, rad", "violation")
    text = lambda value, form: "" if value is None else format(value, form)
    for row in rows:
        setting, error = f"{row.setting:.0e}", f"{row.error:.1e}"
        compile_s, violation = text(row.compile_s, ".1f"), text(row.violation, ".0e")
        table.add_row(
            row.method, setting, str(row.steps), f"{row.seconds:.3f}", compile_s, error, violation
        )
    console.print(table)
    for name, value in critical.items():
        console.print(name, value)


def draw(task: Task, rows: list[Row], critical: dict[str, Any], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    solver = mj.Projected(dfx.Dopri8(), task.dae.constraint)
    run = jax.jit(lambda p: task.angles(solver, p, TS, 1e-8)[0])
    for shift, color in ((-0.05, "C0"), (-0.001, "C2"), (0.001, "C3")):
        times = np.array([START, START + critical["clearing"] + shift])
        delta = np.asarray(run(task.parameters._replace(times=times)))
        label = f"cleared after {1e3 * (critical['clearing'] + shift):.0f} ms"
        left.plot(TS, np.degrees(delta[:, 0] - delta[:, 1:].mean(axis=1)), color, label=label)
    left.axvspan(START, START + critical["clearing"], color="0.9", label="short circuit")
    left.set(xlabel="time, s", ylabel="machine 1 ahead of the others, degrees", ylim=(0, 360))
    left.legend()
    for name in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == name]
        right.loglog([row.seconds for row in own], [row.error for row in own], "o-", label=name)
    right.set(xlabel="time of a solve, s", ylabel="largest error of an angle, rad")
    right.legend()
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw them here.")] = None,
) -> None:
    """Simulate the short circuit by all programs, and find the critical clearing time."""
    use_double_precision()
    console = make_console()
    task = Task("ode")
    rows = compare(task, Task("index-1"))
    critical = critical_times(task)
    try:
        rows += beside_andes(task)
        critical["andes"] = {step: critical_by_andes(2.0, step) for step in (2e-3, 1e-3)}
    except ImportError:
        console.print('ANDES is left out: `pip install "manifold_jax\\[peers]"`.')
    show(console, rows, critical)
    if json is not None:
        content = {"rows": [dataclasses.asdict(row) for row in rows], "critical": critical}
        write_json(json, {"environment": environment("andes"), **content})
    if plot is not None:
        draw(task, rows, critical, plot)


if __name__ == "__main__":
    typer.run(main)
