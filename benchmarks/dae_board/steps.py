"""Steps that stiff problems of the board take for equal digits.

`python -m benchmarks.dae_board.steps --json benchmarks/results/jax_0.10/dae_steps.json`

Each problem at several tolerances (`rtol = atol`): `RadauIIA5` and `Rodas5P` on the reduced system,
SciPy's Radau on the same vector field, and where it is installed scipy_dae's Radau on the residual as it
is written. Then, for the transistor amplifier with its own mass matrix, how far the error estimates of
single steps exceed their errors.
"""

import dataclasses
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import typer
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import environment, make_console, use_double_precision, write_json
from ..tools.stiff_problems import PROBLEMS
from .__main__ import every_problem
from .peers import with_scipy_dae
from .solve import MAX_STEPS, Reduction, residual_in_numbers


TOLERANCES = 1e-5, 1e-6, 1e-7, 1e-8
METHODS = "RadauIIA5", "Rodas5P"


@dataclasses.dataclass(frozen=True)
class Row:
    problem: str
    method: str
    tolerance: float
    digits: float
    steps: int  # accepted and rejected; of the other libraries accepted ones


@dataclasses.dataclass(frozen=True)
class EstimateRow:
    """Medians over steps: the estimated error in units of the tolerance, and its ratio to the error."""

    method: str
    estimate: float
    ratio: float


def ours(name: str, reduction: Reduction, method: str) -> list[Row]:
    problem, z0 = reduction.problem, reduction.consistent(reduction.args)

    @jax.jit
    def solve(z0: Any, tolerance: Any) -> Any:
        tolerances = dict(rtol=tolerance, atol=tolerance)
        changed = reduction._replace(problem=problem._replace(solver=method, **tolerances))
        return changed.solve(z0, reduction.args, problem.t1)

    rows = []
    for tolerance in TOLERANCES:
        sol = solve(z0, tolerance)
        digits = problem.digits(reduction.outputs(sol.ys[-1], reduction.args, problem.t1))
        rows.append(Row(name, method, tolerance, digits, int(sol.stats["num_steps"])))
    return rows


def with_its_mass(method: str) -> list[Row]:
    """The transistor amplifier as it is written, with a singular mass matrix."""
    board = every_problem()["transistor amplifier"]
    problem = PROBLEMS["transistor amplifier"]
    term = mj.MassMatrixTerm(problem.field(jnp), problem.mass)

    @jax.jit
    def solve(y0: Any, tolerance: Any) -> Any:
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        options: Any = dict(stepsize_controller=controller, max_steps=MAX_STEPS, throw=False)
        return mj.diffeqsolve(term, getattr(mj, method)(), 0.0, problem.t1, None, y0, **options)

    rows, name = [], "transistor amplifier, M y' = f"
    for tolerance in TOLERANCES:
        sol = solve(jnp.asarray(problem.y0), tolerance)
        digits = board.digits({"u": sol.ys[-1]})
        rows.append(Row(name, method, tolerance, digits, int(sol.stats["num_steps"])))
    return rows


def scipy_radau(name: str, reduction: Reduction) -> list[Row]:
    problem, z0 = reduction.problem, reduction.consistent(reduction.args)
    field = jax.jit(lambda t, z: reduction.dae.terms.vf(t, z, reduction.args))
    jacobian = jax.jit(jax.jacfwd(field, argnums=1))
    edges, rows = [0.0, *problem.jumps, problem.t1], []
    for tolerance in TOLERANCES:
        z, steps = np.asarray(z0), 0
        for begin, end in pairwise(edges):
            sol = solve_ivp(
                lambda t, z: np.asarray(field(t, z)),
                (begin, end),
                z,
                method="Radau",
                rtol=tolerance,
                atol=tolerance,
                jac=lambda t, z: np.asarray(jacobian(t, z)),
            )
            z, steps = sol.y[:, -1], steps + len(sol.t) - 1
        x = reduction.outputs(jnp.asarray(z), reduction.args, problem.t1)
        rows.append(Row(name, "Radau (SciPy)", tolerance, problem.digits(x), steps))
    return rows


def scipy_dae_radau(name: str, reduction: Reduction) -> list[Row]:
    residual, x0, xdot0 = residual_in_numbers(reduction)
    numbers = lambda t, x, xdot: np.asarray(residual(t, x, xdot))
    unravel, rows = jfu.ravel_pytree(reduction.start)[1], []
    for tolerance in TOLERANCES:
        tolerances = dict(rtol=tolerance, atol=tolerance)
        changed = reduction._replace(problem=reduction.problem._replace(**tolerances))
        end, steps, _ = with_scipy_dae(changed, numbers, x0, xdot0)
        digits = reduction.problem.digits(unravel(jnp.asarray(end)))
        rows.append(Row(name, "Radau (scipy_dae)", tolerance, digits, steps))
    return rows


def estimates(method: str, tolerance: float = 1e-7) -> EstimateRow:
    """Of every third step in the second half, from the states that were reached."""
    problem = PROBLEMS["transistor amplifier"]
    term = mj.MassMatrixTerm(problem.field(jnp), problem.mass)

    def solve(t0: Any, t1: Any, y0: Any, dt0: Any, tolerance: float, solver: Any, save: Any) -> Any:
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        options: Any = dict(
            saveat=save, stepsize_controller=controller, max_steps=10_000, throw=False
        )
        return mj.diffeqsolve(term, solver, t0, t1, dt0, y0, consistent="assume", **options)

    solver = getattr(mj, method)(checks_start=False)
    run = lambda y0: solve(0.0, 0.2, y0, None, tolerance, solver, dfx.SaveAt(steps=True))
    sol = jax.jit(run)(jnp.asarray(problem.y0))
    number = int(sol.stats["num_accepted_steps"])
    k = np.arange(number // 2, number - 1, 3)
    begins, ends, states = sol.ts[k], sol.ts[k + 1], sol.ys[k]
    if method == "RadauIIA5":
        finder = dfx.VeryChord(rtol=tolerance, atol=tolerance, norm=optx.rms_norm)
        solver = mj.RadauIIA5(checks_start=False, root_finder=finder)

    def one(t0: Any, t1: Any, y0: Any) -> Any:
        state = solver.init(term, t0, t1, y0, None)
        y1, error = solver.step(term, t0, t1, y0, None, state, False)[:2]
        return y1, error

    def fine(t0: Any, t1: Any, y0: Any) -> Any:
        accurate = mj.RadauIIA5(), dfx.SaveAt(t1=True)
        return solve(t0, t1, y0, (t1 - t0) / 8, 1e-10, *accurate).ys[0]

    y1, error = map(np.asarray, jax.jit(jax.vmap(one))(begins, ends, states))
    exact = np.asarray(jax.jit(jax.vmap(fine))(begins, ends, states))
    size = lambda x: np.sqrt(np.mean((x / (tolerance * (1 + np.abs(y1)))) ** 2, axis=1))
    ratios = size(error) / size(y1 - exact)
    return EstimateRow(method, float(np.median(size(error))), float(np.median(ratios)))


def at_digits(rows: list[Row], digits: float) -> float:
    """Return the number of steps for so many digits, interpolated; NaN outside of the rows."""
    rows = sorted(rows, key=lambda row: row.digits)
    steps = np.log([row.steps for row in rows])
    return float(np.exp(np.interp(digits, [r.digits for r in rows], steps, np.nan, np.nan)))


def print_tables(console: Console, rows: list[Row], of_estimates: list[EstimateRow]) -> None:
    table = Table("problem", "method", "tolerance", "digits", "steps")
    for row in rows:
        table.add_row(
            row.problem, row.method, f"{row.tolerance:.0e}", f"{row.digits:.2f}", str(row.steps)
        )
    console.print(table)
    table = Table("problem", "method", "steps for 6", "7", "8 digits")
    for name in dict.fromkeys(row.problem for row in rows):
        for method in dict.fromkeys(row.method for row in rows):
            own = [row for row in rows if (row.problem, row.method) == (name, method)]
            if own:
                table.add_row(name, method, *(f"{at_digits(own, d):.0f}" for d in (6, 7, 8)))
    console.print(table)
    table = Table("transistor amplifier", "estimate / tolerance", "estimate / error")
    for one in of_estimates:
        table.add_row(one.method, f"{one.estimate:.2f}", f"{one.ratio:.0f}")
    console.print(table)


def main(
    problems: Annotated[str, typer.Option(help="names, separated by commas")] = (
        "transistor amplifier,NAND gate"
    ),
    json: Annotated[Path | None, typer.Option(help="where to write the result")] = None,
) -> None:
    use_double_precision()
    rows: list[Row] = []
    for name in problems.split(","):
        reduction = Reduction.of(every_problem()[name])
        for method in METHODS:
            rows += ours(name, reduction, method)
        rows += scipy_radau(name, reduction)
        if find_spec("scipy_dae") is not None:
            rows += scipy_dae_radau(name, reduction)
    rows += [row for method in METHODS for row in with_its_mass(method)]
    of_estimates = [estimates(method) for method in METHODS]
    print_tables(make_console(), rows, of_estimates)
    if json is not None:
        content = {
            "environment": environment("scipy", "scipy_dae"),
            "rows": [dataclasses.asdict(row) for row in rows],
            "estimates": [dataclasses.asdict(row) for row in of_estimates],
        }
        write_json(json, content)


if __name__ == "__main__":
    typer.run(main)
