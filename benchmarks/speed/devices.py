"""Ensembles on several devices: each core of a CPU as one, next to all trajectories on one of them.

`python -m benchmarks.speed.devices --json benchmarks/results/devices.json`

Double pendulums with masses of their own, projected Tsit5, rtol = atol = 1e-6, in one process.
"""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.table import Table

from ..tools.measure import environment, interleaved, make_console, use_double_precision, write_json
from . import _double_pendulum as double_pendulum


TOLERANCE, LANES = 1e-6, 128


@dataclasses.dataclass(frozen=True)
class Row:
    devices: int
    ms: float
    low_ms: float
    high_ms: float
    speed_up: float
    difference: float  # from one device


def measure(size: int, repeats: int) -> list[Row]:
    given, most = double_pendulum.pendulums(size), jax.device_count()
    runs = {"1": double_pendulum.ensemble(given, LANES, TOLERANCE)}
    for k in range(2, most + 1):
        mesh = jax.make_mesh((k,), ("trajectories",), devices=jax.devices()[:k])
        runs[str(k)] = double_pendulum.ensemble(given, LANES, TOLERANCE, mesh)
    timings, ends = interleaved(runs, repeats), {name: run().ys for name, run in runs.items()}
    return [
        Row(
            int(name),
            t.median_ms,
            t.low_ms,
            t.high_ms,
            timings["1"].median_ms / t.median_ms,
            max(np.abs(a - b).max() for a, b in zip(ends[name], ends["1"], strict=True)),
        )
        for name, t in timings.items()
    ]


def table_of(rows: list[Row]) -> Table:
    table = Table(title="Double pendulums on several devices", title_justify="left")
    for heading in ("devices", "ms", "quartiles", "speed-up", "difference"):
        table.add_column(heading, justify="right")
    for r in rows:
        quartiles = f"{r.low_ms:.0f}-{r.high_ms:.0f}"
        cells = str(r.devices), f"{r.ms:.0f}", quartiles, f"{r.speed_up:.2f}", f"{r.difference:.0e}"
        table.add_row(*cells)
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    size: Annotated[int, typer.Option(min=1, help="Trajectories.")] = 20_000,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 11,
) -> None:
    """Measure ensembles on one device and on as many as there are cores."""
    flag = f"--xla_force_host_platform_device_count={os.cpu_count()}"  # read when JAX starts
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    use_double_precision()
    console = make_console()
    with console.status("measuring"):
        rows = measure(size, repeats)
    console.print(table_of(rows))
    if json is not None:
        load, _, _ = os.getloadavg()
        settings = {"rtol": TOLERANCE, "lanes": LANES, "size": size, "load": load}
        content = {"environment": environment(), "settings": settings}
        write_json(json, content | {"rows": [dataclasses.asdict(row) for row in rows]})


if __name__ == "__main__":
    typer.run(main)
