"""Stiff systems of N unknowns: cost of a step and of a gradient, and compile time against N.

`python -m benchmarks.speed.sparse_stiff --json benchmarks/results/sparse_stiff.json --plot benchmarks/results/sparse_stiff.png`

Rodas5P with sparse and with dense linear systems: the Brusselator with diffusion (an ODE, Hairer & Wanner,
Solving ODEs II, IV.10) and a ladder of low-pass filters with nonlinear capacitors (a DAE, half of whose
unknowns are algebraic). Beside them SciPy's BDF and Radau with the pattern of the Jacobian, for the ladder
after its algebraic unknowns have been eliminated by hand. Errors are those against SciPy's Radau at a
hundredth of the tolerance.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as sp
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)


TOLERANCE = 1e-6
T1 = 2.0
DENSE = 1000  # the most unknowns of dense systems


class Problem(NamedTuple):
    """A problem with `cells` cells of two unknowns each.

    - `terms`: with a state of shape `(cells, 2)`.
    - `field`, `neighbours`: an ODE for the first `state` columns in NumPy, and how far its cells reach.
    - `residual`: the largest residual of an algebraic equation.
    """

    name: str
    terms: Any
    y0: np.ndarray
    parameter: float
    field: Callable
    state: int
    residual: Callable


def brusselator(cells: int) -> Problem:
    def cell_by_cell(y: Any, a: Any, numpy: Any) -> Any:
        padded = numpy.concatenate([numpy.asarray([[1.0, 3.0]]), y, numpy.asarray([[1.0, 3.0]])])
        diffusion = a * (cells + 1) ** 2 * (padded[2:] - 2 * y + padded[:-2])
        u, v = y[:, 0], y[:, 1]
        reaction = numpy.stack([1 + u * u * v - 4 * u, 3 * u - u * u * v], axis=1)
        return reaction + diffusion

    x = np.linspace(0, 1, cells + 2)[1:-1]
    y0 = np.stack([1 + np.sin(2 * np.pi * x), 3 * np.ones(cells)], axis=1)
    terms = dfx.ODETerm(lambda t, y, a: cell_by_cell(y, a, jnp))
    field = lambda t, y, a: cell_by_cell(y, a, np)
    return Problem("brusselator", terms, y0, 0.02, field, 2, lambda t, y, a: 0.0)


def ladder(cells: int) -> Problem:
    def nodes(t: Any, v: Any, a: Any, numpy: Any) -> Any:
        left = numpy.concatenate([numpy.sin(3 * t)[None], v[:-1]])
        return (left / a + v) / (1 / a + 1)

    def charging(v: Any, e: Any, a: Any, numpy: Any) -> Any:
        right = numpy.concatenate([e[1:], v[-1:]])
        return ((e - v) - (v - right) / a) / (1e-3 * (1 + v * v))

    def algebraic(t: Any, y: Any, a: Any, numpy: Any) -> Any:
        v, e = y[:, 0], y[:, 1]
        left = numpy.concatenate([numpy.sin(3 * t)[None], v[:-1]])
        return (left - e) / a - (e - v)

    def both(t: Any, y: Any, a: Any) -> Any:
        rate = charging(y[:, 0], y[:, 1], a, jnp)
        return jnp.stack([rate, algebraic(t, y, a, jnp)], axis=1)

    def field(t: Any, y: Any, a: Any) -> Any:
        v = y[:, 0]
        return charging(v, nodes(np.asarray(t), v, a, np), a, np)[:, None]

    residual = lambda t, y, a: float(np.abs(algebraic(np.asarray(t), y, a, np)).max())
    mass = np.stack([np.ones(cells), np.zeros(cells)], axis=1)
    terms, y0 = mj.MassMatrixTerm(both, mass), np.zeros((cells, 2))
    return Problem("ladder", terms, y0, 0.5, field, 1, residual)


def solve(problem: Problem, structure: Any, parameter: Any) -> dfx.Solution:
    return mj.diffeqsolve(
        problem.terms,
        mj.Rodas5P(structure=structure),
        0.0,
        T1,
        1e-4,
        jnp.asarray(problem.y0),
        parameter,
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=4096,
    )


def at_end(sol: dfx.Solution) -> Any:
    ys: Any = sol.ys
    return ys[-1]


def build(function: Callable, *args: Any) -> tuple[Callable, float]:
    """Return the program, and the processor time of tracing and compiling it."""
    start = time.process_time()
    program = jax.jit(function).lower(*args).compile()
    return program, time.process_time() - start


def fastest(program: Callable, repeats: int, *args: Any) -> float:
    def once() -> float:
        start = time.perf_counter()
        jax.block_until_ready(program(*args))
        return time.perf_counter() - start

    return min(once() for _ in range(repeats))


def ours(problem: Problem, structure: str, reference: np.ndarray, repeats: int) -> dict[str, Any]:
    a = jnp.asarray(problem.parameter)

    def end_and_steps(a: Any) -> tuple[Any, Any]:
        sol = solve(problem, structure, a)
        return at_end(sol), sol.stats["num_steps"]

    loss = lambda a: jnp.sum(at_end(solve(problem, structure, a)) ** 2)
    program, compile_s = build(end_and_steps, a)
    gradient, gradient_compile_s = build(jax.grad(loss), a)
    end, steps = program(a)
    seconds, gradient_s = fastest(program, repeats, a), fastest(gradient, min(repeats, 2), a)
    end = np.asarray(end)
    memory = gradient.memory_analysis()
    return {
        "method": f"Rodas5P, {structure}",
        "steps": int(steps),
        "seconds": seconds,
        "step_ms": 1e3 * seconds / int(steps),
        "compile_s": compile_s,
        "gradient_compile_s": gradient_compile_s,
        "gradient_per_solve": gradient_s / seconds,
        "gradient_mb": memory.temp_size_in_bytes / 1e6,
        "error": float(np.abs(end[:, : problem.state] - reference).max()),
        "violation": problem.residual(T1, end, problem.parameter),
        "gradient": float(gradient(a)),
    }


def by_scipy(problem: Problem, method: str, tolerance: float) -> tuple[np.ndarray, dict[str, Any]]:
    y0 = problem.y0[:, : problem.state]
    cells = sp.csr_array(np.abs(np.subtract.outer(np.arange(len(y0)), np.arange(len(y0)))) <= 2)
    pattern = sp.kron(cells, np.ones((problem.state, problem.state)))
    field = lambda t, y: problem.field(t, y.reshape(y0.shape), problem.parameter).ravel()
    start = time.perf_counter()
    options = {"rtol": tolerance, "atol": tolerance, "jac_sparsity": pattern}
    sol = solve_ivp(field, (0, T1), y0.ravel(), method=method, **options)
    seconds, steps = time.perf_counter() - start, len(sol.t) - 1
    row = {"method": f"SciPy {method}", "steps": steps, "seconds": seconds}
    return sol.y[:, -1].reshape(y0.shape), {**row, "step_ms": 1e3 * seconds / steps}


def measure(problem: Problem, repeats: int) -> list[dict[str, Any]]:
    size = problem.y0.size
    reference, _ = by_scipy(problem, "Radau", TOLERANCE / 100)
    rows = [ours(problem, "sparse", reference, repeats)]
    if size <= DENSE:
        rows.append(ours(problem, "dense", reference, min(repeats, 2)))
    for method in ("BDF", "Radau"):
        end, row = by_scipy(problem, method, TOLERANCE)
        rows.append({**row, "error": float(np.abs(end - reference).max())})
    return [{"problem": problem.name, "unknowns": size, **row} for row in rows]


def slopes(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the exponents of the cost of a step between the smallest and the largest sparse system."""
    found = {}
    for name in dict.fromkeys(row["problem"] for row in rows):
        chosen = [r for r in rows if r["problem"] == name and r["method"] == "Rodas5P, sparse"]
        first, last = chosen[0], chosen[-1]
        if last["unknowns"] > first["unknowns"]:
            growth = np.log(last["step_ms"] / first["step_ms"])
            found[name] = float(growth / np.log(last["unknowns"] / first["unknowns"]))
    return found


def make_table(rows: list[dict[str, Any]]) -> Table:
    keys = ("problem", "unknowns", "method", "steps", "step_ms", "error", "violation", "compile_s")
    keys += ("gradient_compile_s", "gradient_per_solve", "gradient_mb")
    table = Table(*keys, box=None)
    for row in rows:
        cells = [row.get(key, "") for key in keys]
        table.add_row(*(f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells))
    return table


def write_figure(path: Path, rows: list[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(row["problem"] for row in rows))
    figure, axes = plt.subplots(1, len(names), figsize=(9, 3.8), sharey=True, squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        for method in dict.fromkeys(row["method"] for row in rows):
            chosen = [r for r in rows if r["problem"] == name and r["method"] == method]
            x, y = [r["unknowns"] for r in chosen], [r["step_ms"] for r in chosen]
            axis.loglog(x, y, "o-", label=method)
        axis.set(title=name, xlabel="unknowns")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("ms per step")
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    sizes: Annotated[str, typer.Option(help="Numbers of unknowns.")] = "100,1000,5000",
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 5,
) -> None:
    """Measure stiff systems of up to 5000 unknowns."""
    use_one_core()
    use_double_precision()
    console = make_console()
    rows = []
    for make in (brusselator, ladder):
        for size in sizes.split(","):
            rows += measure(make(int(size) // 2), repeats)
    console.print(make_table(rows))
    console.print(f"slopes: {slopes(rows)}")
    if json is not None:
        settings = {"tolerance": TOLERANCE, "t1": T1}
        content = {"environment": environment("klujax"), "settings": settings}
        write_json(json, {**content, "slopes": slopes(rows), "rows": rows})
    if plot is not None:
        write_figure(plot, rows)


if __name__ == "__main__":
    typer.run(main)
