"""The picture of `benchmarks.peers.approaches`: a column for each problem."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from manifold_jax._tools.compare.figure import STYLES

from ..peers._approach_results import Row


# A violation or an error of exactly zero is drawn here.
FLOOR = 1e-17


def write_figure(path: Path, rows: Sequence[Row], title: str) -> None:
    """Error over run time, and violation over tolerance."""
    matplotlib.use("Agg")
    problems = list(dict.fromkeys(row.problem for row in rows))
    width = 3.3 * len(problems) + 1.5
    figure = Figure(figsize=(width, 7.4), layout="constrained")
    panels = figure.subplots(2, len(problems), squeeze=False, sharey="row")
    lines: dict[str, Any] = {}
    for k, problem in enumerate(problems):
        solved = [row for row in rows if row.problem == problem and row.failure is None]
        for method in dict.fromkeys(row.method for row in solved):
            own = [row for row in solved if row.method == method]
            lines[method] = _draw(panels[0, k], own, "median_ms", "error")
            _draw(panels[1, k], own, "tolerance", "violation_output")
        _label(panels[0, k], problem, "run time (ms)")
        _label(panels[1, k], "", "tolerance")
        # from loose to tight, as the run times
        panels[1, k].invert_xaxis()
    panels[0, 0].set_ylabel("error of the state, max norm")
    panels[1, 0].set_ylabel("violation at output, max $|g|$")
    panels[1, 0].set_ylim(bottom=FLOOR)
    columns = min(len(lines), int(width / 1.5))
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _draw(axes: Axes, rows: Sequence[Row], across: str, up: str) -> Any:
    colour, line = STYLES[rows[0].method]
    (drawn,) = axes.loglog(
        [getattr(row, across) for row in rows],
        [max(getattr(row, up), FLOOR) for row in rows],
        color=colour,
        linestyle=line,
        linewidth=1.4,
        marker="o",
        markersize=3.5,
    )
    return drawn


def _label(axes: Axes, title: str, below: str) -> None:
    axes.set(title=title, xlabel=below)
    axes.grid(alpha=0.3)
