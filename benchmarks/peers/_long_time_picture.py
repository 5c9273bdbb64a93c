"""The picture of `benchmarks.peers.long_times`."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np


COLORS = {
    "RATTLE 2": "C0",
    "RATTLE 4": "C1",
    "RATTLE 6": "C2",
    "symmetric 2": "C0",
    "symmetric 4": "C1",
    "symmetric 6": "C2",
    "projected Dopri5": "C3",
    "projected Dopri8": "C4",
    "SciPy DOP853": "C5",
    "jax-md": "C6",
}


def write_figure(path: Path, rows: list[dict[str, Any]], single: list[dict[str, Any]]) -> None:
    """Draw a panel for each problem, and one for single precision."""
    names = list(dict.fromkeys(row["problem"] for row in rows))
    height = (len(names) + 2) // 2
    size = (12, 3.5 * height)
    figure, axes = plt.subplots(height, 2, figsize=size, squeeze=False, layout="constrained")
    axes = axes.ravel()
    for axis, name in zip(axes, names, strict=False):
        own = [row for row in rows if row["problem"] == name]
        for row in own:
            draw(axis, row, row["method"], color=COLORS[row["method"]])
        axis.set_title(f"{name}: largest relative error of the {own[0]['observed']}")
    last = axes[len(names)]
    for row in single:
        words = "compensated" if row["compensated"] else "not compensated"
        color = "C0" if row["problem"] == names[0] else "C3"
        style = dict(color=color, linestyle="-" if row["compensated"] else ":")
        draw(last, row, f"{row['problem']}, {words}", **style)
    last.set_title("RATTLE 2 in single precision: error of positions")
    for axis in axes[: len(names) + 1]:
        axis.set_xlabel("time")
        axis.legend(fontsize=8)
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.3)
    for axis in axes[len(names) + 1 :]:
        axis.axis("off")
    figure.savefig(path, dpi=110)


def draw(axis: Any, row: dict[str, Any], label: str, **style: Any) -> None:
    times = row["end"] * np.arange(1, len(row["samples"]) + 1) / len(row["samples"])
    axis.loglog(times, row["samples"], label=label, **style)
