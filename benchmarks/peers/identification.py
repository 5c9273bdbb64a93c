"""Ten numbers of a delta robot from noisy data, by `mj.fit`, by `mujoco.sysid`, and by SciPy with our solves.

`python -m benchmarks.peers.identification --json FILE --plot FILE`

All get the same data, unknowns and guess, 10 to 20 % off, and run on one core. Needs `pip install
"mujoco[sysid]"` for its rows; steps of 1 and 0.25 ms, other settings as in `mechanisms_mujoco`. Coverage is of
further draws of the noise, with fits that begin at the first one's result.
"""

import dataclasses
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    number,
    use_double_precision,
    use_one_core,
    write_json,
)
from . import _identification_task as task
from ._identification_mujoco import WithMujoco
from ._identification_picture import draw


DRAWS = 20
NORMAL = 1.96  # 95 % of errors are smaller, in standard errors
TOLERANCE = 1e-8  # of `mj.fit` by default
DIFFERENCE = 1e-5  # relative, for SciPy
REPORTED = {"SciPy": "by hand, from its Jacobian"}


@dataclasses.dataclass(frozen=True)
class Fitted:
    """An unknown: its true value, the estimate, its error in percent and in standard errors."""

    method: str
    name: str
    true: float
    fitted: float
    percent: float
    standard_error: float
    errors_away: float


@dataclasses.dataclass(frozen=True)
class Row:
    """A method: the largest errors of its ten unknowns, reduced chi squared, trajectories computed (for
    differences, too) and Jacobians, seconds of the first fit and of the same again, which compiles nothing; of `draws` of
    the noise, how many of all estimates lie within 1.96 standard errors, and seconds of each."""

    method: str
    standard_errors: str
    percent: float
    errors_away: float
    chi_squared: float
    trajectories: int
    jacobians: int
    first_s: float
    again_s: float
    draws: int
    within: int
    draw_s: float | None


Method = Callable[[np.ndarray, np.ndarray], task.Estimates]


def with_fit(data: np.ndarray, guess: np.ndarray) -> task.Estimates:
    begin = time.perf_counter()
    found = mj.fit(
        task.SYSTEM,
        task.unknowns(guess),
        task.TS,
        data,
        y0=task.state_at_start,
        t0=0.0,
        observe=task.observe,
        sigma=np.broadcast_to(task.SIGMA, data.shape),
    )
    flat = lambda tree: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])
    values, errors, steps = flat(found.parameters), flat(found.standard_errors), len(found.history)
    seconds = time.perf_counter() - begin
    # Every step computes both at once, and so does the look at the guess.
    return task.Estimates(values, errors, found.reduced_chi_squared, 0, steps + 1, seconds)


def with_scipy(data: np.ndarray, guess: np.ndarray) -> task.Estimates:
    """Differences of compiled solves."""
    begin, count = time.perf_counter(), 0

    def residual(x: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        found = task.predict(jnp.asarray(guess * x), jnp.asarray(TOLERANCE), dfx.Tsit5())
        return ((np.asarray(found) - data) / task.SIGMA).ravel()

    found = scipy.optimize.least_squares(residual, np.ones(guess.size), diff_step=DIFFERENCE)
    chi_squared = 2 * found.cost / (data.size - guess.size)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    errors = guess * np.sqrt(np.diagonal(covariance))
    seconds = time.perf_counter() - begin
    return task.Estimates(guess * found.x, errors, chi_squared, count, found.njev, seconds)


def methods() -> dict[str, tuple[Method, int]]:
    """With the number of draws for each: as many as take minutes."""
    found: dict[str, tuple[Method, int]] = {
        "mj.fit": (with_fit, DRAWS),
        "SciPy": (with_scipy, DRAWS),
    }
    if has_sysid():
        found["mujoco.sysid, 1 ms"] = WithMujoco(1e-3), DRAWS
        found["mujoco.sysid, 0.25 ms"] = WithMujoco(2.5e-4), 1
    return found


def has_sysid() -> bool:
    """It hides what it lacks: then its functions are missing."""
    if importlib.util.find_spec("mujoco") is None:
        return False
    from mujoco import sysid

    return hasattr(sysid, "optimize")


def measure(name: str, method: Method, draws: int, exact: np.ndarray) -> tuple[Row, list]:
    """The row, and the estimates of all draws."""
    data = task.measured(exact, 0)
    first = again = method(data, task.GUESS)
    if not isinstance(method, WithMujoco):  # which compiles nothing
        again = method(data, task.GUESS)
    begin = time.perf_counter()
    others = [method(task.measured(exact, k), first.values) for k in range(1, draws)]
    each = (time.perf_counter() - begin) / len(others) if others else None
    away = np.abs([estimates.away for estimates in (first, *others)])
    row = Row(
        name,
        REPORTED.get(name, "yes"),
        float(np.max(np.abs(first.values / task.TRUE - 1))) * 100,
        float(np.max(away[0])),
        first.chi_squared,
        first.trajectories,
        first.jacobians,
        first.seconds,
        again.seconds,
        draws,
        int(np.sum(away <= NORMAL)),
        each,
    )
    return row, [first, *others]


def details(name: str, estimates: task.Estimates) -> list[Fitted]:
    return [
        Fitted(name, unknown, *map(float, (true, value, 100 * (value / true - 1), error, away)))
        for unknown, true, value, error, away in zip(
            task.NAMES,
            task.TRUE,
            estimates.values,
            estimates.errors,
            estimates.away,
            strict=True,
        )
    ]


def conditions(exact: np.ndarray) -> dict[str, float]:
    """Of the Fisher matrix: in unknowns relative to their true values, and with a unit diagonal."""
    one = lambda x: task.predict(jnp.asarray(task.TRUE * x), jnp.asarray(1e-10), dfx.Dopri8())
    columns = []
    for unit in 1e-4 * np.eye(task.TRUE.size):
        columns.append(((one(1 + unit) - one(1 - unit)) / 2e-4 / task.SIGMA).ravel())
    J = np.stack(columns, axis=1)
    scaled = J / np.linalg.norm(J, axis=0)
    cond = lambda J: float(np.linalg.cond(J.T @ J))
    return {"relative": cond(J), "unit_diagonal": cond(scaled)}


def result_table(rows: list[Row]) -> Table:
    title = f"Ten unknowns of a delta robot; coverage of {NORMAL} standard errors"
    table = Table(title=title, title_justify="left")
    table.add_column("method", no_wrap=True)
    for heading in (
        "largest error, %",
        "in standard errors",
        "chi^2",
        "trajectories",
        "Jacobians",
        "first, s",
        "again, s",
        "covered",
        "each, s",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        shown = (
            f"{row.percent:.3f}",
            f"{row.errors_away:.2f}",
            f"{row.chi_squared:.3f}",
            str(row.trajectories),
            str(row.jacobians),
            number(row.first_s, ".3g"),
            number(row.again_s, ".3g"),
            f"{row.within} of {row.draws * task.TRUE.size}",
            number(row.draw_s, ".3g"),
        )
        table.add_row(row.method, *shown)
    return table


def fit_table(fitted: list[Fitted]) -> Table:
    """Errors of each unknown in percent, and in standard errors."""
    names = list(dict.fromkeys(row.method for row in fitted))
    title = "Errors, % (in standard errors)"
    table = Table(title=title, title_justify="left")
    for heading in ("unknown", "true", *names):
        table.add_column(heading, justify="right")
    for unknown, true in zip(task.NAMES, task.TRUE, strict=True):
        own = [row for row in fitted if row.name == unknown]
        shown = [f"{row.percent:+.4f} ({row.errors_away:+.2f})" for row in own]
        table.add_row(unknown, f"{true:g}", *shown)
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
) -> None:
    """Fit ten unknowns of a delta robot with all programs that are installed."""
    use_one_core()
    use_double_precision()
    console = make_console()
    exact = task.exact()
    condition, agreement = conditions(exact), None
    if has_sysid():
        difference = np.abs(WithMujoco(5e-5).predict(task.TRUE) - exact) / task.SIGMA
        agreement = float(np.max(difference))
        console.print(
            f"MuJoCo with steps of 0.05 ms differs from the data by {agreement:.1e} sigma."
        )
    else:
        console.print('`pip install "mujoco[sysid]"` is missing: its rows are left out.')
    console.print(f"Condition of the Fisher matrix: {condition}")
    rows, fitted, draws = [], [], {}
    for name, (method, count) in methods().items():
        row, estimates = measure(name, method, count, exact)
        rows.append(row)
        fitted += details(name, estimates[0])
        draws[name] = [found.away.tolist() for found in estimates]
        console.print(f"{name}: {row.first_s:.3g} s, then {row.again_s:.3g} s")
    console.print(result_table(rows))
    console.print(fit_table(fitted))
    if plot is not None:
        draw(draws, plot)
    if json is not None:
        as_dict = lambda found: [dataclasses.asdict(row) for row in found]
        content: dict[str, Any] = {
            "rows": as_dict(rows),
            "fitted": as_dict(fitted),
            "errors_away_of_draws": draws,
            "condition_of_fisher_matrix": condition,
            "mujoco_and_data_in_sigma": agreement,
        }
        write_json(json, {"environment": environment("mujoco"), **content})


if __name__ == "__main__":
    typer.run(main)
