"""A pendulum and a four-bar linkage here and in MuJoCo, whose constraints are soft.

`python -m benchmarks.peers.mujoco_peers --json benchmarks/results/mujoco_peers.json`

Needs MuJoCo (`pip install mujoco`), with its best settings for this purpose: fourth-order
Runge-Kutta, the stiffest stable `solref`, `solimp` near 1, a tight Newton solver. Both sides
swing for ten seconds without friction; the gap of the joints and the change of the energy
should be zero.
"""

import dataclasses
import importlib.util
import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import environment, make_console, number, use_double_precision, write_json


SPAN, POINTS = 10.0, 1001
TIMESTEPS = (1e-3, 1e-4)
OPTION = """
<mujoco><option integrator="RK4" timestep="{h}" gravity="0 0 -{gravity}" solver="Newton" tolerance="1e-14"
iterations="100"><flag energy="enable" contact="disable"/></option>
<default><equality solref="{stiffness} 1" solimp="0.9999 0.9999 0.001 0.5 2"/></default>
<worldbody>{bodies}</worldbody><equality>{equality}</equality></mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """Largest gap of a joint (m), largest relative change of the energy, seconds for the run."""

    problem: str
    method: str
    gap: float
    energy: float
    run_s: float


def rod(mass: float, inertia: float, center: float) -> str:
    """A body along x whose turning about y has the inertia given; the others do not matter."""
    return (
        f'<inertial pos="{center} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
    )


def pendulum_model(problem: Problem, h: float) -> str:
    """A mass on a rod that is tied to the pivot by an equality, not by a joint: as in Cartesian
    coordinates. The inertia about the mass is that of a bob of 1 cm."""
    args = problem.args
    joints = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    body = rod(float(args.mass), float(args.mass) * 1e-4, float(args.length))
    bodies = f'<body name="rod">{joints}<joint type="hinge" axis="0 1 0"/>{body}</body>'
    equality = '<connect body1="rod" anchor="0 0 0"/>'
    return OPTION.format(
        h=h, gravity=float(args.gravity), stiffness=2 * h, bodies=bodies, equality=equality
    )


def four_bar_model(problem: Problem, h: float) -> str:
    """Crank, coupler and rocker hinged in a row, the loop closed by an equality."""
    args, q = problem.args, np.asarray(problem.y0[0])
    masses, lengths = np.asarray(args.masses), np.asarray(args.lengths)
    # The rocker of the gallery points from its pivot to the coupler, here it is the other way.
    angles = np.diff(q[2::3] + np.array([0, 0, np.pi]), prepend=0.0)
    bodies, closing = "", ""
    for i, name in enumerate(("crank", "coupler", "rocker")):
        offset = 0.0 if i == 0 else lengths[i - 1]
        # about -y, so that angles count as in the x-z plane here
        bodies += (
            f'<body name="{name}" pos="{offset} 0 0" axisangle="0 -1 0 {np.degrees(angles[i])}">'
            f'<joint type="hinge" axis="0 -1 0"/>{rod(masses[i], masses[i] * lengths[i] ** 2 / 12, lengths[i] / 2)}'
        )
        closing += "</body>"
    equality = f'<connect body1="rocker" anchor="{lengths[2]} 0 0"/>'
    return OPTION.format(
        h=h,
        gravity=float(args.gravity),
        stiffness=2 * h,
        bodies=bodies + closing,
        equality=equality,
    )


def with_mujoco(problem: Problem, xml: str, h: float) -> Row:
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    if problem.name == "four-bar":
        data.qvel[:] = np.diff(np.asarray(problem.y0[1])[2::3], prepend=0.0)
    mujoco.mj_forward(model, data)
    start, gap, change = float(np.sum(data.energy)), 0.0, 0.0
    begin = time.perf_counter()
    for _ in range(round(SPAN / h)):
        mujoco.mj_step(model, data)
        gap = max(gap, float(np.linalg.norm(data.efc_pos[:3])))
        change = max(change, abs(float(np.sum(data.energy)) - start))
    seconds = time.perf_counter() - begin
    return Row(problem.name, f"MuJoCo, RK4, h = {h:g}", gap, change / scale(problem), seconds)


def scale(problem: Problem) -> float:
    """The energy of a fall through the mechanism's size."""
    args = problem.args
    if problem.name == "pendulum":
        return float(args.mass * args.gravity * args.length)
    return float(jnp.sum(args.masses) * args.gravity * jnp.max(args.lengths))


def with_projection(problem: Problem, tolerance: float) -> Row:
    @jax.jit
    def run() -> Any:
        return mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Dopri8(), problem.constraint),
            0.0,
            SPAN,
            None,
            problem.y0,
            problem.args,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, SPAN, POINTS)),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=65536,
        ).ys

    jax.block_until_ready(run())
    begin = time.perf_counter()
    q, v = map(np.asarray, jax.block_until_ready(run()))
    seconds = time.perf_counter() - begin
    energy = energies(problem, q, v)
    change = np.max(np.abs(energy - energy[0])) / scale(problem)
    method = f"projected Dopri8, tolerance {tolerance:g}"
    return Row(problem.name, method, largest_gap(problem, q), float(change), seconds)


def energies(problem: Problem, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    args = jax.tree.map(np.asarray, problem.args)
    if problem.name == "pendulum":
        return args.mass * (0.5 * np.sum(v**2, -1) + args.gravity * q[:, 1])
    inertia = args.masses * args.lengths[:3] ** 2 / 12
    kinetic = args.masses * (v[:, 0::3] ** 2 + v[:, 1::3] ** 2) + inertia * v[:, 2::3] ** 2
    return np.sum(0.5 * kinetic + args.masses * args.gravity * q[:, 1::3], axis=1)


def largest_gap(problem: Problem, q: np.ndarray) -> float:
    """Distance between the two sides of a joint; for the pendulum, of the length of its rod."""
    args = jax.tree.map(np.asarray, problem.args)
    if problem.name == "pendulum":
        return float(np.max(np.abs(np.linalg.norm(q, axis=1) - args.length)))
    x, y, angle = q[:, 0::3], q[:, 1::3], q[:, 2::3]
    half = 0.5 * args.lengths[:3] * np.exp(1j * angle)
    center = x + 1j * y
    start, end = center - half, center + half
    gaps = [
        start[:, 0],
        end[:, 0] - start[:, 1],
        end[:, 1] - end[:, 2],
        start[:, 2] - args.lengths[3],
    ]
    return float(np.max(np.abs(gaps)))


def result_table(rows: list[Row]) -> Table:
    table = Table(title="Ten seconds without friction", title_justify="left")
    for heading in ("problem", "method"):
        table.add_column(heading, no_wrap=True)
    for heading in ("largest gap, m", "energy error", "run, s"):
        table.add_column(heading, justify="right")
    for row in rows:
        numbers = (number(row.gap, ".1e"), number(row.energy, ".1e"), number(row.run_s, ".3g"))
        table.add_row(row.problem, row.method, *numbers)
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
) -> None:
    """Compare loop gap and energy with MuJoCo, if it is installed."""
    use_double_precision()
    console = make_console()
    installed = importlib.util.find_spec("mujoco") is not None
    if not installed:
        console.print("MuJoCo is not installed (`pip install mujoco`): its rows are left out.")
    rows = []
    for problem, model in (
        (mj.problems.pendulum(), pendulum_model),
        (mj.problems.four_bar(), four_bar_model),
    ):
        rows += [with_projection(problem, tolerance) for tolerance in (1e-6, 1e-10)]
        if installed:
            rows += [with_mujoco(problem, model(problem, h), h) for h in TIMESTEPS]
    console.print(result_table(rows))
    if json is not None:
        content = [dataclasses.asdict(row) for row in rows]
        write_json(json, {"environment": environment("mujoco"), "rows": content})


if __name__ == "__main__":
    typer.run(main)
