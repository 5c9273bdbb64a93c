"""The same mechanism twice, without and with projection, as an animated picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..compare.approaches import Approach, known_approaches
from ..compare.task import as_rows, Task
from ..compare.with_diffrax import LAST_MAX_STEPS, solve_task, SOLVERS
from .motion import DrawnMotion
from .sketches import SKETCHES


_RATE, _DPI = 20, 75  # pictures per second, dots per inch
_SHOWN = {"plain": ("plain", "tab:red"), "projected": ("projected", "tab:blue")}


class Take(NamedTuple):
    """One approach: its name, lines `(times, points, 2)`, and `max |g|`, the largest violation of the
    constraint at each time; both infinite after the end of a solve that failed."""

    name: str
    lines: list[np.ndarray]
    violations: np.ndarray


def write_film(path: Path, task: Task, seconds: float) -> list[Take]:
    """Write the last `seconds` of the task, in real time, as a GIF."""
    times = task.t1 - seconds + np.arange(round(seconds * _RATE)) / _RATE
    shown = [one for one in known_approaches() if one.name in _SHOWN]
    takes = [_take(task, one, times) for one in shown if _applies(one, task)]
    matplotlib.use("Agg")
    figure = Figure(figsize=(7.2, 4.0), dpi=_DPI, layout="constrained")
    axes = figure.subplots(1, len(takes), sharex=True, sharey=True, squeeze=False)[0]
    artists = [_draw(ax, take) for ax, take in zip(axes, takes, strict=True)]
    _set_limits(axes[0], takes)
    title = figure.suptitle(task.problem.name)
    for _ in range(2):  # with equal scales one pass leaves no room for the labels below
        figure.draw_without_rendering()
    figure.set_layout_engine("none")  # only the mechanism moves

    def show(frame: int) -> list[Any]:
        title.set_text(f"{task.problem.name}, tolerance {task.rtol:g}, t = {times[frame]:.1f}")
        for take, (drawn, label) in zip(takes, artists, strict=True):
            for line, points in zip(drawn, take.lines, strict=True):
                line.set_data(*points[frame].T)
            label.set_text(f"max |g| = {take.violations[frame]:.1e}")
        return []

    animation = FuncAnimation(figure, show, frames=len(times))
    animation.save(path, PillowWriter(fps=_RATE), dpi=_DPI)
    return takes


def _take(task: Task, approach: Approach, times: np.ndarray) -> Take:
    problem = task.problem
    solve = approach.formulate(problem, SOLVERS[task.solver](), task.gain)

    def states(y0, args, ts):
        sol = solve_task(task, solve, y0, args, dfx.SaveAt(ts=ts), LAST_MAX_STEPS)
        return sol.ys, getattr(sol, "resets", None)

    ys, resets = jax.jit(states)(problem.y0, problem.args, jnp.asarray(times))
    motion = DrawnMotion(times, jtu.tree_map(np.asarray, ys[0]), problem.args, resets)
    lines = SKETCHES[problem.name](motion)
    return Take(approach.name, lines, task.violations(times, as_rows(ys)))


def _applies(approach: Approach, task: Task) -> bool:
    return approach.needs is None or approach.needs.is_met_by(task.problem)


def _draw(ax: Axes, take: Take) -> tuple[list[Any], Any]:
    name, color = _SHOWN[take.name]
    style = {"color": color, "linewidth": 3, "marker": "o", "markersize": 7}
    drawn = [ax.plot([], [], markeredgecolor="white", **style)[0] for _ in take.lines]
    ax.set_title(name)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)
    return drawn, ax.text(0.03, 0.03, "", transform=ax.transAxes, fontsize=9)


def _set_limits(ax: Axes, takes: Sequence[Take]) -> None:
    """Show both, but nothing farther than the size of the mechanism from the projected one."""
    lower, upper = _extent(takes[-1].lines)
    room = max(upper - lower) * np.array([[1.0], [-1.0]]) * [0.5, 0.5]
    seen = np.array([_extent(take.lines) for take in takes])
    lowest, highest = seen[:, 0].min(axis=0), seen[:, 1].max(axis=0)
    lowest, highest = np.maximum(lowest, lower - room[0]), np.minimum(highest, upper - room[1])
    margin = 0.06 * max(highest - lowest)
    ax.set_xlim(lowest[0] - margin, highest[0] + margin)
    ax.set_ylim(lowest[1] - margin, highest[1] + margin)


def _extent(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([line.reshape(-1, 2) for line in lines])
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), points.max(axis=0)
