"""A five-bar robot lifts a load with motors that are too weak to hold it on the way: torques by this library, and by
CasADi and IPOPT.

`python -m benchmarks.peers.optimal_control --json FILE --plot FILE`

From rest to rest in 0.6 s, 0.23 m up through the pose in which both rods are in one line, where no torque holds a load; at
most 1.4 N m. The torques of both, linear between 21 times, have the least integral of their squares; both start from the
same path, straight up. Each motion is then repeated with small steps, and in MuJoCo if that is installed.
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, use_double_precision, write_json
from . import _five_bar as robot


LAST, INTERVALS = 0.6, 20
LOW, HIGH, ACROSS = -0.33, -0.10, 0.06  # m: the tool


@dataclasses.dataclass(frozen=True)
class Row:
    """`first_s` includes compiling, or building the program. `drift` is the largest gap of the loop: for this library at
    the times and when the motion is repeated, for CasADi in its polynomials. `miss` is how far from the goal the tool ends
    when the torques are repeated with small steps; `miss_mujoco` and `gap_mujoco` are those of MuJoCo (all m)."""

    method: str
    status: str
    cost: float
    iterations: int
    first_s: float
    again_s: float
    drift: float
    miss: float
    miss_mujoco: float | None
    gap_mujoco: float | None
    inputs: list[list[float]]


def path() -> tuple[np.ndarray, np.ndarray]:
    """Return times, and the angles of the links for a tool that goes straight up."""
    ts = np.linspace(0, LAST, INTERVALS + 1)
    part = (ts / LAST) ** 2 * (3 - 2 * ts / LAST)
    heights = LOW + (HIGH - LOW) * part
    thetas = np.stack([robot.angles((ACROSS, height)) for height in heights])
    return ts, np.unwrap(thetas, axis=0)


def effort(t: Any, y: Any, u: Any) -> Any:
    return u @ u


class Task:
    """The robot at its start, whose inputs are its torques, and its goal."""

    def __init__(self) -> None:
        self.ts, self.thetas = path()
        self.plant = robot.assembly(self.thetas[0], lambda t, y, u: u)
        guess = robot.states(self.plant, self.thetas[0], self.thetas, self.ts)
        correct = lambda t, y: mj.consistent_state(
            self.plant.system.constraint, t, y, jnp.zeros(2), throw=False
        )
        self.states, _ = jax.vmap(correct)(jnp.asarray(self.ts), guess)
        self.start, self.goal = (jax.tree.map(lambda x, i=i: x[i], self.states) for i in (0, -1))

    def optimize(self) -> mj.OptimalTrajectory:
        return mj.optimize_trajectory(
            self.plant.system.terms,
            self.plant.system.constraint,
            self.ts,
            self.start,
            np.zeros((self.ts.size, 2)),
            cost=effort,
            goal=self.goal,
            bounds=(-robot.MOST, robot.MOST),
            states=self.states,
            throw=False,
        )

    def repeat(self, inputs: np.ndarray) -> dfx.Solution:
        """Solve with these torques and small steps."""
        law = lambda t: jax.vmap(lambda u: jnp.interp(t, self.ts, u), 1)(jnp.asarray(inputs))
        system = self.plant.system
        return mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: system.terms.vf(t, y, law(t))),
            mj.Projected(dfx.Dopri8(), system.constraint),
            0.0,
            LAST,
            None,
            self.start,
            jnp.zeros(2),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, LAST, 121)),
            stepsize_controller=dfx.ClipStepSizeController(
                dfx.PIDController(rtol=1e-10, atol=1e-10), jump_ts=jnp.asarray(self.ts[1:-1])
            ),
        )

    def tool(self, y: Any) -> np.ndarray:
        at = np.array([ACROSS, LOW])
        position, _ = self.plant.point(y, "left rod", tuple(at), drawn=True)
        return np.asarray(position)

    def gap(self, ys: Any) -> float:
        return max(float(np.abs(gap).max()) for gap in self.plant.gaps(ys[0]).values())


def measured(task: Task, inputs: np.ndarray) -> tuple[dict[str, Any], dfx.Solution]:
    motion, goal = task.repeat(inputs), np.array([ACROSS, HIGH])
    found: dict[str, Any] = dict(miss=float(np.linalg.norm(task.tool(_last(motion.ys)) - goal)))
    found |= dict(miss_mujoco=None, gap_mujoco=None, inputs=inputs.tolist())
    try:
        from ._five_bar_mujoco import replay

        tool, gap = replay(task.thetas[0], task.ts, inputs)
        found |= dict(miss_mujoco=float(np.linalg.norm(tool - goal)), gap_mujoco=gap)
    except ImportError:
        make_console().print("MuJoCo is not installed (extra `peers`): not repeated there.")
    return found, motion


def _last(ys: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[-1], ys)


def ours(task: Task) -> tuple[Row, dfx.Solution]:
    times = []
    for _ in range(2):  # with compiling, and without
        begin = time.perf_counter()
        found = task.optimize()
        times.append(time.perf_counter() - begin)
    inputs = np.asarray(found.inputs)
    values, motion = measured(task, inputs)
    drift = max(task.gap(found.ys), task.gap(motion.ys))
    counts = float(found.cost), int(found.num_iterations), *times
    status = found.message or "solved"
    return Row("optimize_trajectory", status, *counts, drift=drift, **values), motion


def casadi(task: Task) -> tuple[Row, dfx.Solution] | None:
    try:
        from ._five_bar_casadi import solve

        rates = np.gradient(task.thetas, task.ts, axis=0)
        rates[[0, -1]] = 0
        found = solve(task.ts, task.thetas, rates)
    except ImportError:
        make_console().print("CasADi is not installed (extra `peers`): skipped.")
        return None
    values, motion = measured(task, found.inputs)
    counts = found.cost, found.iterations, found.build_s + found.solve_s, found.again_s
    return Row("CasADi, IPOPT", found.status, *counts, drift=found.drift, **values), motion


def table_of(rows: list[Row]) -> Table:
    table = Table(title="A five-bar robot lifts 0.5 kg", title_justify="left")
    headings = (
        "method",
        "cost",
        "iterations",
        "first, s",
        "again, s",
        "drift m",
        "miss m",
        "MuJoCo: miss, gap m",
    )
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        replay = "" if row.miss_mujoco is None else f"{row.miss_mujoco:.1e}, {row.gap_mujoco:.1e}"
        counts = (
            f"{row.cost:.5f}",
            str(row.iterations),
            f"{row.first_s:.1f}",
            f"{row.again_s:.1f}",
        )
        table.add_row(row.method, *counts, f"{row.drift:.1e}", f"{row.miss:.1e}", replay)
    return table


def draw(task: Task, found: list[tuple[Row, dfx.Solution]], file: Path) -> None:
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (poses, torques) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    _, motion = found[0]
    for k in range(0, 121, 12):
        task.plant.draw(jax.tree.map(lambda leaf, k=k: leaf[k], motion.ys), ax=poses)
    poses.set(xlabel="x (m)", ylabel="y (m)", title="poses, 0.06 s apart")
    for line, (row, _) in zip(("-", "--"), found, strict=False):
        for motor, color in ((0, "C0"), (1, "C3")):
            label = f"{row.method}, {robot.MOTORS[motor]}"
            torques.plot(task.ts, np.array(row.inputs)[:, motor], color + line, label=label)
    torques.set(xlabel="time (s)", ylabel="torque (N m)")
    torques.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    figure.savefig(file, dpi=110)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the motion here.")] = None,
) -> None:
    """Optimize the motion by both, and repeat it."""
    use_double_precision()
    task = Task()
    found = [result for result in (ours(task), casadi(task)) if result is not None]
    rows = [row for row, _ in found]
    console = make_console()
    console.print(table_of(rows))
    for row in rows:
        console.print(f"{row.method}: {row.status}")
    if plot is not None:
        draw(task, found, plot)
    if json is not None:
        packages = environment("casadi", "mujoco")
        write_json(json, dict(environment=packages, rows=[dataclasses.asdict(row) for row in rows]))


if __name__ == "__main__":
    typer.run(main)
