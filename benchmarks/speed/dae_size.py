"""A DAE of index 2 with thousands of unknowns: viscous flow in a box, reduced from its equations.

`python -m benchmarks.speed.dae_size --json benchmarks/results/dae_size.json --plot benchmarks/results/dae_size.png`

Velocities on the faces and pressures in the cells of an `m x m` grid, `3 m^2 - 2 m` unknowns: momentum is
balanced on each face, and no cell gains volume, which determines the pressures only after one
differentiation. `reduce_dae` finds that from the residual alone; Rodas5P solves the form of index 1. In the
same run SciPy's BDF and RK45 solve the equations for the velocities, from which the pressures have been
eliminated by hand with sparse matrices (SuperLU). Errors are those of the velocities against SciPy's DOP853
at 1e-11, violations the largest gain of volume.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.integrate
import scipy.sparse as sp
import typer
from rich.table import Table
from scipy.sparse.linalg import splu

import manifold_jax as mj

from ..tools.measure import (
    environment,
    interleaved,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)


TOLERANCE, T1, VISCOSITY = 1e-6, 0.5, 0.02


def residual(t: Any, x: Any, xdot: Any, viscosity: Any) -> Any:
    """Momentum on the inner faces; conservation of volume in all cells but one, whose pressure is zero."""
    u, v, p = x["u"], x["v"], x["p"]
    m = len(p)

    def friction(w: Any) -> Any:
        b = jnp.pad(w, 1)  # no velocity at the walls
        beside = b[2:, 1:-1] + b[:-2, 1:-1] + b[1:-1, 2:] + b[1:-1, :-2]
        return viscosity * m**2 * (beside - 4 * w)

    stirred = jnp.sin(3 * t) * jnp.asarray(stirring(m))
    gain = m * (
        jnp.diff(jnp.pad(u, ((1, 1), (0, 0))), axis=0) + jnp.diff(jnp.pad(v, ((0, 0), (1, 1))))
    )
    return {
        "u": xdot["u"] - friction(u) + m * jnp.diff(p, axis=0) - stirred,
        "v": xdot["v"] - friction(v) + m * jnp.diff(p),
        "p": gain.at[0, 0].set(p[0, 0]),
    }


def stirring(m: int) -> np.ndarray:
    return np.broadcast_to((np.arange(m) + 0.5) / m, (m - 1, m)).copy()


def at_rest(m: int) -> Any:
    return {"u": jnp.zeros((m - 1, m)), "v": jnp.zeros((m, m - 1)), "p": jnp.zeros((m, m))}


def ours(m: int) -> tuple[Callable, dict[str, Any]]:
    """Return the solve, compiled, and the seconds of each stage before."""
    begin = time.perf_counter()
    dae = mj.reduce_dae(residual, at_rest(m), VISCOSITY, form="index-1")
    reduced = time.perf_counter()
    z0 = jax.block_until_ready(dae.consistent_state(0.0, at_rest(m), VISCOSITY)[0])
    started = time.perf_counter()

    def solve(z0: Any, viscosity: Any) -> Any:
        sol = mj.diffeqsolve(
            dae.terms,
            mj.Rodas5P(),
            0.0,
            T1,
            1e-3,
            z0,
            viscosity,
            stepsize_controller=dfx.PIDController(TOLERANCE, TOLERANCE),
        )
        ys: Any = sol.ys
        x, _ = dae.outputs(jnp.asarray(T1), ys[-1], viscosity)
        return x, sol.stats["num_steps"]

    program = jax.jit(solve).lower(z0, jnp.asarray(VISCOSITY)).compile()
    compiled = time.perf_counter()

    def run() -> tuple[np.ndarray, int]:
        x, steps = jax.block_until_ready(program(z0, jnp.asarray(VISCOSITY)))
        return np.concatenate([np.ravel(x["u"]), np.ravel(x["v"])]), int(steps)

    found = {
        "reduce_s": reduced - begin,
        "start_s": started - reduced,
        "compile_s": compiled - started,
    }
    return run, {"index": dae.report.index, **found}


def by_hand(m: int) -> tuple[Callable, sp.csr_array]:
    """Return `w'` of the velocities, and the matrix of the gain of volume."""
    second = lambda n: sp.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n))
    eye, difference = sp.eye_array, sp.diags_array([1.0, -1.0], offsets=[0, -1], shape=(m, m - 1))
    laplace = lambda a, b: sp.kron(second(a), eye(b)) + sp.kron(eye(a), second(b))
    A = VISCOSITY * m**2 * sp.block_diag([laplace(m - 1, m), laplace(m, m - 1)])
    D = m * sp.csr_array(sp.hstack([sp.kron(difference, eye(m)), sp.kron(eye(m), difference)]))
    force = np.concatenate([stirring(m).ravel(), np.zeros(m * (m - 1))])
    inner = sp.csr_array(D[1:])
    factors = splu(sp.csc_array(inner @ inner.T))

    def rate(t: float, w: np.ndarray) -> np.ndarray:
        free = A @ w + np.sin(3 * t) * force
        return free - inner.T @ factors.solve(inner @ free)

    return rate, D


def with_scipy(m: int, method: str, tolerance: float) -> Callable:
    rate, _ = by_hand(m)
    w0 = np.zeros(2 * m * (m - 1))

    def run() -> tuple[np.ndarray, int]:
        sol = scipy.integrate.solve_ivp(rate, (0, T1), w0, method, rtol=tolerance, atol=tolerance)
        return sol.y[:, -1], len(sol.t) - 1

    return run


def measure(m: int, repeats: int) -> list[dict[str, Any]]:
    reference, _ = with_scipy(m, "DOP853", 1e-11)()
    run, known = ours(m)
    methods = {"reduce_dae, Rodas5P": run, "SciPy RK45, by hand": with_scipy(m, "RK45", TOLERANCE)}
    if m <= 16:  # its Jacobian is dense, by differences
        methods["SciPy BDF, by hand"] = with_scipy(m, "BDF", TOLERANCE)
    _, D = by_hand(m)
    rows = []
    for name, timing in interleaved(methods, repeats).items():
        w, steps = methods[name]()
        row = {"unknowns": 3 * m**2 - 2 * m, "method": name, "steps": steps}
        row |= {"seconds": timing.median_ms / 1e3, "error": float(np.abs(w - reference).max())}
        row["violation"] = float(np.abs(D @ w).max())
        rows.append(row | (known if name.startswith("reduce") else {}))
    return rows


KEYS = ("unknowns", "method", "steps", "seconds", "error", "violation")
STAGES = ("reduce_s", "start_s", "compile_s")


def make_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(*KEYS, *STAGES, box=None)
    for row in rows:
        cells = [row.get(key, "") for key in (*KEYS, *STAGES)]
        table.add_row(*(f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells))
    return table


def write_figure(path: Path, rows: list[dict[str, Any]]) -> None:
    figure, axis = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
    for method in dict.fromkeys(row["method"] for row in rows):
        chosen = [row for row in rows if row["method"] == method]
        x = [row["unknowns"] for row in chosen]
        axis.loglog(x, [row["seconds"] for row in chosen], "o-", label=f"{method}: a solve")
    chosen = [row for row in rows if "reduce_s" in row]
    x = [row["unknowns"] for row in chosen]
    for key, name in zip(STAGES, ("structure", "consistent start", "compiling"), strict=True):
        axis.loglog(x, [row[key] for row in chosen], "s--", alpha=0.6, label=f"reduce_dae: {name}")
    axis.set(xlabel="unknowns", ylabel="seconds")
    axis.set_xticks(x, [str(number) for number in x])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    sizes: Annotated[str, typer.Option(help="Cells in each direction.")] = "8,16,32,41",
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 3,
) -> None:
    """Measure a DAE of index 2 with up to 5000 unknowns."""
    use_one_core()
    use_double_precision()
    rows = [row for size in sizes.split(",") for row in measure(int(size), repeats)]
    make_console().print(make_table(rows))
    if json is not None:
        settings = {"tolerance": TOLERANCE, "t1": T1, "viscosity": VISCOSITY}
        write_json(json, {"environment": environment("klujax"), "settings": settings, "rows": rows})
    if plot is not None:
        write_figure(plot, rows)


if __name__ == "__main__":
    typer.run(main)
