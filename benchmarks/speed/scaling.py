"""Chains of N links: cost of a step, of its gradient, memory and compile time against N.

`python -m benchmarks.speed.scaling --json benchmarks/results/scaling.json --plot benchmarks/results/scaling.png`

Projected Tsit5, rtol = atol = 1e-8, the first steps of a folded chain, with constraints as sparse and
as dense matrices, on one core. Beside them SciPy's DOP853 with banded solves and without corrections,
MuJoCo (if installed) with its RK4, angles as coordinates and a constant step, and one solve of the
whole system for accelerations and multipliers by KLU (`klujax`, if installed).
"""

import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg as sla
import typer
from rich.table import Table
from scipy.integrate import solve_ivp

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    number,
    use_double_precision,
    use_one_core,
    write_json,
)


SPARSE = (4, 10, 32, 100, 1000, 10_000)
DENSE = (4, 10, 32, 100, 300)
WITH_GRADIENT = (100, 1000, 10_000)
STEPS = 40
GRADIENT_TIME = 0.2
CONTROLLER = dfx.PIDController(rtol=1e-8, atol=1e-8)


class Chain:
    """The chain of the gallery, without its reference solution."""

    def __init__(self, links: int, structure: str):
        gallery = mj.problems.chain(2).system
        functions = gallery.mass_matrix, gallery.holonomic, gallery.force
        self.system = mj.MechanicalSystem(*functions, structure=structure)
        self.links = links
        angles = np.pi / 4 * (-1.0) ** np.arange(links)
        q = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0).reshape(-1)
        self.y0 = jnp.asarray(q), jnp.zeros(2 * links)
        self.args = type(mj.problems.chain(2).args)(
            jnp.ones(links), jnp.ones(links), jnp.asarray(9.81)
        )

    def solve(self, t1: float, max_steps: int, y0: Any, args: Any) -> dfx.Solution:
        solver = mj.Projected(dfx.Tsit5(), self.system.constraint)
        return mj.diffeqsolve(
            self.system.terms,
            solver,
            0.0,
            t1,
            None,
            y0,
            args,
            stepsize_controller=CONTROLLER,
            max_steps=max_steps,
            throw=False,
        )

    def violation(self, y: Any) -> float:
        """`|d|^2 - 1` and `d d'` beside the coordinates, in NumPy."""
        q, v = (np.asarray(part).reshape(-1, 2) for part in y)
        d, rate = (np.diff(part, axis=0, prepend=np.zeros((1, 2))) for part in (q, v))
        size = 1 + np.abs(q).max()
        return float(max(np.abs((d * d).sum(1) - 1).max(), np.abs((d * rate).sum(1)).max()) / size)


def fastest(run: Any, repeats: int) -> float:
    """Milliseconds of the process, on one core: the least disturbed run."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def build(function: Any, *args: Any) -> tuple[Any, float, float]:
    """The program, seconds of the process to trace and compile it, and its temporary memory in MB."""
    jax.clear_caches()
    start = time.process_time()
    program = jax.jit(function).lower(*args).compile()
    seconds = time.process_time() - start
    memory = program.memory_analysis().temp_size_in_bytes / 1e6
    return lambda: jax.block_until_ready(program(*args)), seconds, memory


def ours(links: int, structure: str, repeats: int) -> dict[str, Any]:
    chain = Chain(links, structure)
    solve = lambda y0, args: chain.solve(1e9, STEPS, y0, args)
    run, seconds, memory = build(solve, chain.y0, chain.args)
    y1 = jax.tree.map(lambda x: x[-1], run().ys)
    row = dict(links=links, method=structure, ms_per_step=fastest(run, repeats) / STEPS)
    row |= dict(compile_s=seconds, temporary_mb=memory, violation=chain.violation(y1))
    with_gradient = structure == "sparse" and links in WITH_GRADIENT
    return row | gradient(chain, repeats) if with_gradient else row


def gradient(chain: Chain, repeats: int) -> dict[str, Any]:
    def loss(args):
        sol = chain.solve(GRADIENT_TIME, 64, chain.y0, args)
        return jnp.sum(sol.ys[0] ** 2) / chain.links**2

    run, _, _ = build(loss, chain.args)
    back, seconds, memory = build(jax.grad(loss), chain.args)
    ratio = fastest(back, repeats) / fastest(run, repeats)
    return dict(gradient_ratio=ratio, gradient_compile_s=seconds, gradient_mb=memory)


def banded(links: int) -> dict[str, Any]:
    """By hand: a tridiagonal solve in every evaluation, no corrections."""
    evaluations = 0

    def field(t, y):
        nonlocal evaluations
        evaluations += 1
        q, v = y.reshape(2, links, 2)
        d, rate = (
            np.diff(q, axis=0, prepend=np.zeros((1, 2))),
            np.diff(v, axis=0, prepend=np.zeros((1, 2))),
        )
        bands = np.zeros((2, links))
        bands[1] = 2 * (d * d).sum(1)
        bands[1, 0] /= 2
        bands[0, 1:] = -(d[1:] * d[:-1]).sum(1)
        right = (rate * rate).sum(1)
        right[0] -= 9.81 * d[0, 1]
        tension = sla.solveh_banded(bands, right)[:, None] * d
        a = -tension
        a[:-1] += tension[1:]
        a[:, 1] -= 9.81
        return np.concatenate([v.reshape(-1), a.reshape(-1)])

    chain = Chain(links, "sparse")
    y0 = np.concatenate([np.asarray(part) for part in chain.y0])
    expected = chain.system.accelerations(0.0, chain.y0, chain.args)
    np.testing.assert_allclose(field(0.0, y0)[2 * links :], expected, rtol=0, atol=1e-8)
    evaluations = 0
    start = time.process_time()
    sol = solve_ivp(field, (0, 0.3), y0, method="DOP853", rtol=1e-8, atol=1e-8)
    ms = 1e3 * (time.process_time() - start)
    return dict(
        links=links,
        method="SciPy, banded",
        ms_per_step=ms / (len(sol.t) - 1),
        steps=len(sol.t) - 1,
        evaluations=evaluations,
        violation=chain.violation(np.split(sol.y[:, -1], 2)),
    )


def by_mujoco(links: int) -> list[dict[str, Any]]:
    """Angles of point masses on hinges: nothing to violate, a dense mass matrix."""
    try:
        import mujoco
    except ImportError:
        return []
    spec, y0 = mujoco.MjSpec(), Chain(links, "sparse").y0
    spec.option.timestep, spec.option.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_RK4
    spec.compiler.degree, body = False, spec.worldbody
    for i in range(links):
        body = body.add_body(pos=[0, 0, -1.0 if i > 0 else 0.0])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, -1, 0])
        body.explicitinertial, body.ipos, body.mass = True, [0, 0, -1], 1.0
        body.inertia = [1e-6] * 3
    model = spec.compile()
    data = mujoco.MjData(model)
    d = np.diff(np.asarray(y0[0]).reshape(-1, 2), axis=0, prepend=np.zeros((1, 2)))
    data.qpos[:] = np.diff(np.arctan2(d[:, 0], -d[:, 1]), prepend=0.0)
    mujoco.mj_forward(model, data)
    expected = Chain(links, "sparse").system.accelerations(0.0, y0, Chain(links, "sparse").args)
    first = data.qacc[0] * np.array([-d[0, 1], d[0, 0]])
    np.testing.assert_allclose(first, expected[:2], rtol=1e-4, atol=1e-4)
    ms = fastest(lambda: mujoco.mj_step(model, data, STEPS), 3) / STEPS
    return [dict(links=links, method="MuJoCo", ms_per_step=ms)]


def whole_system(links: int, repeats: int) -> dict[str, Any]:
    """Accelerations: ours, and KLU on `[M J^T; J 0]` with its entries given."""
    chain = Chain(links, "sparse")
    solve = lambda y, args: chain.system.accelerations(0.0, y, args)
    ms = fastest(build(solve, chain.y0, chain.args)[0], repeats)
    row = dict(links=links, method="one evaluation", ms=ms)
    try:
        import klujax
    except ImportError:
        return row
    n, i = 2 * links, np.arange(links)
    d = np.diff(np.asarray(chain.y0[0]).reshape(-1, 2), axis=0, prepend=np.zeros((1, 2)))
    rows, columns = [np.repeat(i, 2)], [np.arange(n)]
    rows, columns = [*rows, np.repeat(i[1:], 2)], [*columns, np.arange(n - 2)]
    rows, columns = np.concatenate(rows) + n, np.concatenate(columns)
    values = np.concatenate([d.reshape(-1), -d[1:].reshape(-1)])
    where = (
        np.concatenate([np.arange(n), rows, columns]),
        np.concatenate([np.arange(n), columns, rows]),
    )
    entries = jnp.asarray(np.concatenate([np.ones(n), values, values]))
    right = jnp.asarray(np.concatenate([np.tile([0.0, -9.81], links), np.zeros(links)]))
    indices = [jnp.asarray(index, jnp.int32) for index in where]
    run, _, _ = build(klujax.solve, *indices, entries, right)
    np.testing.assert_allclose(run()[:n], solve(chain.y0, chain.args), rtol=0, atol=1e-7)
    return {**row, "klu_ms": fastest(run, repeats)}


def slope(rows: list[dict[str, Any]], method: str, least: int) -> float:
    points = [(r["links"], r["ms_per_step"]) for r in rows if r["method"] == method]
    links, ms = np.log([p for p in points if p[0] >= least]).T
    return float(np.polyfit(links, ms, 1)[0])


def table(rows: list[dict[str, Any]]) -> Table:
    names = ("links", "method", "ms_per_step", "compile_s", "temporary_mb", "violation")
    names += ("gradient_ratio", "gradient_mb", "ms", "klu_ms")
    out = Table(*names)
    for row in rows:
        cells = [row.get(name) for name in names]
        out.add_row(*(x if isinstance(x, str) else number(x, ".3g") for x in cells))
    return out


def write_figure(path: Path, rows: list[dict[str, Any]]) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    labels = {"SciPy, banded": "SciPy, banded, not corrected", "MuJoCo": "MuJoCo, RK4"}
    for method, marker in zip(("sparse", "dense", *labels), "os^D", strict=True):
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        label = labels.get(method, method)
        left.loglog(
            *zip(*((r["links"], r["ms_per_step"]) for r in own), strict=True),
            marker=marker,
            label=label,
        )
        if method not in labels:
            right.loglog(
                *zip(*((r["links"], r["temporary_mb"]) for r in own), strict=True),
                marker=marker,
                label=f"solve, {method}",
            )
    gradients = [(r["links"], r["gradient_mb"]) for r in rows if "gradient_mb" in r]
    if gradients:
        right.loglog(*zip(*gradients, strict=True), marker="v", label="gradient, sparse")
    for axes, title in ((left, "ms per step"), (right, "temporary memory, MB")):
        axes.set(xlabel="links", title=title)
        axes.grid(alpha=0.3)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, fontsize=8)
    figure.savefig(path, dpi=150)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every program.")] = 5,
) -> None:
    """Measure chains of up to 10 000 links."""
    use_one_core()
    use_double_precision()
    console = make_console()
    rows = [ours(links, "sparse", repeats) for links in SPARSE]
    rows += [ours(links, "dense", min(repeats, 3)) for links in DENSE]
    rows += [banded(links) for links in (10, 100, 1000, 10_000)]
    rows += [row for links in (10, 100, 1000) for row in by_mujoco(links)]
    rows += [whole_system(links, 4 * repeats) for links in (10, 100, 1000, 10_000)]
    console.print(table(rows))
    slopes = {"sparse": slope(rows, "sparse", 100), "dense": slope(rows, "dense", 32)}
    console.print(f"slopes: {slopes}")
    if json is not None:
        settings = {"tolerance": 1e-8, "steps": STEPS, "gradient_time": GRADIENT_TIME}
        content = {
            "environment": environment("klujax", "mujoco"),
            "settings": settings,
            "slopes": slopes,
        }
        write_json(json, {**content, "rows": rows})
    if plot is not None:
        write_figure(plot, rows)


if __name__ == "__main__":
    typer.run(main)
