"""Stiff systems of N unknowns: cost of a solve and of a gradient, and compile time against N.

`python -m benchmarks.speed.sparse_stiff --json benchmarks/results/sparse_stiff.json --plot benchmarks/results/sparse_stiff.png`

Rodas5P with sparse and with dense linear systems: the Brusselator with diffusion (an ODE, Hairer & Wanner,
Solving ODEs II, IV.10) and a ladder of low-pass filters with nonlinear capacitors (a DAE, half of whose
unknowns are algebraic). In the same run and in turn SciPy's BDF and Radau, for the ladder after its algebraic
unknowns have been eliminated by hand, and, where they are installed, IDA (scikit-sundae) and IDAS (CasADi)
with sparse Jacobians for the DAE itself. Errors are those against SciPy's Radau at a hundredth of the
tolerance.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    environment,
    interleaved,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)
from ._sparse_peers import peers, Prepared, processor_time, report_missing, T1, with_scipy
from ._sparse_problems import brusselator, ladder, Problem


TOLERANCE = 1e-6
DENSE = 1000  # the most unknowns of dense systems


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
    start = processor_time()
    program = jax.jit(function).lower(*args).compile()
    return program, processor_time() - start


def ours(problem: Problem, structure: str) -> tuple[Prepared, Callable, dict[str, Any]]:
    """Return the solve, its gradient, and what is known of that before it is timed."""
    a = jnp.asarray(problem.parameter)

    def end_and_steps(a: Any) -> tuple[Any, Any]:
        sol = solve(problem, structure, a)
        return at_end(sol), sol.stats["num_steps"]

    loss = lambda a: jnp.sum(at_end(solve(problem, structure, a)) ** 2)
    program, compile_s = build(end_and_steps, a)
    gradient, gradient_compile_s = build(jax.grad(loss), a)
    known = {
        "gradient_compile_s": gradient_compile_s,
        "gradient_mb": gradient.memory_analysis().temp_size_in_bytes / 1e6,
        "gradient": float(gradient(a)),
    }
    solved = Prepared(lambda: jax.block_until_ready(program(a)), compile_s)
    return solved, lambda: jax.block_until_ready(gradient(a)), known


def measure(problem: Problem, repeats: int) -> list[dict[str, Any]]:
    size = problem.y0.size
    reference, _ = with_scipy(problem, "Radau", TOLERANCE / 100).run()
    methods, gradients, rows = {}, {}, {}
    for structure in ("sparse", "dense") if size <= DENSE else ("sparse",):
        name = f"Rodas5P, {structure}"
        methods[name], gradients[name], rows[name] = ours(problem, structure)
    methods |= peers(problem, TOLERANCE)
    seconds = {
        name: timing.median_ms / 1e3
        for name, timing in interleaved({k: m.run for k, m in methods.items()}, repeats).items()
    }
    for name, timing in interleaved(gradients, repeats).items():
        rows[name]["gradient_per_solve"] = timing.median_ms / 1e3 / seconds[name]
    return [
        {
            **{"problem": problem.name, "unknowns": size, "method": name},
            **row(problem, method, seconds[name], reference),
            **rows.get(name, {}),
        }
        for name, method in methods.items()
    ]


def row(
    problem: Problem, method: Prepared, seconds: float, reference: np.ndarray
) -> dict[str, Any]:
    end, steps = method.run()
    end, steps = np.asarray(end), int(steps)
    error = float(np.abs(end[:, : problem.differential] - reference).max())
    found = {"steps": steps, "seconds": seconds, "step_ms": 1e3 * seconds / steps, "error": error}
    if method.compile_s is not None:
        found["compile_s"] = method.compile_s
    residual = problem.residual(T1, end) if end.shape == problem.y0.shape else None
    return found if residual is None else {**found, "violation": residual}


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
    keys = ("problem", "unknowns", "method", "steps", "seconds", "step_ms", "error", "violation")
    keys += ("compile_s",)
    keys += ("gradient_compile_s", "gradient_per_solve", "gradient_mb")
    table = Table(*keys, box=None)
    for row in rows:
        cells = [row.get(key, "") for key in keys]
        table.add_row(*(f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells))
    return table


def write_figure(path: Path, rows: list[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(row["problem"] for row in rows))
    figure, axes = plt.subplots(1, len(names), figsize=(9, 4.6), sharey=True, squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        for method in dict.fromkeys(row["method"] for row in rows):
            chosen = [r for r in rows if r["problem"] == name and r["method"] == method]
            x, y = [r["unknowns"] for r in chosen], [1e3 * r["seconds"] for r in chosen]
            style = "o-" if method.startswith("Rodas5P") else "s--"
            axis.loglog(x, y, style, markersize=4, label=method)
        axis.set(title=name, xlabel="unknowns")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("ms per solve")
    labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(*labels, loc="lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.12, 1, 1))
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
    report_missing(console)
    rows = []
    for make in (brusselator, ladder):
        for size in sizes.split(","):
            rows += measure(make(int(size) // 2), repeats)
    console.print(make_table(rows))
    console.print(f"slopes: {slopes(rows)}")
    if json is not None:
        settings = {"tolerance": TOLERANCE, "t1": T1}
        content = {
            "environment": environment("klujax", "casadi", "scikit-sundae"),
            "settings": settings,
        }
        write_json(json, {**content, "slopes": slopes(rows), "rows": rows})
    if plot is not None:
        write_figure(plot, rows)


if __name__ == "__main__":
    typer.run(main)
