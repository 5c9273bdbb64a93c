"""The picture of the rattleback's motion, the bicycle's, and the bicycle's eigenvalues."""

from pathlib import Path
from typing import Any

import numpy as np

from . import bicycle


def draw(path: Path, rattle: Any, bike: Any, speeds: np.ndarray, eigenvalues: np.ndarray) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    _rattleback(axes[0], rattle)
    _bicycle(axes[1], bike)
    _eigenvalues(axes[2], speeds, eigenvalues)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _rattleback(axes: Any, motion: Any) -> None:
    axes.plot(motion.times, motion.column("gamma"), label="angle [rad]")
    axes.plot(motion.times, motion.column("w3"), lw=0.8, label="spin [rad/s]")
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    axes.set(title="Rattleback: the spin reverses", xlabel="time [s]", ylim=(-8, 15))
    axes.legend()


def _bicycle(axes: Any, motion: Any) -> None:
    for name in ("lean", "steer"):
        axes.plot(motion.times, np.rad2deg(motion.column(name)), label=name)
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    axes.set(
        title="Bicycle at 5 m/s, pushed aside", xlabel="time [s]", ylabel="degrees", xlim=(0, 10)
    )
    axes.legend()


def _eigenvalues(axes: Any, speeds: np.ndarray, found: np.ndarray) -> None:
    parts = np.sort(found.real, axis=1)
    axes.plot(speeds, parts, color="C0", lw=1, label=["computed", *[None] * 3])
    for speed in range(11):
        published = bicycle.published(speed).real
        label = "published" if speed == 0 else None
        axes.plot(np.full(4, speed), published, "o", color="C1", ms=3.5, label=label)
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    axes.set(title="Bicycle: growth of small disturbances", xlabel="speed [m/s]", ylim=(-10, 6))
    axes.set_ylabel("real part of the eigenvalues [1/s]")
    axes.legend()
