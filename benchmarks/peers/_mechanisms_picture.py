"""The picture of `benchmarks.peers.mechanisms_mujoco`: a column for each mechanism."""

from pathlib import Path
from typing import Any

import matplotlib


SHOWN = (
    ("gap", "largest joint gap, m"),
    ("energy", "change of the energy / kinetic"),
    ("error", "error at the end, m"),
)


def draw(rows: list[Any], path: Path) -> None:
    matplotlib.use("Agg")
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    problems = list(dict.fromkeys(row.problem for row in rows))
    figure = Figure(figsize=(4 * len(problems) + 2, 8), layout="constrained")
    panels = figure.subplots(len(SHOWN), len(problems), squeeze=False, sharex="col", sharey="row")
    for column, problem in zip(panels.T, problems, strict=True):
        for axes, (field, _) in zip(column, SHOWN, strict=True):
            for method, marker in (("projected Dopri8", "o-"), ("MuJoCo, RK4", "s--")):
                own = [r for r in rows if r.problem == problem and r.method.startswith(method)]
                values = [(row.run_s, getattr(row, field)) for row in own]
                if values:
                    axes.plot(*zip(*sorted(values), strict=True), marker, label=method)
            axes.set(xscale="log", yscale="log")
            axes.grid(alpha=0.3)
            # Times span less than two powers of ten: one tick for each would say little.
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
        column[0].set_title(problem)
        column[-1].set_xlabel("run, s")
    for axes, (_, label) in zip(panels[:, 0], SHOWN, strict=True):
        axes.set_ylabel(label)
    panels[0, 0].legend()
    figure.savefig(path, dpi=150)
