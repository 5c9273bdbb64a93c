"""Sparse and dense accelerations against the width of the band: where `structure="auto"` changes over.

`python -m benchmarks.speed.bandwidths --json benchmarks/results/bandwidths.json`

Equations `i` in `w` neighbouring coordinates, from `i` on, with unit masses.
"""

import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    compiled,
    environment,
    make_console,
    number,
    use_double_precision,
    use_one_core,
    write_json,
)


CASES = ((16, 2), (32, 2), (32, 5), (96, 4), (96, 8), (96, 16), (96, 32), (384, 16), (384, 64))


def case(equations: int, width: int, repeats: int) -> dict[str, Any]:
    def constraint(t, q, args):
        part = lambda k: jnp.cos(0.3 * k) * jnp.sin((1 + k) * q[k : k + equations])
        return sum(map(part, range(width)))

    q = jnp.asarray(np.random.default_rng(0).normal(size=equations + width))
    row: dict[str, Any] = dict(equations=equations, width=width)
    results = []
    for structure in ("dense", "sparse"):
        system = mj.MechanicalSystem(1.0, constraint, lambda t, q, v, args: -q, structure=structure)
        evaluate = lambda q, s=system: s.accelerations(0.0, (q, q))
        run, seconds = compiled(evaluate, q)
        results.append(np.asarray(run()))
        times = []
        for _ in range(repeats):
            start = time.process_time()
            jax.block_until_ready(run())
            times.append(1e3 * (time.process_time() - start))
        row |= {f"{structure}_ms": min(times), f"{structure}_compile_s": seconds.process_s}
    difference = np.max(np.abs(results[0] - results[1])) / np.max(np.abs(results[0]))
    return {**row, "difference": float(difference)}


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 15,
) -> None:
    """Measure one evaluation of the accelerations."""
    use_one_core()
    use_double_precision()
    rows = [case(equations, width, repeats) for equations, width in CASES]
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(number(value, ".3g") for value in row.values()))
    make_console().print(table)
    if json is not None:
        write_json(json, {"environment": environment(), "rows": rows})


if __name__ == "__main__":
    typer.run(main)
