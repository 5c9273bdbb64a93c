"""Neural vector fields whose solutions conserve what is known to be conserved.

`python -m benchmarks.peers.neural --json benchmarks/results/neural.json --plot benchmarks/results/neural.png`

The same network, data, optimizer and number of steps, trained and then solved without the
constraint, with it stabilized, and projected. Systems and laws of their data: White, Kilbertus,
Gelbrecht & Boers, Stabilized Neural Differential Equations (2023).
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, number, use_double_precision, write_json
from ._neural_systems import System, SYSTEMS, windows


WIDTH, DEPTH = 64, 2
TRAINING_ORBITS, TEST_ORBITS, TEST_SPAN = 40, 40, 100.0
# First short pieces of the orbits, then longer ones: (intervals, pieces in a batch, share of steps).
STAGES = ((3, 256, 0.6), (12, 64, 0.3), (48, 16, 0.1))
SUBSTEPS = 4
TOLERANCE = 1e-9
GAIN = 8.0
APPROACHES = ("none", "stabilized", "projected")


@dataclasses.dataclass(frozen=True)
class Row:
    """One trained network on orbits it has not seen. Errors are relative, in the Euclidean norm."""

    system: str
    approach: str
    training_s: float
    loss: float
    violation: float  # the largest of all orbits and times, relative to the conserved value
    scaled_violation: float  # the largest `mj.constraint_violation`, relative to the state's size
    median_violation: float  # of the largest of each orbit
    error: float  # median over the orbits of the mean over time
    end_error: float  # median over the orbits at the end
    escaped: int  # orbits with an error above 1 at the end, or a failed solve


def solve(system: System, approach: str, network: Any, y0: Any, ts: Any, **options) -> dfx.Solution:
    """The learned equation from `y0`, with the quantity kept that it starts with."""
    constraint = mj.Invariants(system.conserved, y0=y0)
    field, solver, diffeqsolve = system.field, dfx.Tsit5(), dfx.diffeqsolve
    if approach == "stabilized":
        gain = mj.InvariantStabilization(GAIN)
        solver, diffeqsolve = mj.Stabilized(solver, constraint, stabilization=gain), mj.diffeqsolve
    if approach == "projected":
        field = mj.tangent_field(field, constraint)
        solver, diffeqsolve = mj.Projected(solver, constraint), mj.diffeqsolve
    return diffeqsolve(
        dfx.ODETerm(field),
        solver,
        ts[0],
        ts[-1],
        y0=y0,
        args=network,
        saveat=dfx.SaveAt(ts=ts),
        throw=False,
        **options,
    )


def make_update(system: System, approach: str, length: int, optimizer: Any) -> Callable:
    """A compiled step of the optimizer on a batch of pieces of `length` intervals."""
    ts = jnp.arange(length + 1) * system.interval
    options = dict(
        dt0=system.interval / SUBSTEPS,
        stepsize_controller=dfx.ConstantStepSize(),
        max_steps=length * SUBSTEPS + 1,
    )

    def loss(network, pieces):
        end = lambda piece: solve(system, approach, network, piece[0], ts, **options).ys - piece
        return jnp.mean(jax.vmap(end)(pieces)[:, 1:] ** 2)

    @eqx.filter_jit
    def update(network, state, pieces):
        value, slope = eqx.filter_value_and_grad(loss)(network, pieces)
        updates, state = optimizer.update(slope, state)
        return eqx.apply_updates(network, updates), state, value

    return update


def train(system: System, approach: str, steps: int, seed: int) -> tuple[Any, float, float]:
    """The network, the mean loss of the last tenth of the steps, and the seconds it took."""
    begin = time.perf_counter()
    random = np.random.default_rng(seed)
    times = np.arange(0, system.span, system.interval)
    orbits = system.orbits(random, TRAINING_ORBITS, times)
    key = jax.random.PRNGKey(seed)
    network = eqx.nn.MLP(system.inputs, system.outputs, WIDTH, DEPTH, jnp.tanh, key=key)
    optimizer = optax.adam(optax.cosine_decay_schedule(3e-3, steps, alpha=1e-3))
    state = optimizer.init(eqx.filter(network, eqx.is_array))
    losses = []
    for length, batch, share in STAGES:
        pieces = windows(orbits, length)
        update = make_update(system, approach, length, optimizer)
        for _ in range(round(share * steps)):
            chosen = jnp.asarray(random.integers(0, len(pieces), batch))
            network, state, value = update(network, state, pieces[chosen])
            losses.append(value)
    return network, float(np.mean(losses[-steps // 10 :])), time.perf_counter() - begin


def measure(system: System, approach: str, steps: int, seed: int) -> tuple[Row, dict[str, Any]]:
    """Train, and solve for orbits not seen over many times the time span learned from."""
    network, loss, seconds = train(system, approach, steps, seed)
    times = np.linspace(0, TEST_SPAN, round(TEST_SPAN / system.interval) + 1)
    exact = system.orbits(np.random.default_rng(seed + 1), TEST_ORBITS, times)
    options = dict(
        dt0=0.01,
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=100_000,
    )
    one = lambda y0: solve(system, approach, network, y0, jnp.asarray(times), **options).ys
    found = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(exact[:, 0])))
    found = np.where(np.isfinite(found), found, np.nan)
    norm = lambda y: np.linalg.norm(y, axis=-1)
    error = np.nan_to_num(norm(found - exact) / norm(exact), nan=np.inf)
    kept = np.apply_along_axis(lambda y: system.conserved(0.0, y, None), 2, found)
    violation = np.nan_to_num(np.abs(kept / kept[:, :1] - 1), nan=np.inf)
    scaled = jax.jit(jax.vmap(functools.partial(scaled_violation, system, jnp.asarray(times))))
    row = Row(
        system=system.name,
        approach=approach,
        training_s=seconds,
        loss=loss,
        violation=float(violation.max()),
        scaled_violation=float(np.max(np.nan_to_num(scaled(jnp.asarray(found)), nan=np.inf))),
        median_violation=float(np.median(violation.max(axis=1))),
        error=float(np.median(error.mean(axis=1))),
        end_error=float(np.median(error[:, -1])),
        escaped=int(np.sum(error[:, -1] > 1)),
    )
    curves = dict(
        times=times, error=np.median(error, axis=0), violation=np.median(violation, axis=0)
    )
    return row, curves


def scaled_violation(system: System, times: Any, states: Any) -> Any:
    """Of one orbit; `nan` if it has not been solved to the end."""
    constraint = mj.Invariants(system.conserved, y0=states[0])
    return mj.constraint_violation(constraint, times, states)


def result_table(rows: list[Row]) -> Table:
    title = f"{TEST_ORBITS} orbits not seen, {TEST_SPAN:g} time units; errors relative"
    table = Table(title=title, title_justify="left")
    for heading in ("system", "constraint"):
        table.add_column(heading, no_wrap=True)
    headings = (
        "training, s",
        "loss",
        "violation",
        "scaled",
        "median",
        "state error",
        "at end",
        "lost",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    for row in rows:
        forms = (".0f", ".1e", ".1e", ".1e", ".1e", ".2g", ".2g", ".0f")
        values = dataclasses.astuple(row)[2:]
        table.add_row(row.system, row.approach, *map(number, values, forms))
    return table


def write_figure(path: Path, rows: list[Row], curves: list[dict[str, Any]]) -> None:
    """Errors of the state above, violations below, medians over the orbits."""
    names = list(dict.fromkeys(row.system for row in rows))
    colors = dict(zip(APPROACHES, ("#D55E00", "#009E73", "#0072B2"), strict=True))
    size = (4.5 * len(names), 5)
    figure, axes = plt.subplots(
        2, len(names), figsize=size, squeeze=False, sharex=True, layout="constrained"
    )
    for row, curve in zip(rows, curves, strict=True):
        column = axes[:, names.index(row.system)]
        for axis, key in zip(column, ("error", "violation"), strict=True):
            values = np.maximum(curve[key], 1e-17)
            axis.semilogy(
                curve["times"], values, color=colors[row.approach], label=row.approach, lw=1
            )
        column[0].set(title=row.system, ylim=(1e-5, 10))
        column[1].set(xlabel="time", ylim=(1e-17, 10))
    axes[0, 0].set(ylabel="relative error of the state")
    axes[1, 0].set(ylabel="relative violation")
    axes[0, 0].legend(frameon=False)
    figure.savefig(path, dpi=120)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw them here.")] = None,
    systems: Annotated[str, typer.Option(help=f"Of {', '.join(SYSTEMS)}.")] = ",".join(SYSTEMS),
    steps: Annotated[int, typer.Option(min=10, help="Steps of the optimizer.")] = 10_000,
    seed: Annotated[int, typer.Option(help="Of data and network.")] = 0,
) -> None:
    """Train and compare; with the default number of steps forty minutes."""
    use_double_precision()
    console = make_console()
    rows, curves = [], []
    for name in systems.split(","):
        for approach in APPROACHES:
            with console.status(f"{name}, {approach}"):
                row, curve = measure(SYSTEMS[name], approach, steps, seed)
            console.print(
                f"{name}, {approach}: {row.training_s:.0f} s, state error {row.error:.2g}"
            )
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
            stages=STAGES,
            steps=steps,
            seed=seed,
            gain=GAIN,
            tolerance=TOLERANCE,
        )
        content = [dataclasses.asdict(row) for row in rows]
        packages = environment("optax")
        write_json(json, {"settings": settings, "environment": packages, "rows": content})


if __name__ == "__main__":
    typer.run(main)
