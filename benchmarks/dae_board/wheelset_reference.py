"""How many digits of the wheelset's published end are right? An integration that shares nothing with this library.

`python -m benchmarks.dae_board.wheelset_reference --json benchmarks/results/jax_0.10/wheelset_reference.json`

Newton's method finds the points of contact for the position, and the accelerations with the multipliers for position
and velocity: what is left are eleven ordinary differential equations, for which SciPy's DOP853 is accurate enough at
tolerances that no DAE solver reaches. Only the equations are those of the board, `wheelset.residual`.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

from ..tools.measure import environment, make_console, use_double_precision, write_json
from .solve import Reduction
from .wheelset import contact, residual, wheelset


TOLERANCES = 1e-10, 1e-12
NAMES = "p", "v", "rate", "force"
ITERATIONS = 8
ACCELERATION = 100.0  # puts the rows of the contacts on the scale of the others


@dataclasses.dataclass(frozen=True)
class Row:
    """Positions, velocities and multipliers at the end, and their largest relative differences from the published ones
    and from the integration with the smallest tolerance."""

    method: str
    tolerance: float
    evaluations: int
    seconds: float
    contact_speed: float
    end: list[float]
    from_published: float = np.nan
    from_reference: float = np.nan


def main(
    tolerances: Annotated[
        str, typer.Option(help="Of DOP853, separated by commas, falling")
    ] = ",".join(map(str, TOLERANCES)),
    t1: float = 10.0,
    json: Annotated[Path | None, typer.Option(help="Write the results to this file")] = None,
) -> None:
    """Integrate the wheelset independently."""
    use_double_precision()
    console = make_console()
    rows = [integrate(float(tolerance), t1) for tolerance in tolerances.split(",")]
    reference = np.array(rows[-1].end)
    rows.append(by_rosenbrock(t1))
    published = np.concatenate([np.ravel(wheelset().end[name]) for name in NAMES])
    differ = lambda row, other: float(np.max(np.abs(np.array(row.end) - other) / np.abs(other)))
    rows = [
        dataclasses.replace(
            row, from_published=differ(row, published), from_reference=differ(row, reference)
        )
        for row in rows
    ]
    console.print(table(rows))
    if json is not None:
        write_json(
            json, environment() | dict(t1=t1, rows=[dataclasses.asdict(row) for row in rows])
        )


def integrate(tolerance: float, t1: float) -> Row:
    problem, begin = wheelset(), time.perf_counter()
    rates = jax.jit(lambda z: motion(z)[0])
    z0 = np.concatenate([problem.start["p"], problem.start["v"], [problem.start["rate"]]])
    field = lambda t, z: np.asarray(rates(z))
    options: dict[str, Any] = dict(rtol=tolerance, atol=1e-2 * tolerance)
    sol = solve_ivp(field, (0, t1), z0, method="DOP853", **options)
    if not sol.success:
        raise RuntimeError(sol.message)
    z = jnp.asarray(sol.y[:, -1])
    end, speed = np.append(z, motion(z)[1]), float(jnp.abs(directions(z[:5]) @ z[5:10]).max())
    return Row("DOP853", tolerance, sol.nfev, time.perf_counter() - begin, speed, end.tolist())


def by_rosenbrock(t1: float) -> Row:
    """The solution of the board: of the reduced equations, by Rodas5P."""
    begin = time.perf_counter()
    reduction = Reduction.of(wheelset())
    z0 = reduction.consistent(reduction.args)
    sol = reduction.solve(z0, reduction.args, t1)
    x = reduction.outputs(sol.ys[-1], reduction.args, t1)
    end = np.concatenate([np.ravel(x[name]) for name in NAMES])
    speed = float(jnp.abs(directions(x["p"]) @ x["v"]).max())
    steps, tolerance = int(sol.stats["num_steps"]), reduction.problem.rtol
    return Row("Rodas5P", tolerance, steps, time.perf_counter() - begin, speed, end.tolist())


def newton(residual: Callable, x: Any, iterations: int) -> Any:
    for _ in range(iterations):
        x = x - jnp.linalg.solve(jax.jacfwd(residual)(x), residual(x))
    return x


def contacts(p: Any) -> list[Any]:
    """Return the points of contact, left and right; derivatives by `p` are those of the implicit function."""
    found = []
    for side, name in ((1.0, "left"), (-1.0, "right")):
        conditions = lambda x, side=side: contact(side, p, x[0], x[1]).conditions
        x = newton(conditions, jnp.asarray(wheelset().start[name]), ITERATIONS)
        x = jax.lax.stop_gradient(x)
        slopes = jax.lax.stop_gradient(jax.jacfwd(conditions)(x))
        found.append(x - jnp.linalg.solve(slopes, conditions(x)))
    return found


def directions(p: Any) -> Any:
    """Return the directions in which the rails hold the wheels, right and left: rows on the five velocities."""
    left, right = contacts(p)
    return jnp.stack([contact(-1.0, p, *right).direction, contact(1.0, p, *left).direction])


def motion(z: Any) -> tuple[Any, Any]:
    """Return the rates of positions, velocities and spin, and the multipliers."""
    problem, p, v = wheelset(), z[:5], z[5:10]
    left, right = contacts(p)
    held, held_rate = jax.jvp(directions, (p,), (v,))

    def unbalanced(u: Any) -> Any:
        x = dict(p=p, v=v, rate=z[10], left=left, right=right, force=u[6:])
        rows = residual(0.0, x, dict(p=v, v=u[:5], rate=u[5]), problem.args)
        forces = [rows["forces"], *(rows[name][None] for name in ("yaw", "roll", "rate"))]
        return jnp.concatenate([*forces, ACCELERATION * (held @ u[:5] + held_rate @ v)])

    start = jnp.concatenate([jnp.zeros(6), jnp.asarray(problem.start["force"])])
    u = newton(unbalanced, start, ITERATIONS)
    return jnp.concatenate([v, u[:6]]), u[6:]


def table(rows: list[Row]) -> Table:
    found = Table("method", "tolerance", "evaluations or steps", "s", "speed of the contacts, m/s")
    found.add_column("from published")
    found.add_column("from DOP853 at the smallest tolerance")
    for row in rows:
        numbers = row.contact_speed, row.from_published, row.from_reference
        counts = f"{row.tolerance:.0e}", str(row.evaluations), f"{row.seconds:.0f}"
        found.add_row(row.method, *counts, *(f"{x:.1e}" for x in numbers))
    return found


if __name__ == "__main__":
    typer.run(main)
