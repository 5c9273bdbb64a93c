"""A delta robot and a Stewart platform here and in MuJoCo, and parameters of the robot fitted.

`python -m benchmarks.peers.mechanisms_mujoco --json FILE --plot FILE`

Needs MuJoCo for its rows (`pip install mujoco`), with its best settings for this purpose: fourth-order
Runge-Kutta, the stiffest stable `solref`, `solimp` near 1, a tight Newton solver. Hinges are its own
coordinates there; what closes the loops are equalities: rods as tendons of fixed length, ball joints
of the platform as `connect`. Without friction: gaps of joints and the change of the energy should be
zero. The error is that of the platform's position at the end, against the independent reference.
"""

import dataclasses
import importlib.util
import time
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import environment, make_console, number, use_double_precision, write_json
from ._mechanisms_picture import draw


TIMESTEPS = (1e-3, 1e-4)
TOLERANCES = (1e-6, 1e-10)
MAX_STEPS = 512
SEEDS = 20  # draws of the noise
PLATFORM = {"delta-robot": 3, "stewart-platform": 0}  # its row in a `Pose`
OPTION = """
<mujoco><compiler angle="radian"/><option integrator="RK4" timestep="{h}" gravity="0 0 -{gravity}" solver="Newton" tolerance="1e-14"
iterations="100"><flag energy="enable" contact="disable"/></option>
<default><equality solref="{stiffness} 1" solimp="0.9999 0.9999 0.001 0.5 2"/></default>
<worldbody>{bodies}</worldbody>{rest}</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """Largest gap of a joint (m), largest change of the energy over the largest kinetic energy, error
    of the platform's position at the end (m), seconds for the run."""

    problem: str
    method: str
    gap: float
    energy: float
    error: float
    run_s: float


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A parameter of the delta robot from noisy positions of its platform."""

    name: str
    true: float
    fitted: float
    standard_error: float


def words(values: Any) -> str:
    return " ".join(f"{float(value):.17g}" for value in np.asarray(values))


def body(robot: Any, name: str, inside: str = "", frame: Any = (0.0, 0.0, 0.0)) -> str:
    """With axes as in space and its origin at the centre of mass, `frame` that of its parent."""
    i = robot.names.index(name)
    drawing = jax.tree.map(np.asarray, robot.bodies.drawing)
    inertia = np.asarray(robot.bodies.inertia[i])
    moments = np.diagonal(inertia)
    mass, at = float(robot.bodies.mass[i]), words(drawing.position[i] - np.asarray(frame))
    inertial = (
        f'<inertial pos="0 0 0" quat="{words(drawing.orientation[i])}" mass="{mass:.17g}" '
        f'diaginertia="{words(moments)}"/>'
    )
    return f'<body name="{name}" pos="{at}">{inertial}{inside}</body>'


def delta_model(problem: Problem, robot: Any, h: float) -> str:
    args = problem.args
    center = np.asarray(robot.bodies.drawing.position)
    bodies, sites, rods, ties = "", "", "", ""
    ends = robot.joints[1].attachment.points  # in the frames of arms and platform
    for i in range(3):
        radial = center[i] / np.linalg.norm(center[i])
        tangential = np.array([-radial[1], radial[0], 0.0])
        hinge = float(args.base_radius) * radial - center[i]
        turned = np.stack([radial, tangential, [0.0, 0.0, 1.0]], axis=1)
        inside = f'<joint type="hinge" pos="{words(hinge)}" axis="{words(tangential)}" stiffness="{float(args.stiffness)}"/>'
        for k in (2 * i, 2 * i + 1):
            inside += f'<site name="elbow {k}" pos="{words(turned @ np.asarray(ends[0][k]))}"/>'
            sites += f'<site name="wrist {k}" pos="{words(ends[1][k])}"/>'
            rods += f'<spatial name="rod {k}"><site site="elbow {k}"/><site site="wrist {k}"/></spatial>'
            ties += f'<tendon tendon1="rod {k}"/>'
        bodies += body(robot, robot.names[i], inside)
    bodies += body(robot, "platform", f"<freejoint/>{sites}")
    rest = f"<tendon>{rods}</tendon><equality>{ties}</equality>"
    return OPTION.format(
        h=h, gravity=float(args.gravity), stiffness=2 * h, bodies=bodies, rest=rest
    )


def stewart_model(problem: Problem, robot: Any, h: float) -> str:
    args = problem.args
    drawing = np.asarray(robot.bodies.drawing.position)
    geometry = import_module("manifold_jax.problems.stewart_platform")
    base, local, first_axes = geometry._points(np, jax.tree.map(np.asarray, args))
    ends = local + drawing[0]
    length, frames = geometry._legs(np, base, ends, first_axes)
    bodies, ties = body(robot, "platform", "<freejoint/>"), ""
    for i in range(6):
        lower, upper = 1 + 2 * i, 2 + 2 * i
        at = words(base[i] - drawing[lower])
        universal = "".join(
            f'<joint type="hinge" pos="{at}" axis="{words(axis)}"/>'
            for axis in (first_axes[i], frames[i, :, 0])
        )
        rest = float(args.rest_length) - length[i]
        slide = f'<joint type="slide" axis="{words(frames[i, :, 2])}" stiffness="{float(args.stiffness)}" springref="{rest:.17g}"/>'
        piston = body(robot, robot.names[upper], slide, drawing[lower])
        bodies += body(robot, robot.names[lower], universal + piston)
        anchor = words(ends[i] - drawing[upper])
        ties += f'<connect body1="{robot.names[upper]}" body2="platform" anchor="{anchor}"/>'
    return OPTION.format(
        h=h,
        gravity=float(args.gravity),
        stiffness=2 * h,
        bodies=bodies,
        rest=f"<equality>{ties}</equality>",
    )


def with_mujoco(problem: Problem, robot: Any, xml: str, h: float, scale: float) -> Row:
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    set_velocities(mujoco, model, data, problem, robot)
    mujoco.mj_forward(model, data)
    start, gap, change = float(np.sum(data.energy)), 0.0, 0.0
    begin = time.perf_counter()
    for _ in range(round(problem.t1 / h)):
        mujoco.mj_step(model, data)
        gap = max(gap, float(np.max(np.abs(data.efc_pos))))
        change = max(change, abs(float(np.sum(data.energy)) - start))
    seconds = time.perf_counter() - begin
    i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "platform")
    mujoco.mj_kinematics(model, data)
    error = np.linalg.norm(data.xipos[i] - end_of(problem))
    return Row(problem.name, f"MuJoCo, RK4, h = {h:g}", gap, change / scale, float(error), seconds)


def set_velocities(mujoco: Any, model: Any, data: Any, problem: Problem, robot: Any) -> None:
    """Those of all bodies at the start, in its coordinates."""
    rows, wanted = [], []
    for name in robot.names:
        i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        moving, turning = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBodyCom(model, data, moving, turning, i)
        state = robot.motion(problem.y0, name)
        rows += [moving, turning]
        wanted += [np.asarray(state.velocity), np.asarray(state.angular_velocity)]
    A, b = np.concatenate(rows), np.concatenate(wanted)
    data.qvel[:] = np.linalg.lstsq(A, b, rcond=None)[0]
    assert np.abs(A @ data.qvel - b).max() < 1e-10


def end_of(problem: Problem) -> np.ndarray:
    return problem.reference(problem.t1)[0].position[PLATFORM[problem.name]]


@eqx.filter_jit
def solve(system: Any, y0: Any, t1: Any, tolerance: Any) -> Any:
    """All steps."""
    return mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Dopri8(), system.constraint),
        0.0,
        t1,
        None,
        y0,
        saveat=dfx.SaveAt(t0=True, steps=True),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=MAX_STEPS,
    )


def with_projection(problem: Problem, robot: Any, tolerance: float) -> tuple[Row, float]:
    given = jnp.asarray(problem.t1), jnp.asarray(tolerance)
    run = lambda: solve(robot.system, problem.y0, *given)
    jax.block_until_ready(run())
    begin = time.perf_counter()
    sol = jax.block_until_ready(run())
    seconds = time.perf_counter() - begin
    taken = int(sol.stats["num_accepted_steps"]) + 1
    ys = jax.tree.map(lambda leaf: leaf[:taken], sol.ys)
    gaps = jax.vmap(robot.gaps)(ys[0])
    gap = max(float(np.max(np.abs(value))) for value in gaps.values())
    energy = robot.energy(ys)
    scale = float(np.max(energy.kinetic))
    change = float(np.max(np.abs(energy.total - energy.total[0]))) / scale
    at = np.asarray(ys[0].position[-1, PLATFORM[problem.name]])
    error = float(np.linalg.norm(at - end_of(problem)))
    method = f"projected Dopri8, tolerance {tolerance:g}"
    return Row(problem.name, method, gap, change, error, seconds), scale


class Seconds(NamedTuple):
    """Of a fit: by the clock and of the process with compiling, and by the clock of those after it,
    which are compiled already."""

    first: float
    process: float
    again: float


class Coverage(NamedTuple):
    """Of fits to several draws of the noise: how many of the estimates lie within two standard errors
    of the truth (about 95 % are expected), and of how many. Not all are independent: those of the
    lengths and of the mass of the arms move together."""

    within: int
    estimates: int


def fit_delta_robot() -> tuple[list[Fitted], Seconds, Coverage]:
    """Geometry and masses from positions of the platform with an error of 0.1 mm, for a second."""
    problem = mj.problems.delta_robot(t1=1.0)
    ts, sigma = np.linspace(0.025, 1.0, 40), 1e-4
    exact = problem.reference(ts)[0].position[:, 3]
    wrong = {"arm_length": 0.33, "rod_length": 0.84, "arm_mass": 0.4, "platform_mass": 1.15}

    def run(seed: int) -> list[Fitted]:
        data = exact + sigma * np.random.default_rng(seed).normal(size=exact.shape)
        found = mj.fit(problem, wrong, ts, data, observe=platform_position, sigma=sigma)
        return [
            Fitted(
                name,
                float(getattr(problem.args, name)),
                float(found.parameters[name]),
                float(found.standard_errors[name]),
            )
            for name in wrong
        ]

    begin, before = time.perf_counter(), time.process_time()
    rows = run(0)
    first, process = time.perf_counter() - begin, time.process_time() - before
    begin = time.perf_counter()
    every = [rows] + [run(seed) for seed in range(1, SEEDS)]
    again = (time.perf_counter() - begin) / (SEEDS - 1)
    errors = [abs(row.fitted - row.true) / row.standard_error for fit in every for row in fit]
    coverage = Coverage(sum(error <= 2 for error in errors), len(errors))
    return rows, Seconds(first, process, again), coverage


def platform_position(t: Any, y: Any, parameters: Any) -> Any:
    return y[0].position[3]


def result_table(rows: list[Row]) -> Table:
    table = Table(title="Mechanisms without friction", title_justify="left")
    for heading in ("problem", "method"):
        table.add_column(heading, no_wrap=True)
    for heading in ("largest gap, m", "energy error", "error at the end, m", "run, s"):
        table.add_column(heading, justify="right")
    for row in rows:
        numbers = (row.gap, row.energy, row.error)
        shown = (*(number(value, ".1e") for value in numbers), number(row.run_s, ".3g"))
        table.add_row(row.problem, row.method, *shown)
    return table


def fit_table(rows: list[Fitted], seconds: Seconds) -> Table:
    title = f"Delta robot from noisy positions of its platform, {seconds.first:.3g} s, compiled {seconds.again:.3g} s"
    table = Table(title=title, title_justify="left")
    for heading in ("parameter", "true", "fitted", "standard error", "errors away"):
        table.add_column(heading, justify="right")
    for row in rows:
        away = abs(row.fitted - row.true) / row.standard_error
        values = (row.true, row.fitted)
        shown = (*(f"{value:.6g}" for value in values), f"{row.standard_error:.1e}", f"{away:.2f}")
        table.add_row(row.name, *shown)
    return table


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
) -> None:
    """Compare joint gaps and energy with MuJoCo, if it is installed, and fit the delta robot."""
    use_double_precision()
    console = make_console()
    installed = importlib.util.find_spec("mujoco") is not None
    if not installed:
        console.print("MuJoCo is not installed (`pip install mujoco`): its rows are left out.")
    rows = []
    for problem, model in (
        (mj.problems.delta_robot(), delta_model),
        (mj.problems.stewart_platform(), stewart_model),
    ):
        module = import_module(f"manifold_jax.problems.{problem.name.replace('-', '_')}")
        robot, scale = module.assembly(problem.args), 1.0
        for tolerance in TOLERANCES:
            row, scale = with_projection(problem, robot, tolerance)
            rows.append(row)
        if installed:
            rows += [
                with_mujoco(problem, robot, model(problem, robot, h), h, scale) for h in TIMESTEPS
            ]
    console.print(result_table(rows))
    if plot is not None:
        draw(rows, plot)
    fitted, seconds, coverage = fit_delta_robot()
    console.print(fit_table(fitted, seconds))
    console.print(
        f"{coverage.within} of {coverage.estimates} estimates from {SEEDS} draws of the noise lie within two standard errors."
    )
    if json is not None:
        as_dict = lambda found: [dataclasses.asdict(row) for row in found]
        content = {
            "rows": as_dict(rows),
            "fit": as_dict(fitted),
            "fit_s": seconds._asdict(),
            "fit_coverage": coverage._asdict(),
        }
        write_json(json, {"environment": environment("mujoco"), **content})


if __name__ == "__main__":
    typer.run(main)
