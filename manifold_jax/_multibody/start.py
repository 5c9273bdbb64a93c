"""States of an assembly, from what a user says of some bodies."""

from collections.abc import Callable
from typing import Any

import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._base.types import Args
from .bodies import check_orientation, Pose
from .checks import check_shape, is_concrete, on_host, stack
from .closing import Closing
from .rotations import quaternion_rate


def make_state(
    assembly: Any, given: tuple, assemble: bool, t: Array, args: Args
) -> tuple[Pose, Pose]:
    y, kept = _with_given(assembly, given)
    known = all(is_concrete(leaf) for leaf in jtu.tree_leaves((y, assembly, t, args)))
    if not known and not assemble:
        return y
    closing = Closing(assembly, y, kept, t, args)
    if not known:
        return closing.assembled_when_run()
    if assemble:
        y = closing.assembled()
    closing.check(y)
    return y


def _with_given(
    assembly: Any, given: tuple
) -> tuple[tuple[Pose, Pose], tuple[np.ndarray, np.ndarray]]:
    """The state, and which of its coordinates and of their rates are given."""
    bodies = assembly.bodies
    q, planar = bodies.drawing, bodies.planar
    positions, orientations, velocities, spins = given
    d = 2 if planar else 3
    vector = lambda what, value: check_shape(what, value, (d,))
    turned = lambda what, value: check_orientation(what, value, planar)
    spin = (lambda what, value: check_shape(what, value, ())) if planar else vector
    x, has_x = _place(bodies, q.position, positions, "positions", vector)
    p, has_p = _place(bodies, q.orientation, orientations, "orientations", turned)
    still = np.zeros(q.coordinates.shape, q.coordinates.dtype)
    u, has_u = _place(bodies, still[:, :d], velocities, "velocities", vector)
    no_spin = still[:, 2] if planar else still[:, :3]
    w, has_w = _place(bodies, no_spin, spins, "angular_velocities", spin)
    rate = w if planar else quaternion_rate(p, w)
    widths = d, q.coordinates.shape[-1] - d
    kept = lambda *has: np.repeat(np.stack(has, axis=1), widths, axis=1)
    return (Pose(x, p), Pose(u, rate)), (kept(has_x, has_p), kept(has_u, has_w))


def _place(
    bodies: Any, rows: Any, words: Any, what: str, checked: Callable
) -> tuple[Array, np.ndarray]:
    """The rows with those that are given by name, and which are."""
    words = {} if words is None else words
    if not isinstance(words, dict):
        raise TypeError(f"`{what}` must be a dictionary of names of bodies, got {words!r}.")
    has = np.zeros(len(bodies.names), bool)
    rows = list(on_host(rows))
    for name, value in words.items():
        i = bodies.moving_index(name, f"`{what}`")
        rows[i], has[i] = checked(f"`{what}` of {name!r}", value), True
    return stack(rows), has
