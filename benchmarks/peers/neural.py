"""Neural vector fields whose solutions conserve what is known to be conserved.

`python -m benchmarks.peers.neural --json benchmarks/results/neural.json --plot benchmarks/results/neural.png`

The same network, data, optimizer and number of iterations, trained and then solved without the
constraint, with it stabilized, and projected. Systems and laws of their data: White, Kilbertus,
Gelbrecht & Boers, Stabilized Neural Differential Equations for Learning Dynamics with Explicit Constraints,
NeurIPS 2023 (arXiv:2306.09739). Their errors are means over time of the curves in the vector graphics of their figures 2
and 4, in their public repository.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, number, use_double_precision, write_json
from ._neural_systems import System, SYSTEMS
from ._neural_training import DEPTH, GAIN, solve, train, TRAINING_ORBITS, WIDTH


TEST_ORBITS = 100
TOLERANCE = 1e-9
APPROACHES = ("none", "stabilized", "projected")


@dataclasses.dataclass(frozen=True)
class Row:
    """One trained network on orbits it has not seen. Errors are relative, in the Euclidean norm; violations are
    changes of the conserved quantities, relative to them."""

    system: str
    approach: str
    training_s: float
    loss: float
    violation: float  # the largest of all orbits and times
    scaled_violation: float  # the largest `mj.constraint_violation`, relative to the state's size
    mean_violation: float  # over orbits and times
    error: float  # mean over orbits and times
    median_error: float  # median over the orbits of the mean over time
    end_error: float  # mean over the orbits at the end
    escaped: int  # orbits with an error above 1 at the end, or a failed solve
    state_error: float  # as `error`, of the state where that is of the end of an arm
    published_error: float  # of a stabilized network, as `error`
    published_violation: float  # as `mean_violation`


def measure(system: System, approach: str, iterations: int, seed: int) -> tuple[Row, dict]:
    """Train, and solve for orbits not seen over many times the time span learned from."""
    network, loss, seconds = train(system, approach, iterations, seed)
    times = np.linspace(0, system.test_span, round(system.test_span / system.interval) + 1)
    exact = system.orbits(np.random.default_rng(seed + 1), TEST_ORBITS, times)
    options = dict(
        dt0=0.01,
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=100_000,
    )
    one = lambda y0: solve(system, approach, network, y0, jnp.asarray(times), **options).ys
    found = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(exact[:, 0])))
    found = np.where(np.isfinite(found), found, np.nan)
    error = relative(system.observed(found), system.observed(exact))
    quantity = lambda t, y: system.conserved(t, y, None)
    kept = jax.vmap(jax.vmap(quantity), (None, 0))(jnp.asarray(times), jnp.asarray(found))
    violation = relative(np.asarray(kept), np.asarray(kept[:, :1]))
    scaled = jax.jit(jax.vmap(functools.partial(scaled_violation, system, jnp.asarray(times))))
    row = Row(
        system=system.name,
        approach=approach,
        training_s=seconds,
        loss=loss,
        violation=float(violation.max()),
        scaled_violation=float(np.max(np.nan_to_num(scaled(jnp.asarray(found)), nan=np.inf))),
        mean_violation=float(violation.mean()),
        error=float(error.mean()),
        median_error=float(np.median(error.mean(axis=1))),
        end_error=float(error[:, -1].mean()),
        escaped=int(np.sum(error[:, -1] > 1)),
        state_error=float(relative(found, exact).mean()),
        published_error=system.published.error,
        published_violation=system.published.violation,
    )
    return row, dict(times=times, error=error.mean(axis=0), violation=violation.mean(axis=0))


def relative(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Error over the last axis; infinite where nothing was found."""
    norm = lambda y: np.linalg.norm(y, axis=-1)
    return np.nan_to_num(norm(found - exact) / norm(exact), nan=np.inf)


def scaled_violation(system: System, times: Any, states: Any) -> Any:
    """Of one orbit; `nan` if it has not been solved to the end."""
    constraint = mj.Invariants(system.conserved, y0=states[0])
    return mj.constraint_violation(constraint, times, states)


def result_table(rows: list[Row]) -> Table:
    title = (
        f"{TEST_ORBITS} orbits not seen; errors relative, those published of a stabilized network"
    )
    table = Table(title=title, title_justify="left")
    for heading in ("system", "constraint"):
        table.add_column(heading, no_wrap=True)
    forms = dict.fromkeys((field.name for field in dataclasses.fields(Row)[2:]), ".2g")
    forms |= dict(training_s=".0f", escaped=".0f")
    for heading in forms:
        table.add_column(heading.replace("_", " "), justify="right")
    for row in rows:
        values = dataclasses.astuple(row)[2:]
        table.add_row(row.system, row.approach, *map(number, values, forms.values()))
    return table


def write_figure(path: Path, rows: list[Row], curves: list[dict[str, Any]]) -> None:
    """Errors above, violations below, means over the orbits. Dashed: the mean over time of what is published."""
    names = list(dict.fromkeys(row.system for row in rows))
    colors = dict(zip(APPROACHES, ("#D55E00", "#009E73", "#0072B2"), strict=True))
    size = (4.5 * len(names), 5)
    figure, axes = plt.subplots(
        2, len(names), figsize=size, squeeze=False, sharex="col", layout="constrained"
    )
    for row, curve in zip(rows, curves, strict=True):
        column = axes[:, names.index(row.system)]
        for axis, key in zip(column, ("error", "violation"), strict=True):
            values = np.maximum(curve[key], 1e-18)
            axis.semilogy(
                curve["times"], values, color=colors[row.approach], label=row.approach, lw=1
            )
        column[0].set(title=row.system, ylim=(1e-18 if row.system == "arm" else 1e-6, 10))
        column[1].set(xlabel="time", ylim=(1e-18, 10))
        if row.approach == APPROACHES[-1]:
            for axis, value in zip(
                column, (row.published_error, row.published_violation), strict=True
            ):
                axis.axhline(value, color="#009E73", ls="--", lw=1, label="published, stabilized")
    axes[0, 0].set(ylabel="relative error")
    axes[1, 0].set(ylabel="relative violation")
    axes[0, 0].legend(frameon=False)
    figure.savefig(path, dpi=120)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw them here.")] = None,
    systems: Annotated[str, typer.Option(help=f"Of {', '.join(SYSTEMS)}.")] = ",".join(SYSTEMS),
    iterations: Annotated[int, typer.Option(min=1, help="Of Levenberg-Marquardt.")] = 120,
    seed: Annotated[int, typer.Option(help="Of data and network.")] = 0,
) -> None:
    """Train and compare; with the default number of iterations half an hour."""
    use_double_precision()
    console = make_console()
    rows, curves = [], []
    for name in systems.split(","):
        for approach in APPROACHES:
            with console.status(f"{name}, {approach}"):
                row, curve = measure(SYSTEMS[name], approach, iterations, seed)
            console.print(f"{name}, {approach}: {row.training_s:.0f} s, error {row.error:.2g}")
            rows.append(row)
            curves.append(curve)
    console.print(result_table(rows))
    if plot is not None:
        write_figure(plot, rows, curves)
    if json is not None:
        settings = dict(
            width=WIDTH,
            depth=DEPTH,
            training_orbits=TRAINING_ORBITS,
            test_orbits=TEST_ORBITS,
            iterations=iterations,
            seed=seed,
            gain=GAIN,
            tolerance=TOLERANCE,
        )
        content = [dataclasses.asdict(row) for row in rows]
        packages = environment()
        write_json(json, {"settings": settings, "environment": packages, "rows": content})


if __name__ == "__main__":
    typer.run(main)
