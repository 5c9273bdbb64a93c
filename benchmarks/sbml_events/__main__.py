"""Cases with events of the SBML semantic test suite, against the published results.

`python -m benchmarks.sbml_events --gradients --json FILE`

For each: the largest difference from the published values in units of the tolerance of the suite (at most 1
passes), steps and resets; with `--gradients` the derivative of the observed values by all parameters and
initial values, in reverse mode against forward mode. A Boolean trigger that depends on the state has none.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

from ..tools.measure import environment, make_console, use_double_precision, write_json
from .cases import build, excess, read


@dataclasses.dataclass(frozen=True)
class Row:
    """What one case gave; `modes` is the relative difference of the two modes, `None` without derivative."""

    number: str
    algebraic: bool
    result: int
    excess: float
    resets: int
    nondifferentiable: int
    steps: int
    modes: float | None


def run(case: dict[str, Any], with_gradients: bool) -> Row:
    problem, ts = build(case), jnp.asarray(case["times"])
    sol = jax.jit(lambda y0, args: problem.solve(y0, args, ts))(problem.y0, problem.args)
    return Row(
        case["number"],
        bool(case["algebraic"]),
        int(jax.tree.leaves(sol.result)[0]),
        excess(case, np.asarray(sol.ys)),
        int(sol.resets.number),
        int(sol.stats["num_nondifferentiable_resets"]),
        int(sol.stats["num_steps"]),
        difference_of_modes(problem, ts, sol.ys) if with_gradients else None,
    )


def difference_of_modes(problem: Any, ts: jax.Array, ys: jax.Array) -> float | None:
    """Return how far the derivatives in both modes are apart, along a random direction."""
    scale = jnp.where(jnp.isfinite(ys), jnp.maximum(jnp.max(jnp.abs(ys), axis=0), 1e-12), jnp.inf)
    weights = jax.random.normal(jax.random.key(0), ys.shape) / scale

    def value(given: Any) -> jax.Array:
        found = problem.solve(*given, ts).ys
        return jnp.sum(jnp.where(jnp.isfinite(ys), found, 0.0) * weights)

    given = (problem.y0, problem.args)
    direction = jax.tree.map(
        lambda x: jnp.where(jnp.isfinite(x), jnp.maximum(abs(x), 1e-3), 0.0), given
    )
    try:
        gradient = jax.jit(jax.grad(value))(given)
        forward = jax.jit(lambda x: jax.jvp(value, (x,), (direction,))[1])(given)
    except RuntimeError as error:
        if "has no derivative" in str(error):
            return None
        raise
    products = [
        jnp.sum(jnp.where(d == 0, 0, g) * d)
        for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)
    ]
    size = max(1.0, float(jnp.sum(jnp.abs(jnp.stack(products)))))
    return abs(float(sum(products) - forward)) / size


def main(
    numbers: Annotated[str, typer.Option(help="Cases, separated by commas; all by default.")] = "",
    gradients: Annotated[bool, typer.Option(help="Compare the modes of differentiation.")] = False,
    json: Annotated[Path | None, typer.Option(help="Where to write the results.")] = None,
) -> None:
    use_double_precision()
    cases = read()
    chosen = numbers.split(",") if numbers else sorted(cases)
    table = Table("case", "excess", "resets", "steps", "modes", title="SBML test suite, events")
    rows = []
    for number in chosen:
        row = run(cases[number], gradients)
        rows.append(row)
        modes = "" if row.modes is None else f"{row.modes:.1e}"
        table.add_row(number, f"{row.excess:.2g}", str(row.resets), str(row.steps), modes)
        jax.clear_caches()
    console = make_console()
    console.print(table)
    passed = [row for row in rows if row.result == 0 and row.excess <= 1]
    console.print(f"{len(passed)} of {len(rows)} cases within the tolerance of the suite")
    if json is not None:
        found = [dataclasses.asdict(row) for row in rows]
        write_json(json, {"environment": environment(), "rows": found})


if __name__ == "__main__":
    typer.run(main)
