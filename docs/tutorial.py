"""Draw the picture of the tutorial from the code of its page: `python docs/tutorial.py`."""

import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure


PAGES = Path(__file__).parent / "pages"


def main() -> None:
    matplotlib.use("Agg")
    text = (PAGES / "tutorial.md").read_text()
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(block, names)  # the page is ours
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    crane, tension = figure.subplots(1, 2, width_ratios=(3, 2))
    draw_crane(crane, names)
    tension.plot(names["times"], names["tension"], color="#D55E00")
    tension.set(xlabel="time (s)", ylabel="tension of the cable (N)")
    figure.savefig(PAGES / "tutorial.png", dpi=110)


def draw_crane(ax: Axes, names: dict[str, Any]) -> None:
    """Draw the start with the names of its parts, two later positions, and what was filmed."""
    trolley, load = (np.asarray(names["q"][name]) for name in ("trolley", "load"))
    ax.plot([-1.6, 1.6], [0, 0], color="0.6", linewidth=5, zorder=0)
    for frame, alpha in ((14, 0.3), (7, 0.3), (0, 1.0)):
        ends = np.stack([trolley[frame], load[frame]])
        ax.plot(*ends.T, color="#0072B2", alpha=alpha)
        ax.plot(*ends[0], "s", color="#0072B2", markersize=14, alpha=alpha)
        ax.plot(*ends[1], "o", color="#0072B2", markersize=10, alpha=alpha)
    coil = np.linspace(0, 1, 200)
    ax.plot(-1.6 + 1.5 * coil, 0.09 * np.sin(18 * np.pi * coil), color="0.3", linewidth=1)
    ax.plot([-1.6, -1.6], [-0.25, 0.25], color="black", linewidth=3)
    ax.plot(*np.asarray(names["seen"]).T, ".", color="#D55E00", markersize=2, zorder=0)
    labels = {
        "spring": (-1.1, 0.2),
        "trolley": (0.15, 0.2),
        "rail": (1.3, 0.15),
        "cable": (0.62, -0.7),
    }
    for label, place in (labels | {"load, as filmed": (-0.5, -1.7)}).items():
        ax.annotate(label, place, fontsize=9)
    ax.set_aspect("equal")
    ax.set(xlim=(-1.7, 1.7), ylim=(-2.2, 0.45), xlabel="x (m)", ylabel="y (m)")


if __name__ == "__main__":
    main()
