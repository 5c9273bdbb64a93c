"""Does the device that JAX finds compute the same as the CPU of the same machine?

`python -m benchmarks.speed.devices_agree --json benchmarks/results/devices_agree.json`

Batches of solves in double precision, each with parameters of its own: the values, the numbers of steps and the largest
violation of the constraint at saved values; the derivatives with respect to a change of all parameters, in reverse
mode by replay and by Diffrax's adjoint, and in forward mode. The routines of LAPACK that the library uses are
compared with NumPy, in batches of all kinds. On a CPU all differences but those from NumPy are zero.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, number, use_double_precision, write_json
from ._devices_cases import Case, CASES
from ._devices_lapack import errors


MATRICES = "matrices"
# Of routines for matrices, relative, next to NumPy.
MATRIX_TOLERANCE = 1e-11
# Times the tolerance of a case: of its derivatives.
OF_DERIVATIVES = 100
LARGEST_VIOLATION = 1e-11
ADJOINTS = {
    "replay": mj.StepReplayAdjoint(),
    "Diffrax's adjoint": dfx.RecursiveCheckpointAdjoint(),
    "forward": dfx.ForwardMode(),
}


@dataclasses.dataclass(frozen=True)
class Row:
    case: str
    what: str
    size: float | None  # the largest value
    difference: float  # from the CPU, the largest, relative to `size`
    tolerance: float
    violation: float | None
    other_steps: int | None  # trajectories with another number of steps than on the CPU
    agrees: bool


def programs(case: Case) -> dict[str, Callable]:
    """Functions of all changes."""

    def each(changes: Any, adjoint: Any) -> Any:
        of_one = lambda change: case.solve(change, adjoint)
        return case.solve(changes, adjoint) if case.of_all else jax.vmap(of_one)(changes)

    found: dict[str, Callable] = {"values": lambda c: each(c, ADJOINTS["replay"])}

    def total(changes: Any, adjoint: Any) -> Any:
        leaves = jtu.tree_leaves(each(changes, adjoint).values)
        # Weights, so that the derivatives of invariants do not cancel.
        weighted = [jnp.sum(x * jnp.cos(jnp.arange(x.size)).reshape(x.shape)) for x in leaves]
        return sum(weighted)

    def reverse(adjoint: Any) -> Callable:
        return jax.grad(lambda changes: total(changes, adjoint))

    def forward(changes: Any) -> Any:
        direction = jnp.ones_like(changes)
        values = lambda c: each(c, ADJOINTS["forward"]).values
        return jax.jvp(values, (changes,), (direction,))[1]

    found["replay"] = reverse(ADJOINTS["replay"])
    if case.has_errors and not case.of_all:  # which are in lanes with replay alone
        found["Diffrax's adjoint"] = reverse(ADJOINTS["Diffrax's adjoint"])
    return found | {"forward": forward}


def compare(name: str, case: Case, size: int) -> list[Row]:
    changes = np.linspace(-0.05, 0.05, size)
    rows = []
    for what, program in programs(case).items():
        jax.clear_caches()
        devices = jax.devices()[0], jax.devices("cpu")[0]
        here, there = (run(program, changes, device) for device in devices)
        rows.append(row_of(name, what, case.tolerance, here, there))
    return rows


def run(program: Callable, changes: np.ndarray, device: jax.Device) -> Any:
    with jax.default_device(device):
        return jtu.tree_map(np.asarray, jax.jit(program)(jnp.asarray(changes)))


def row_of(name: str, what: str, tolerance: float, here: Any, there: Any) -> Row:
    violation = other_steps = None
    if what == "values":
        violation = float(np.max(here.violation))
        other_steps = int(np.sum(here.steps != there.steps))
        here, there = here.values, there.values
    else:
        tolerance *= OF_DERIVATIVES
    pairs = list(zip(jtu.tree_leaves(here), jtu.tree_leaves(there), strict=True))
    size = max(float(np.max(np.abs(b))) for _, b in pairs)
    difference = max(float(np.max(np.abs(a - b))) for a, b in pairs) / size
    # Written so that NaN does not agree.
    agrees = difference <= tolerance and (violation is None or violation <= LARGEST_VIOLATION)
    return Row(name, what, size, difference, tolerance, violation, other_steps, agrees)


def of_matrices() -> list[Row]:
    rows = []
    for name, error in errors().items():
        agrees = error <= MATRIX_TOLERANCE
        rows.append(Row(MATRICES, name, None, error, MATRIX_TOLERANCE, None, None, agrees))
    return rows


def table_of(rows: list[Row]) -> Table:
    device = jax.devices()[0].device_kind
    table = Table(title=f"{device} next to the CPU", title_justify="left")
    table.add_column("case", no_wrap=True)
    table.add_column("what", no_wrap=True)
    for heading in ("size", "difference", "tolerance", "max |g|", "other steps", "agrees"):
        table.add_column(heading, justify="right")
    for r in rows:
        table.add_row(
            r.case,
            r.what,
            number(r.size, ".1e"),
            f"{r.difference:.0e}",
            f"{r.tolerance:.0e}",
            number(r.violation, ".0e"),
            number(r.other_steps, "d"),
            "yes" if r.agrees else "NO",
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    cases: Annotated[str, typer.Option(help="Separated by semicolons.")] = ";".join(
        (MATRICES, *CASES)
    ),
    size: Annotated[int, typer.Option(min=1, help="Of the batches.")] = 100,
) -> None:
    """Compare the device that JAX finds with the CPU; fail if they do not agree."""
    use_double_precision()
    console, rows = make_console(), []
    with console.status("comparing"):
        for name in cases.split(";"):
            rows += of_matrices() if name == MATRICES else compare(name, CASES[name](), size)
    console.print(table_of(rows))
    if json is not None:
        content = {"environment": environment(), "settings": {"size": size}}
        write_json(json, content | {"rows": [dataclasses.asdict(row) for row in rows]})
    if not all(row.agrees and math.isfinite(row.difference) for row in rows):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
