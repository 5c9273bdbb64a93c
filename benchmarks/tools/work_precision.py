"""The picture of `benchmarks.peers.approaches`: two panels for each problem, one above the other."""

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
# So many problems are next to each other: the picture can be read where pages have 768 pixels.
ABREAST = 3


def write_figure(path: Path, rows: Sequence[Row], title: str) -> None:
    """Error over run time, and violation over tolerance."""
    matplotlib.use("Agg")
    problems = list(dict.fromkeys(row.problem for row in rows))
    abreast, deep = min(ABREAST, len(problems)), -(-len(problems) // ABREAST)
    figure = Figure(figsize=(3 * abreast + 1.2, 6 * deep + 0.8), layout="constrained")
    panels = figure.subplots(2 * deep, abreast, squeeze=False, sharey="row")
    for spare in panels.ravel()[2 * abreast * (len(problems) // abreast) :]:
        spare.set_visible(False)
    lines: dict[str, Any] = {}
    for k, problem in enumerate(problems):
        upper, lower = panels[2 * (k // abreast) : 2 * (k // abreast) + 2, k % abreast]
        solved = [row for row in rows if row.problem == problem and row.failure is None]
        for panel in (upper, lower):
            panel.set_visible(True)
        for method in dict.fromkeys(row.method for row in solved):
            own = [row for row in solved if row.method == method]
            lines[method] = _draw(upper, own, "median_ms", "error")
            _draw(lower, own, "tolerance", "violation_output")
        _label(upper, problem, "run time (ms)")
        _label(lower, "", "tolerance")
        # from loose to tight, as the run times
        lower.invert_xaxis()
    for upper, lower in panels[:, 0].reshape(-1, 2):
        upper.set_ylabel("error of the state, max norm")
        lower.set_ylabel("violation at output, max $|g|$")
        lower.set_ylim(bottom=FLOOR)
    columns = min(len(lines), 2 * abreast)
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
