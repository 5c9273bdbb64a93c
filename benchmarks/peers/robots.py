"""Robots with closed loops from their files: read, checked against Pinocchio and NumPy, and swung.

`python -m benchmarks.peers.robots FOLDER --json FILE`

`FOLDER` is `robots` of a copy of https://github.com/Gepetto/example-parallel-robots. Springs in the
motors hold each robot near its drawing; without them light linkages fall into poses in which they fold.
There is no damping: gaps and the change of the energy should be zero. Accelerations are compared in a
random motion with those of one linear system in NumPy, of Pinocchio's tree and all loops
(`pip install pin`; skipped without it, and for files that change the types of joints). `battobot_6d` and
`kangaroo_like`, whose loops close as ball joints and not as the welds of its file, take too long to swing:
name them with few `--seconds`.
"""

import dataclasses
import importlib.util
import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, number, use_double_precision, write_json


mb = mj.multibody
NAMES = (
    "5bar_linkage_iso6d",
    "robot_delta",
    "cassie_like",
    "digit_like",
    "disney_like",
    "talos_like",
    "wl16_like",
)
AS_BALL_JOINTS = ("kangaroo_like",)
SECONDS = 10.0
STIFFNESS = 20.0  # in relation to the weight of the robot and 1 m
MAX_STEPS = 100_000


@dataclasses.dataclass(frozen=True)
class Row:
    """Solved and all equations, differences of accelerations (m/s^2), largest gap (m) and change of the
    energy over the largest kinetic energy, seconds to read, to compile, and of the run."""

    robot: str
    bodies: int
    equations: int
    all_equations: int
    motions: int
    difference: float | None
    largest: float | None
    steps: int
    gap: float
    energy: float
    read_s: float
    first_s: float
    run_s: float


def main(
    folder: Annotated[Path, typer.Argument(help="The folder `robots` of the collection")],
    names: Annotated[str, typer.Option(help="Separated by commas")] = ",".join(NAMES),
    seconds: float = SECONDS,
    json: Annotated[Path | None, typer.Option(help="Write the results to this file")] = None,
) -> None:
    """Compare the robots of the collection."""
    use_double_precision()
    console, rows = make_console(), []
    for name in names.split(","):
        if not (folder / name / "robot.urdf").exists():
            console.print(f"{name} is not in {folder}: skipped")
            continue
        rows.append(measure(folder, name, seconds))
        console.print(rows[-1])
        if json is not None:  # after each, as some take minutes
            content = dict(environment("pin"), seconds=seconds)
            write_json(json, content | dict(rows=[dataclasses.asdict(row) for row in rows]))
    console.print(table(rows))


def measure(folder: Path, name: str, seconds: float) -> Row:
    closures = closures_of(folder, name)
    read = lambda **more: mb.read_urdf(folder / name / "robot.urdf", closures=closures, **more)
    begin = time.perf_counter()
    robot = read()
    reading = time.perf_counter() - begin
    difference, largest = compare(folder / name / "robot.urdf", closures, robot)
    weight = 9.81 * float(jnp.sum(robot.assembly.bodies.mass))
    springs: list[Any] = [mb.JointSpring(motor, STIFFNESS * weight) for motor in robot.motors]  # pyright: ignore[reportCallIssue]
    machine = read(forces=springs).assembly
    first, run, sol = swing(machine, seconds)
    energy = machine.energy(sol.ys)
    gaps = machine.gaps(sol.ys[0])
    solved = machine.independent
    everything = sum(gap.shape[-1] for gap in gaps.values()) + len(machine.names)
    equations = everything if solved is None else len(solved.rows)
    return Row(
        name,
        len(machine.names),
        equations,
        everything,
        7 * len(machine.names) - equations,
        difference,
        largest,
        int(sol.stats["num_accepted_steps"]),
        max(float(jnp.max(jnp.abs(gap))) for gap in gaps.values()),
        float(jnp.max(jnp.abs(energy.total - energy.total[0])) / jnp.max(energy.kinetic)),
        reading,
        first,
        run,
    )


def closures_of(folder: Path, name: str) -> dict[str, Any]:
    import yaml

    closures = yaml.safe_load((folder / name / "robot.yaml").read_text())
    if name in AS_BALL_JOINTS:
        closures["type"] = ["3d"] * len(closures["type"])
    return closures


def swing(machine: Any, seconds: float) -> tuple[float, float, Any]:
    """Return the seconds of the first and of the second call, and the solution."""
    system = machine.system

    @eqx.filter_jit
    def solve(y0: Any) -> Any:
        return mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Dopri8(), system.constraint),
            0.0,
            seconds,
            None,
            y0,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, seconds, 101)),
            stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9),
            max_steps=MAX_STEPS,
        )

    times, y0, sol = [], machine.state(), None
    for _ in range(2):
        begin = time.perf_counter()
        sol = jax.block_until_ready(solve(y0))
        times.append(time.perf_counter() - begin)
    return times[0], times[1], sol


def compare(urdf: Path, closures: dict[str, Any], robot: Any) -> tuple[float | None, float | None]:
    """Return the largest difference of accelerations from the independent ones, and the largest of these."""
    if importlib.util.find_spec("pinocchio") is None or closures.get("joint_name"):
        return None, None
    from ._pinocchio import Tree

    tree, machine = Tree(urdf, closures), robot.assembly
    q = tree.coordinates(robot)
    v = tree.random_velocity(q, seed=0)
    centers = dict(zip(machine.names, np.asarray(machine.bodies.drawing.position), strict=True))
    motions = tree.of_points(q, v, tree.accelerations(q, v), centers)
    y = machine.state(
        velocities={name: motion[0] for name, motion in motions.items()},
        angular_velocities={name: motion[1] for name, motion in motions.items()},
    )
    found = eqx.filter_jit(machine.system.accelerations)(0.0, y, None).position
    expected = np.array([motions[name][2] for name in machine.names])
    return float(np.abs(found - expected).max()), float(np.abs(expected).max())


def table(rows: list[Row]) -> Table:
    columns = ["robot", "bodies", "equations", "motions", "accelerations", "steps", "gap", "energy"]
    found = Table(*columns, "read s", "first s", "run s")
    for r in rows:
        equations = f"{r.equations} of {r.all_equations}"
        values = (
            number(r.difference, ".1e"),
            str(r.steps),
            number(r.gap, ".1e"),
            number(r.energy, ".1e"),
        )
        times = (number(value, ".3g") for value in (r.read_s, r.first_s, r.run_s))
        found.add_row(r.robot, str(r.bodies), equations, str(r.motions), *values, *times)
    return found


if __name__ == "__main__":
    typer.run(main)
