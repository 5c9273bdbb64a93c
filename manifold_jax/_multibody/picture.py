"""Pictures of an assembly, from the points of its joints and forces, and of named markers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._base.extras import require
from .frames import Placed, with_ground
from .joints import Distance
from .loads import AbstractLoads, LineLoads


# Right and up in the picture of a mechanism in space, seen from the front and a little from above.
VIEW = np.array([[0.94, 0.17], [-0.34, 0.47], [0.0, 0.87]])
_COLORS = [f"C{i}" for i in range(10)]
_RATE = 20  # pictures per second


class Outline(NamedTuple):
    """Lines of a picture over the times, `(times, points, 2)`: of bodies, of massless rods and of springs; the
    points on the ground, and the paths of markers by name."""

    bodies: list[np.ndarray]
    rods: list[np.ndarray]
    springs: list[np.ndarray]
    ground: np.ndarray
    markers: dict[str, np.ndarray]


def outline_of(assembly: Any, y: Any, markers: Mapping[str, tuple[str, Any]] | None) -> Outline:
    """Return the lines of an assembly in the states `y`, with or without a leading axis for times."""
    q = y[0].coordinates
    if q.ndim == 2:
        y = jax.tree_util.tree_map(lambda x: x[None], y)
        q = q[None]
    placed = Placed.of(jax.vmap(with_ground)(q))
    origin, rotation = map(np.asarray, placed)
    seen = (lambda x: x[..., :2]) if assembly.bodies.planar else (lambda x: x @ VIEW)
    at = lambda body, local: origin[:, body] + rotation[:, body] @ np.asarray(local)
    rods, springs = [], []
    points: list[list[np.ndarray]] = [[] for _ in range(origin.shape[1])]
    for group in (*assembly.joints, *assembly.loads):
        attachment = getattr(group, "attachment", None)
        if attachment is None:
            continue
        for k, pair in enumerate(zip(*attachment.bodies, strict=True)):
            ends = [at(body, attachment.points[side, k]) for side, body in enumerate(pair)]
            if isinstance(group, LineLoads):
                springs.append(seen(np.stack(ends, axis=1)))
            elif not isinstance(group, AbstractLoads) and group.kind is Distance:
                rods.append(seen(np.stack(ends, axis=1)))
            for side, body in enumerate(pair):
                points[body].append(ends[side])
    *moving, fixed = points
    bodies = [_body_line(origin[:, i], own, assembly.bodies.planar) for i, own in enumerate(moving)]
    paths = {
        label: np.asarray(assembly.point(y, name, where, drawn=True)[0])
        for label, (name, where) in (markers or {}).items()
    }
    nowhere = np.zeros((0, origin.shape[2]))
    ground = np.stack(fixed, axis=1)[0] if fixed else nowhere
    seen_paths = {label: seen(path) for label, path in paths.items()}
    return Outline([seen(line) for line in bodies], rods, springs, seen(ground), seen_paths)


def _body_line(center: np.ndarray, points: list[np.ndarray], planar: bool) -> np.ndarray:
    """Return the line of a body over the times: between two points, around several in the plane, and in
    space from the centre of mass to each."""
    apart = []
    for point in points:  # where joints coincide there is one point
        if all(np.max(np.abs(point - other)) > 1e-9 for other in apart):
            apart.append(point)
    if len(apart) < 2:
        return np.stack([center, *apart], axis=1)
    if len(apart) == 2:
        return np.stack(apart, axis=1)
    if planar:
        ends = np.stack(apart, axis=1)
        around = ends[0, :, :2] - ends[0, :, :2].mean(axis=0)
        order = np.argsort(np.arctan2(around[:, 1], around[:, 0]))
        return ends[:, [*order, order[0]]]
    return np.stack([part for point in apart for part in (center, point)], axis=1)


def draw_outline(outline: Outline, ax: Any, frame: int) -> list[Any]:
    """Draw one of the states, and the whole paths of the markers, and return what moves."""
    if hasattr(ax, "get_zlim"):
        raise ValueError(
            "`ax` must be axes with two dimensions, such as those of `plt.subplots()`: mechanisms in space are drawn as they are seen."
        )
    artists = []
    for line, color in zip(outline.bodies, _COLORS * len(outline.bodies), strict=False):
        artists += ax.plot(*line[frame].T, "o-", color=color, linewidth=3, markersize=5)
    for line in outline.rods:
        artists += ax.plot(*line[frame].T, "o-", color="0.3", linewidth=1.5, markersize=3)
    for line in outline.springs:
        artists += ax.plot(*line[frame].T, ":", color="0.3", linewidth=1.5)
    ax.plot(*outline.ground.T, "k^", markersize=8)
    for label, path in outline.markers.items():
        ax.plot(*path.T, color="0.6", linewidth=1, zorder=0)
        artists += ax.plot(*path[[frame]].T, "ks", markersize=5)
        artists.append(ax.annotate(label, path[frame], (5, 5), textcoords="offset points"))
    ax.set_aspect("equal")
    return artists


def new_axes() -> Any:
    """Return the axes of a new figure, which notebooks show."""
    require("matplotlib", "cli", "A picture")
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def write_film(outline: Outline, path: Any, seconds: float) -> None:
    """Write the states in equal intervals over so many seconds as a GIF."""
    require("matplotlib", "cli", "A film")
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"`path` must end in .gif, got {str(path)!r}.")
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.figure import Figure

    count = len(outline.bodies[0])
    frames = np.linspace(0, count - 1, max(2, round(seconds * _RATE))).round().astype(int)
    figure = Figure(figsize=(5, 4), dpi=80, layout="constrained")
    ax = figure.add_subplot()
    lines = [*outline.bodies, *outline.rods, *outline.springs, *outline.markers.values()]
    every = np.concatenate([*(line.reshape(-1, 2) for line in lines), outline.ground])
    lower, upper = every.min(axis=0), every.max(axis=0)
    margin = 0.05 * max(upper - lower)

    def show(frame: int) -> list[Any]:
        ax.clear()
        artists = draw_outline(outline, ax, frame)
        ax.set(xlim=(lower[0] - margin, upper[0] + margin))
        ax.set(ylim=(lower[1] - margin, upper[1] + margin))
        return artists

    FuncAnimation(figure, show, frames=frames.tolist()).save(path, PillowWriter(fps=_RATE))
