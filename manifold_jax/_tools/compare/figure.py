"""A picture of a comparison: the trajectory, the violation and the error over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax.tree_util as jtu
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from .approaches import Style
from .methods import Measurement, METHODS
from .task import Task


# Black is the solution.
STYLES: dict[str, Style] = {method.key: method.style for method in METHODS}
# A violation or an error of exactly zero is drawn here.
FLOOR = 1e-17
# Curves show the largest value in each of this many intervals: rounding errors and changes of sign
# would fill the panels.
INTERVALS = 100

# Measurements without failures, with the styles of their curves.
Solved: TypeAlias = Sequence[tuple[Any, dict[str, Any]]]


def write_figure(path: Path, task: Task, measurements: Sequence[Measurement]) -> None:
    matplotlib.use("Agg")
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    shape = np.shape(jtu.tree_leaves(task.problem.y0)[0])
    first = figure.add_subplot(1, 3, 1, projection="3d" if shape == (3,) else None)
    second, third = figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)
    solved = [(m, _style(m.key)) for m in measurements if not m.failure]
    if shape in ((2,), (3,)):
        _draw_path(first, task, solved, shape[0])
    else:
        _draw_components(first, task, solved, int(np.prod(shape)))
    lines = _draw_violations(second, task, solved)
    _draw_errors(third, task, solved)
    names, columns = [m.row.method for m, _ in solved], min(max(len(solved), 1), 6)
    figure.legend(lines, names, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(f"{task.problem.name}, rtol = {task.rtol:g}, atol = {task.atol:g}")
    figure.savefig(path, dpi=150)


def _style(key: str) -> dict[str, Any]:
    colour, line = STYLES[key]
    return dict(color=colour, linestyle=line, linewidth=1.2, zorder=1 if "scipy" in key else 2)


def _draw_path(axes: Axes, task: Task, solved: Solved, dimension: int) -> None:
    """Draw the first leaf as a curve in the plane or in space."""
    # Nested, the first the widest: usually the curves look the same.
    for i, (measurement, style) in enumerate(solved):
        width = 1 + 0.7 * (len(solved) - 1 - i)
        axes.plot(*measurement.states[:, :dimension].T, color=style["color"], linewidth=width)
    known = task.reference()
    if known is not None:
        curve = known[1][:, :dimension].T
        at_end = curve.shape[1] == 1
        style, label = ("o", "solution at the end") if at_end else (":", "solution")
        axes.plot(*curve, style, color="black", linewidth=1, markersize=5, label=label)
        axes.legend(loc="upper right", frameon=False, fontsize="small")
    axes.set(xlabel="$y_1$", ylabel="$y_2$", title="trajectory")
    if isinstance(axes, Axes3D):
        axes.set_zlabel("$y_3$")
        axes.locator_params(nbins=4)
        axes.set_box_aspect(None, zoom=0.85)  # pyright: ignore
        return
    extents = np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    # a circle should look like one, but quantities of different size need their own scales
    if np.max(extents) < 3 * np.min(extents):
        axes.set_aspect("equal", adjustable="datalim")


def _draw_components(axes: Axes, task: Task, solved: Solved, count: int) -> None:
    """Draw the first leaf over time, if it has too many components for a curve.

    For one method only, as the lines of several could not be told apart; the other panels show the
    differences.
    """
    if not solved:
        return
    measurement, _ = next((s for s in solved if s[0].key == "projected"), solved[0])
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, count))
    for i in range(count):
        axes.plot(task.grid, measurement.states[:, i], color=colours[i], linewidth=1)
    axes.set(xlabel="$t$", title=f"components, {measurement.row.method}")


def _draw_violations(axes: Axes, task: Task, solved: Solved) -> list:
    lines = []
    for m, style in solved:
        lines += axes.semilogy(*_largest_in_intervals(task.grid, m.violations), **style)
    axes.set(xlabel="$t$", title="violation, max $|g|$")
    axes.grid(alpha=0.3)
    return lines


def _draw_errors(axes: Axes, task: Task, solved: Solved) -> None:
    axes.grid(alpha=0.3)
    axes.set(xlabel="$t$", title="error of the state, max norm")
    if task.reference() is None:
        note = "solution not known\nfor this time span"
        axes.text(0.5, 0.5, note, ha="center", va="center", transform=axes.transAxes)
    elif task.problem.reference_at_end_only:
        for i, (m, style) in enumerate(solved):
            axes.semilogy(i, max(m.row.error, FLOOR), "o", color=style["color"], markersize=8)
        names = [m.key for m, _ in solved]
        axes.set(xlabel="", xlim=(-1, len(solved)))
        axes.set_xticks(range(len(solved)), names, rotation=90, fontsize="small")
        axes.set_title(f"error of the state at t = {task.t1:g}, max norm")
    elif solved:
        curves = [_largest_in_intervals(m.error_times, m.errors) for m, _ in solved]
        for curve, (_, style) in zip(curves, solved, strict=True):
            axes.semilogy(*curve, **style)
        # The start is exact: seen in full, it would press everything else together.
        errors = np.concatenate([errors for _, errors in curves])
        axes.set_ylim(bottom=max(np.quantile(errors, 0.01) / 10, FLOOR))


def _largest_in_intervals(times: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of the intervals, and the largest value in each."""
    middles = [np.mean(part) for part in np.array_split(times, INTERVALS)]
    largest = [np.max(part) for part in np.array_split(values, INTERVALS)]
    return np.array(middles), np.maximum(largest, FLOOR)
