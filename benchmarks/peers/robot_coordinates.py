"""Robots with closed loops in the coordinates of their joints, `mj.multibody.JointCoordinates`, beside the poses of
all bodies, the assembly itself.

`OPENBLAS_NUM_THREADS=1 python -m benchmarks.peers.robot_coordinates FOLDER --json FILE`

Robots and springs of `benchmarks.peers.robots`, swung for ten seconds. Accelerations in a random motion are compared
between both, and one evaluation of them is timed, also by Pinocchio (`pip install pin`; skipped without it,
and for files that change the types of joints).
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    environment,
    interleaved,
    make_console,
    number,
    use_double_precision,
    write_json,
)
from ._robots_accelerations import compare
from .robots import closures_of, MAX_STEPS, NAMES, SOFTER, STIFFNESS


mb = mj.multibody
SECONDS, TOLERANCE = 10.0, 1e-9


@dataclasses.dataclass(frozen=True)
class Swing:
    """The numbers of a state's positions and of the equations solved; milliseconds of one evaluation of all
    accelerations; of the solve its steps, the largest gap (m) and change of the energy over the largest kinetic
    energy, seconds to compile and of the run."""

    coordinates: int
    equations: int
    evaluation_ms: float
    steps: int
    gap: float
    energy: float
    compile_s: float
    run_s: float


@dataclasses.dataclass(frozen=True)
class Row:
    """`accelerations`: the largest difference between both in a random motion, of `largest` (m/s^2).
    `difference`: of all positions at the end (m)."""

    robot: str
    bodies: int
    accelerations: float
    largest: float
    difference: float
    poses: Swing
    joints: Swing
    pinocchio_ms: float | None


def main(
    folder: Annotated[Path, typer.Argument(help="The folder `robots` of the collection")],
    names: Annotated[str, typer.Option(help="Separated by commas")] = ",".join(NAMES),
    seconds: float = SECONDS,
    json: Annotated[Path | None, typer.Option(help="Write to this file")] = None,
) -> None:
    """Compare the two kinds of coordinates."""
    use_double_precision()
    console, rows = make_console(), []
    for name in names.split(","):
        if not (folder / name / "robot.urdf").exists():
            console.print(f"{name} is not in {folder}: skipped")
            continue
        rows.append(measure(folder, name, seconds))
        console.print(rows[-1])
        if json is not None:
            found = [dataclasses.asdict(row) for row in rows]
            write_json(json, environment("pin") | dict(seconds=seconds, rows=found))
    console.print(table(rows))


def measure(folder: Path, name: str, seconds: float) -> Row:
    urdf, closures = folder / name / "robot.urdf", closures_of(folder, name)
    robot = mb.read_urdf(urdf, closures=closures)
    weight = 9.81 * float(jnp.sum(robot.assembly.bodies.mass))
    spring: Any = mb.JointSpring
    springs = [spring(motor, weight * SOFTER.get(name, STIFFNESS)) for motor in robot.motors]
    machine = mb.read_urdf(urdf, closures=closures, forces=springs).assembly
    joints = mb.JointCoordinates(machine)
    y = in_motion(joints)
    in_poses, in_joints = machine.system, joints.system
    evaluate = eqx.filter_jit(lambda system, y: system.accelerations(0.0, y))
    poses = joints.poses(y)
    of_poses, of_joints = evaluate(in_poses, poses), evaluate(in_joints, y)
    _, found = jax.jvp(lambda y: joints.poses(y)[1].position, (y,), ((y[1], of_joints),))
    _, _, others = compare(urdf, closures, robot)
    own = {
        "poses": lambda: jax.block_until_ready(evaluate(in_poses, poses)),
        "joints": lambda: jax.block_until_ready(evaluate(in_joints, y)),
    }
    times = {name: timing.median_ms for name, timing in interleaved(own | others, 50).items()}
    begin = {"poses": (in_poses, machine.state()), "joints": (in_joints, joints.state())}
    swings, ends = {}, {}
    for kind, (system, y0) in begin.items():
        read = (lambda y: y) if kind == "poses" else joints.poses
        swings[kind], ends[kind] = swing(machine, system, y0, read, times[kind], seconds)
    return Row(
        robot=name,
        bodies=len(machine.names),
        accelerations=float(jnp.max(jnp.abs(found - of_poses.position))),
        largest=float(jnp.max(jnp.abs(found))),
        difference=float(jnp.max(jnp.abs(ends["poses"] - ends["joints"]))),
        pinocchio_ms=times.get("pinocchio"),
        **swings,
    )


def in_motion(joints: Any) -> tuple[jax.Array, jax.Array]:
    """Return the drawing with random velocities that the loops allow."""
    q, _ = joints.state()
    J = np.asarray(eqx.filter_jit(joints.system.holonomic.jacobian)(0.0, q, None))
    free = scipy.linalg.null_space(J)
    return q, jnp.asarray(free @ np.random.default_rng(0).normal(size=free.shape[1]))


def swing(
    machine: Any, system: Any, y0: Any, read: Callable, evaluation_ms: float, seconds: float
) -> tuple[Swing, jax.Array]:
    """Return what is measured, and the positions at the end."""

    @eqx.filter_jit
    def solve(y0: Any) -> Any:
        return mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Dopri8(), system.constraint),
            0.0,
            seconds,
            None,
            y0,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, seconds, 11)),
            stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=MAX_STEPS,
        )

    begin = time.perf_counter()
    program = solve.lower(y0).compile()
    ready = time.perf_counter()
    sol = jax.block_until_ready(program(y0))
    end = time.perf_counter()
    ys = read(sol.ys)
    energy, gaps = machine.energy(ys), machine.gaps(ys[0])
    measured = Swing(
        coordinates=jax.flatten_util.ravel_pytree(y0[0])[0].size,
        equations=jax.eval_shape(system.holonomic.jacobian, 0.0, y0[0], None).shape[0],
        evaluation_ms=evaluation_ms,
        steps=int(sol.stats["num_accepted_steps"]),
        gap=max(float(jnp.max(jnp.abs(gap))) for gap in gaps.values()),
        energy=float(jnp.max(jnp.abs(energy.total - energy.total[0])) / energy.kinetic.max()),
        compile_s=ready - begin,
        run_s=end - ready,
    )
    return measured, ys[0].position[-1]


def table(rows: list[Row]) -> Table:
    found = Table("robot", "bodies", "accelerations", "at the end", "", "coordinates", "equations")
    for column in ("ms", "Pinocchio", "steps", "gap", "energy", "compile s", "run s"):
        found.add_column(column)
    for row in rows:
        for kind, own in (("poses", row.poses), ("joints", row.joints)):
            found.add_row(
                row.robot,
                str(row.bodies),
                number(row.accelerations, ".1e"),
                number(row.difference, ".1e"),
                kind,
                str(own.coordinates),
                str(own.equations),
                number(own.evaluation_ms, ".2g"),
                number(row.pinocchio_ms, ".2g"),
                str(own.steps),
                number(own.gap, ".1e"),
                number(own.energy, ".1e"),
                number(own.compile_s, ".3g"),
                number(own.run_s, ".3g"),
            )
    return found


if __name__ == "__main__":
    typer.run(main)
