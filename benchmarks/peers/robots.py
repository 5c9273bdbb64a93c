"""Robots with closed loops from their files: read, checked against Pinocchio and MuJoCo, swung and differentiated.

`OPENBLAS_NUM_THREADS=1 python -m benchmarks.peers.robots FOLDER --json FILE`

`FOLDER` is `robots` of a copy of https://github.com/Gepetto/example-parallel-robots. Springs in the
motors hold each robot near its drawing; without them light linkages fall into poses in which they fold.
There is no damping: gaps and the change of the energy should be zero. Accelerations are compared in a
random motion with those of one linear system in NumPy, of Pinocchio's tree and all loops
(`pip install pin`; skipped without it, and for files that change the types of joints), and at rest with those of
MuJoCo's masses and forces (`pip install mujoco`). `kangaroo_like` closes its loops as ball joints, not as the
welds of its file, which leave gaps. Several threads of OpenBLAS slow the large robots down where other programs run.
"""

import dataclasses
import time
from json import loads
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    number,
    use_double_precision,
    write_json,
)
from . import _robots_gradients as gradients
from ._robots_accelerations import compare, evaluations, soften


mb = mj.multibody
NAMES = (
    "5bar_linkage_iso6d",
    "wl16_like",
    "cassie_like",
    "talos_like",
    "disney_like",
    "robot_delta",
    "digit_like",
    "battobot_6d",
    "kangaroo_like",
)
AS_BALL_JOINTS = ("kangaroo_like",)
BY_REVERSE = ("5bar_linkage_iso6d", "talos_like")  # compiles for twice as long
SECONDS = 10.0
# In relation to the weight of the robot and 1 m; the cranks of Battobot's feet are light.
STIFFNESS, SOFTER = 20.0, {"battobot_6d": 1.0}
# s, in relation to the stiffness; less where cranks are light, for explicit steps of equal size.
DAMPING = 1e-2
LESS = {"battobot_6d": 5e-4, "disney_like": 1e-3, "digit_like": 1e-3, "robot_delta": 1e-3}
MAX_STEPS = 200_000


@dataclasses.dataclass(frozen=True)
class Row:
    """Solved and all equations, differences of accelerations from the independent ones (m/s^2) in motion
    (`difference`, of `largest`) and at rest, largest gap (m) and change of the energy over the largest kinetic
    energy, seconds to read, to compile, and of the run; `gradient` and `softly` as their classes say."""

    robot: str
    seconds: float
    stiffness: float
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
    compile_s: float
    run_s: float
    at_rest: dict[str, float]
    evaluation_ms: dict[str, float]
    softly: list[dict[str, Any] | None]
    gradient: dict[str, Any]


def main(
    folder: Annotated[Path, typer.Argument(help="The folder `robots` of the collection")],
    names: Annotated[str, typer.Option(help="Separated by commas")] = ",".join(NAMES),
    seconds: float = SECONDS,
    json: Annotated[
        Path | None, typer.Option(help="Write to this file; its other robots are kept")
    ] = None,
    gradients_alone: Annotated[
        bool, typer.Option(help="Measure only the gradients of robots in the file")
    ] = False,
) -> None:
    """Compare the robots of the collection."""
    use_double_precision()
    console, rows = make_console(), []
    for name in names.split(","):
        if not (folder / name / "robot.urdf").exists():
            console.print(f"{name} is not in {folder}: skipped")
            continue
        if gradients_alone:
            rows.append(with_gradient(folder, row_of(json, name)))
        else:
            rows.append(measure(folder, name, seconds))
        console.print(rows[-1])
        if json is not None:  # after each, as some take minutes
            write(json, dataclasses.asdict(rows[-1]))
    console.print(table(rows))


def row_of(json: Path | None, name: str) -> Row:
    rows = [] if json is None else loads(json.read_text())["rows"]
    return next(Row(**row) for row in rows if row["robot"] == name)


def write(json: Path, row: dict[str, Any]) -> None:
    kept = loads(json.read_text())["rows"] if json.exists() else []
    rows = [old for old in kept if old["robot"] != row["robot"]] + [row]
    rows.sort(key=lambda row: NAMES.index(row["robot"]) if row["robot"] in NAMES else len(NAMES))
    write_json(json, environment("pin", "mujoco") | dict(rows=rows))


def measure(folder: Path, name: str, seconds: float) -> Row:
    urdf, closures = folder / name / "robot.urdf", closures_of(folder, name)
    begin = time.perf_counter()
    robot = mb.read_urdf(urdf, closures=closures)
    reading = time.perf_counter() - begin
    difference, largest, programs = compare(urdf, closures, robot)
    rest, forward, softly = soften(urdf, closures, robot, stiffness_of(robot, name), seconds)
    machine = sprung(folder, name, 0.0)
    row = Row(
        robot=name,
        seconds=seconds,
        stiffness=SOFTER.get(name, STIFFNESS),
        **sizes(machine),
        difference=difference,
        largest=largest,
        read_s=reading,
        **swing(machine, seconds),
        at_rest=rest,
        evaluation_ms=evaluations(machine, programs | forward),
        softly=softly,
        gradient={},
    )
    return with_gradient(folder, row)


def with_gradient(folder: Path, row: Row) -> Row:
    """Return the row with derivatives in twice as many equal steps as the swing took."""
    steps = round(2 * gradients.SECONDS * row.steps / row.seconds)
    damped = sprung(folder, row.robot, LESS.get(row.robot, DAMPING))
    found = gradients.measure(damped, steps, row.robot in BY_REVERSE)
    return dataclasses.replace(row, gradient=dataclasses.asdict(found))


def sprung(folder: Path, name: str, damping: float) -> Any:
    """Return the mechanism with springs in its motors, and dampers of so many seconds times their stiffness."""
    urdf, closures = folder / name / "robot.urdf", closures_of(folder, name)
    robot = mb.read_urdf(urdf, closures=closures)
    stiffness = stiffness_of(robot, name)
    spring: Any = mb.JointSpring
    springs = [spring(motor, stiffness, damping=damping * stiffness) for motor in robot.motors]
    return mb.read_urdf(urdf, closures=closures, forces=springs).assembly


def stiffness_of(robot: Any, name: str) -> float:
    return 9.81 * float(jnp.sum(robot.assembly.bodies.mass)) * SOFTER.get(name, STIFFNESS)


def closures_of(folder: Path, name: str) -> dict[str, Any]:
    import yaml

    closures = yaml.safe_load((folder / name / "robot.yaml").read_text())
    if name in AS_BALL_JOINTS:
        closures["type"] = ["3d"] * len(closures["type"])
    return closures


def sizes(machine: Any) -> dict[str, int]:
    gaps, solved = machine.gaps(machine.state()[0]), machine.independent
    everything = sum(gap.shape[-1] for gap in gaps.values()) + len(machine.names)
    equations = everything if solved is None else len(solved.rows)
    motions = 7 * len(machine.names) - equations
    counts = len(machine.names), equations, everything, motions
    return dict(zip(("bodies", "equations", "all_equations", "motions"), counts, strict=True))


def swing(machine: Any, seconds: float) -> dict[str, Any]:
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

    y0, begin = machine.state(), time.perf_counter()
    program = solve.lower(y0).compile()
    ready = time.perf_counter()
    sol = jax.block_until_ready(program(y0))
    end = time.perf_counter()
    energy, gaps = machine.energy(sol.ys), machine.gaps(sol.ys[0])
    return dict(
        steps=int(sol.stats["num_accepted_steps"]),
        gap=max(float(jnp.max(jnp.abs(gap))) for gap in gaps.values()),
        energy=float(jnp.max(jnp.abs(energy.total - energy.total[0])) / jnp.max(energy.kinetic)),
        compile_s=ready - begin,
        run_s=end - ready,
    )


def table(rows: list[Row]) -> Table:
    columns = [
        "robot",
        "bodies",
        "equations",
        "accelerations",
        "steps",
        "gap",
        "energy",
        "compile s",
        "run s",
    ]
    found = Table(*columns, "ms", "gap, MuJoCo", "run s, MuJoCo", "gradient")
    for r in rows:
        sizes = str(r.bodies), f"{r.equations} of {r.all_equations}"
        off = (
            number(r.difference, ".1e"),
            str(r.steps),
            number(r.gap, ".1e"),
            number(r.energy, ".1e"),
        )
        times = number(r.compile_s, ".3g"), number(r.run_s, ".3g")
        each = " ".join(number(value, ".2g") for value in r.evaluation_ms.values())
        soft = [
            " ".join("failed" if s is None else number(s[word], ".1e") for s in r.softly)
            for word in ("gap", "run_s")
        ]
        gradient = number(r.gradient["forward"], ".1e")
        found.add_row(r.robot, *sizes, *off, *times, each, *soft, gradient)
    return found


if __name__ == "__main__":
    typer.run(main)
