"""A pendulum that hits a wall, by this library, by a loop around Diffrax and by a loop around SciPy.

`python -m benchmarks.peers.impacts --json FILE`

Cartesian coordinates `(x, y, u, v)` of a pendulum of length 1 that is let go horizontally and loses a tenth of
its speed whenever it meets the wall at x = -0.3; ten seconds, rtol = atol = 1e-6, 1e-8, 1e-10. The loops are what
one writes by hand: a solve to a terminating event, the jump, another solve from there. The reference is
SciPy's DOP853 for the angle, restarted at impacts, at 3e-14.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.integrate
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax.problems._problem import integrate_with_resets

from ..tools.measure import (
    environment,
    interleaved,
    make_console,
    Timing,
    use_double_precision,
    write_json,
)


WALL, RESTITUTION, GRAVITY, T1 = -0.3, 0.9, 9.81, 10.0
START = (1.0, 0.0, 0.0, 0.0)
TOLERANCES = (1e-6, 1e-8, 1e-10)
MOST = 30  # impacts


def field(xp: Any, y: Any, gravity: Any) -> Any:
    q, v = y[:2], y[2:]
    pull = (v @ v - gravity * q[1]) / (q @ q)
    return xp.concatenate([v, -pull * q - xp.stack([0.0 * gravity, gravity])])


def bounced(xp: Any, y: Any) -> Any:
    return xp.concatenate([y[:2], -RESTITUTION * y[2:]])


class End(NamedTuple):
    """The state at the end, and what it took."""

    y: Any
    impacts: Any
    steps: Any


def with_resets(tolerance: float) -> Callable[[Any], End]:
    term = dfx.ODETerm(lambda t, y, gravity: field(jnp, y, gravity))
    rod = lambda t, y, gravity: jnp.stack([y[:2] @ y[:2] - 1.0, y[:2] @ y[2:]])
    wall = mj.Reset(
        lambda t, y, gravity: y[0] - WALL, lambda t, y, gravity: bounced(jnp, y), direction=False
    )
    solver = mj.Projected(dfx.Tsit5(), mj.Constraint(rod))

    def solve(gravity: Any) -> End:
        sol = mj.diffeqsolve(
            term,
            solver,
            0.0,
            T1,
            None,
            jnp.array(START),
            gravity,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            resets=(wall,),
            max_resets=MOST,
            max_steps=20_000,
        )
        return End(sol.ys[0], sol.resets.number, sol.stats["num_steps"])

    return jax.jit(solve)


def loop_around_diffrax(tolerance: float) -> Callable[[Any], End]:
    term = dfx.ODETerm(lambda t, y, gravity: field(jnp, y, gravity))
    wall = dfx.Event(
        lambda t, y, args, **kwargs: y[0] - WALL,
        optx.Newton(tolerance, tolerance),
        direction=False,
    )

    @jax.jit
    def flight(t: Any, y: Any, gravity: Any) -> Any:
        sol = dfx.diffeqsolve(
            term,
            dfx.Tsit5(),
            t,
            T1,
            1e-3,
            y,
            gravity,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            event=wall,
            max_steps=4096,
        )
        return sol.ts[0], sol.ys[0], sol.stats["num_steps"], sol.event_mask

    def solve(gravity: Any) -> End:
        t, y, impacts, steps = jnp.zeros(()), jnp.array(START), 0, 0
        while True:
            t, y, more, hit = flight(t, y, gravity)
            steps += more
            if not hit:
                return End(y, impacts, steps)
            y, impacts = bounced(jnp, y), impacts + 1

    return solve


def loop_around_scipy(tolerance: float) -> Callable[[Any], End]:
    def wall(t: float, y: np.ndarray) -> float:
        return y[0] - WALL

    wall.terminal, wall.direction = True, -1

    def solve(gravity: Any) -> End:
        t, y, impacts, steps = 0.0, np.array(START), 0, 0
        while True:
            sol = scipy.integrate.solve_ivp(
                lambda t, y: field(np, y, np.float64(gravity)),
                (t, T1),
                y,
                rtol=tolerance,
                atol=tolerance,
                events=wall,
            )
            t, y = sol.t[-1], sol.y[:, -1]
            steps += sol.t.size - 1
            if sol.status != 1:
                return End(y, impacts, steps)
            y, impacts = bounced(np, y), impacts + 1

    return solve


def reference(gravity: float) -> np.ndarray:
    """In the angle from the vertical, which falls to that of the wall."""
    angle = np.arcsin(WALL)
    theta, rate = integrate_with_resets(
        lambda t, x: (x[1], -gravity * np.sin(x[0])),
        (np.pi / 2, 0.0),
        np.array([T1]),
        [lambda t, x: x[0] - angle],
        lambda _, x: np.array([x[0], -RESTITUTION * x[1]]),
    )[0]
    sin, cos = np.sin(theta), np.cos(theta)
    return np.array([sin, -cos, rate * cos, rate * sin])


METHODS = {
    "resets, projected": with_resets,
    "loop around Diffrax": loop_around_diffrax,
    "loop around SciPy": loop_around_scipy,
}


@dataclasses.dataclass(frozen=True)
class Row:
    """`gradient` is the relative error of the derivative of x by gravity, `None` without one; the first
    run includes the time to compile."""

    method: str
    tolerance: float
    error: float
    violation: float
    impacts: int
    steps: int
    gradient: float | None
    first_run_s: float
    run: Timing
    gradient_run: Timing | None


def measure(tolerance: float, repeats: int) -> list[Row]:
    runs, gradients, ends, first = {}, {}, {}, {}
    gravity, exact = jnp.array(GRAVITY), reference(GRAVITY)
    h = 1e-4
    at = [reference(GRAVITY + k * h)[0] for k in (-2, -1, 1, 2)]
    slope = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
    slopes = {}
    for name, make in METHODS.items():
        solve, begun = make(tolerance), time.perf_counter()
        ends[name] = jax.block_until_ready(solve(gravity))
        first[name] = time.perf_counter() - begun
        runs[name] = functools.partial(lambda solve: jax.block_until_ready(solve(gravity)), solve)
        if make is loop_around_scipy:
            continue
        gradient = jax.grad(lambda gravity, solve=solve: solve(gravity).y[0])
        gradient = jax.jit(gradient) if make is with_resets else gradient
        slopes[name] = float(gradient(gravity))
        gradients[name] = functools.partial(lambda f: jax.block_until_ready(f(gravity)), gradient)
    timed = interleaved(runs, repeats)
    gradient_timed = interleaved(gradients, repeats)
    rows = []
    for name, end in ends.items():
        y = np.asarray(end.y)
        rows.append(
            Row(
                name,
                tolerance,
                float(np.max(np.abs(y - exact))),
                float(max(abs(y[:2] @ y[:2] - 1), abs(y[:2] @ y[2:]))),
                int(end.impacts),
                int(end.steps),
                abs(slopes[name] - slope) / abs(slope) if name in slopes else None,
                first[name],
                timed[name],
                gradient_timed.get(name),
            )
        )
    return rows


def main(
    repeats: Annotated[int, typer.Option(help="Timed runs of each program.")] = 15,
    quick: Annotated[bool, typer.Option(help="One tolerance alone.")] = False,
    json: Annotated[Path | None, typer.Option(help="Where to write the results.")] = None,
) -> None:
    use_double_precision()
    tolerances = TOLERANCES[:1] if quick else TOLERANCES
    rows = [row for tolerance in tolerances for row in measure(tolerance, repeats)]
    columns = ("method", "rtol", "error", "violation", "impacts", "steps", "run [ms]")
    table = Table(*columns, "gradient error", "gradient [ms]", "first run [s]", title="Impacts")
    for row in rows:
        table.add_row(
            row.method,
            f"{row.tolerance:.0e}",
            f"{row.error:.1e}",
            f"{row.violation:.0e}",
            str(row.impacts),
            str(row.steps),
            f"{row.run.median_ms:.2f}",
            "" if row.gradient is None else f"{row.gradient:.1e}",
            "" if row.gradient_run is None else f"{row.gradient_run.median_ms:.2f}",
            f"{row.first_run_s:.1f}",
        )
    make_console().print(table)
    if json is not None:
        found = [dataclasses.asdict(row) for row in rows]
        write_json(json, {"environment": environment(), "rows": found})


if __name__ == "__main__":
    typer.run(main)
