"""Sketches of the mechanisms in space, seen from the front and a little from above."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..._multibody.picture import VIEW
from ...problems.delta_robot import DIRECTIONS, SPREAD
from ...problems.stewart_platform import AT_BASE, AT_PLATFORM, CENTER
from .motion import DrawnMotion, Lines


def _seen(*lines: np.ndarray) -> Lines:
    return [line @ VIEW for line in lines]


def _between(*points: np.ndarray) -> np.ndarray:
    """Return the line through points `(times, 3)`, or `(3,)` if they do not move."""
    return np.stack(np.broadcast_arrays(*points), axis=-2)


def _closed(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, points[:, :1]], axis=1)


def _carried(motion: DrawnMotion, body: int, local: np.ndarray) -> np.ndarray:
    """Return the places of points `(points, 3)` of a body: its position and quaternion are `q`."""
    position, quaternion = motion.q.position[:, body], motion.q.orientation[:, body]
    turns = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return position[:, None] + local @ np.swapaxes(turns, 1, 2)


def sketch_rod(motion: DrawnMotion) -> Lines:
    return _seen(_between(np.zeros(3), motion.q))


def sketch_rotating_hoop(motion: DrawnMotion) -> Lines:
    """Draw the hoop, its stop, and the bead as a small ring."""
    R, turned = float(motion.args.radius), float(motion.args.rate) * motion.times
    outwards = np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=1)[:, None]

    def on_hoop(angles: Any, radius: Any) -> np.ndarray:
        sin, cos = (np.reshape(radius * f(angles), (-1, 1)) for f in (np.sin, np.cos))
        return sin * outwards - cos * np.array([0.0, 0.0, 1.0])

    tick = on_hoop(float(motion.args.stop), R * np.array([0.88, 1.12]))
    around = np.linspace(0, 2 * np.pi, 33)
    ring = 0.04 * R * np.stack([np.cos(around[::4]), np.sin(around[::4])], axis=1)
    return [*_seen(on_hoop(around, R), tick), (motion.q @ VIEW)[:, None] + ring]


def sketch_beads(motion: DrawnMotion) -> Lines:
    return _seen(motion.q)


def sketch_cable_net(motion: DrawnMotion) -> Lines:
    rows, columns = motion.q.shape[1:3]
    along = [motion.q[:, i] for i in range(rows)]
    return _seen(*along, *(motion.q[:, :, j] for j in range(columns)))


def sketch_delta_robot(motion: DrawnMotion) -> Lines:
    """Draw arms, the parallel rods, and the platform through their ends."""
    L, r = float(motion.args.arm_length), float(motion.args.platform_radius)
    aside = SPREAD * r
    lines, wrists = [], []
    for arm, angle in enumerate(DIRECTIONS):
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = aside * np.array([-radial[1], radial[0], 0.0])
        sides = np.array([[-L / 2, 0, 0], [L / 2, 0, 0], [L / 2, aside, 0], [L / 2, -aside, 0]])
        hinge, elbow, *elbows = np.moveaxis(_carried(motion, arm, sides), 1, 0)
        ends = np.moveaxis(
            _carried(motion, 3, np.stack([r * radial + across, r * radial - across])), 1, 0
        )
        lines += [_between(hinge, elbow), _between(*elbows)]
        lines += [_between(*pair) for pair in zip(elbows, ends, strict=True)]
        wrists += [ends[1], ends[0]]
    return _seen(*lines, _closed(np.stack(wrists, axis=1)))


def sketch_stewart_platform(motion: DrawnMotion) -> Lines:
    """Draw base and platform, and of each leg the cylinder from below and the piston from above."""
    size = float(motion.args.platform_radius)
    circle = lambda angles: np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1)
    base = np.broadcast_to(
        float(motion.args.base_radius) * circle(AT_BASE), (len(motion.times), 6, 3)
    )
    lines = [_closed(base), _closed(_carried(motion, 0, size * circle(AT_PLATFORM)))]
    reach = CENTER * size
    for leg in range(6):
        from_below = np.array([[0.0, 0.0, -reach], [0.0, 0.0, 2 * reach]])
        lines += [
            _carried(motion, 1 + 2 * leg, from_below),
            _carried(motion, 2 + 2 * leg, -from_below),
        ]
    return _seen(*lines)
