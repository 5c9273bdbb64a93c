"""Constraints that correct themselves, next to what users write by hand: a state normalized after
every step.

`python -m benchmarks.speed.closed_forms --json benchmarks/results/closed_forms.json`

Tsit5, rtol = atol = 1e-8, 20 units of time, the state at the end. By hand is a solver of Diffrax of
which every step is followed by a normalization: without statistics, result codes and derivatives of
its own.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    make_console,
    milliseconds,
    Timing,
    use_double_precision,
    write_json,
)


TOLERANCE = 1e-8
T1 = 20.0
CONTROLLER = dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE)


class Normalized(dfx.AbstractWrappedSolver):
    """By hand."""

    solver: dfx.AbstractSolver
    normalize: Callable = eqx.field(static=True)

    @property
    def term_structure(self):  # pyright: ignore
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, *args):
        return self.solver.func(*args)

    def init(self, *args):
        return self.solver.init(*args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # What is carried over belongs to the state before it is normalized.
        y1, *rest = self.solver.step(terms, t0, t1, y0, args, solver_state, True)
        return self.normalize(y1), *rest


class Case(NamedTuple):
    field: Callable
    y0: Any
    constraint: mj.AbstractConstraint
    by_hand: dict[str, Callable]


@dataclasses.dataclass(frozen=True)
class Row:
    manifold: str
    method: str
    steps: int
    error: float
    violation: float
    run: Timing


def unit(y):
    return y / jnp.sqrt(y @ y)


def gram_schmidt(Y):
    a = unit(Y[:, 0])
    b = unit(Y[:, 1] - a * (a @ Y[:, 1]))
    return jnp.stack([a, b, jnp.cross(a, b)], 1)


def polar(Y):
    u, _, v = jnp.linalg.svd(Y, full_matrices=False)
    return u @ v


def angular_velocity(t, x):
    return jnp.stack([jnp.sin(t), 0.4 + x, jnp.cos(2 * t)])


def cases() -> dict[str, Case]:
    on_sphere = lambda t, y, args: jnp.cross(angular_velocity(t, y[0]), y)
    on_group = lambda t, R, args: jnp.cross(R, angular_velocity(t, R[0, 0])[None])
    return {
        "sphere": Case(
            on_sphere, jnp.array([0.6, 0.0, 0.8]), mj.Sphere(), {"by hand, y / |y|": unit}
        ),
        "SO(3)": Case(
            on_group,
            jnp.eye(3),
            mj.Stiefel(),
            {"by hand, Gram-Schmidt": gram_schmidt, "by hand, polar factor by SVD": polar},
        ),
    }


def methods(case: Case) -> dict[str, Callable]:
    terms, plain = dfx.ODETerm(case.field), mj.Constraint(lambda t, y, args: case.constraint(t, y))
    solve = lambda run, solver, dt0: (
        lambda y0: run(terms, solver, 0.0, T1, dt0, y0, stepsize_controller=CONTROLLER)
    )
    ours = lambda solver: solve(mj.diffeqsolve, solver, None)
    found = {
        "closed form": ours(mj.Projected(dfx.Tsit5(), case.constraint)),
        "Newton's method": ours(mj.Projected(dfx.Tsit5(), plain)),
    }
    if isinstance(case.constraint, mj.Stiefel):
        chart = mj.LieGroupChart(mj.SO3())
        found["Lie-group chart"] = ours(
            mj.LocalCoordinates(dfx.Tsit5(), case.constraint, chart=chart)
        )
    for name, normalize in case.by_hand.items():
        found[name] = solve(dfx.diffeqsolve, Normalized(dfx.Tsit5(), normalize), 0.01)
    return found


def reference(case: Case) -> np.ndarray:
    """SciPy's DOP853 at tight tolerances."""
    flat = lambda t, y: np.ravel(case.field(t, jnp.asarray(y.reshape(case.y0.shape)), None))
    y0 = np.ravel(case.y0)
    return solve_ivp(flat, (0.0, T1), y0, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def measure(name: str, case: Case, repeats: int) -> list[Row]:
    expected = reference(case)
    runs = {method: compiled(f, case.y0)[0] for method, f in methods(case).items()}
    timings = interleaved(runs, repeats)
    rows = []
    for method, run in runs.items():
        sol = run()
        y = sol.ys[0]
        error = float(np.max(np.abs(np.ravel(y) - expected)))
        violation = float(jnp.max(jnp.abs(jnp.ravel(case.constraint(0.0, y)))))
        steps = int(sol.stats["num_steps"])
        rows.append(Row(name, method, steps, error, violation, timings[method]))
    return rows


def table_of(rows: list[Row]) -> Table:
    table = Table(title="State at the end", title_justify="left")
    table.add_column("manifold", no_wrap=True)
    table.add_column("method", no_wrap=True)
    for heading in ("steps", "error", "max |g|", "run, ms (quartiles)"):
        table.add_column(heading, justify="right", no_wrap=True)
    for r in rows:
        low, high = milliseconds(r.run.low_ms), milliseconds(r.run.high_ms)
        table.add_row(
            r.manifold,
            r.method,
            str(r.steps),
            f"{r.error:.0e}",
            f"{r.violation:.0e}",
            f"{milliseconds(r.run.median_ms)} ({low}-{high})",
        )
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of each program.")] = 51,
) -> None:
    """Measure constraints that correct themselves next to a normalization written by hand."""
    use_double_precision()
    console = make_console()
    with console.status("measuring"):
        rows = [row for name, case in cases().items() for row in measure(name, case, repeats)]
    console.print(table_of(rows))
    if json is not None:
        settings = {"rtol": TOLERANCE, "t1": T1, "repeats": repeats}
        content = {"environment": environment(), "settings": settings}
        write_json(json, {**content, "rows": [dataclasses.asdict(row) for row in rows]})


if __name__ == "__main__":
    typer.run(main)
