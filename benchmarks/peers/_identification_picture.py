"""The picture of `benchmarks.peers.identification`: errors of all draws in standard errors."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np

from ._identification_task import NAMES


def draw(draws: Mapping[str, list[list[float]]], path: Path) -> None:
    """A column for each unknown, a point for each draw of the noise."""
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-1.96, 1.96, color="0.93", zorder=0)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    width = 0.8 / len(draws)
    for k, (name, errors) in enumerate(draws.items()):
        rows = np.asarray(errors)
        at = np.arange(len(NAMES)) + (k - (len(draws) - 1) / 2) * width
        x = np.broadcast_to(at, rows.shape)
        label = f"{name} ({len(rows)} draws)" if len(rows) > 1 else f"{name} (one draw)"
        axes.plot(x.ravel(), rows.ravel(), ".", markersize=5, alpha=0.7, label=label)
    axes.set_xticks(range(len(NAMES)), [name.replace("_", "\n") for name in NAMES])
    axes.set(ylabel="error / standard error", xlim=(-0.5, len(NAMES) - 0.5))
    axes.legend(ncols=len(draws), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.savefig(path, dpi=150)
