"""From the coordinates of a spanning tree to the poses of all bodies, and back."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .bodies import Pose
from .frames import Frames, Placed, with_ground
from .rotations import (
    about,
    compose,
    conjugate,
    dot,
    multiply_quaternions,
    quaternion_about,
    quaternion_rate,
    turn,
    turn_back,
)
from .spanning_tree import FREE
from .tree_joints import TreeJoints
from .tree_motion import TreeMotion


def poses_of(motion: TreeMotion, q: Float[Array, " n"], v: Float[Array, " n"]) -> tuple[Pose, Pose]:
    """Return the state of the assembly."""
    at = motion.place(q)
    frames = motion.frames(at, v)
    origin, velocity, spin = at.origin[:-1], frames.velocity[:-1], frames.spin[:-1]
    if motion.bodies.planar:
        return Pose(origin[:, :2], _angles(motion, q)), Pose(velocity[:, :2], spin[:, 2])
    quaternion = _orientations(motion, q)
    return Pose(origin, quaternion), Pose(velocity, quaternion_rate(quaternion, spin))


def _angles(motion: TreeMotion, q: Float[Array, " n"]) -> Float[Array, " b"]:
    """Return the angles of bodies in the plane: sums along the tree."""
    drawn = jnp.append(motion.bodies.drawing.orientation, 0)
    free = motion.coordinates.is_free
    own = jnp.where(free, 0, drawn[:-1] - drawn[motion.tree.parents[:-1]])
    turns = np.array([column.turns * column.sign for column in motion.coordinates.columns])
    is_moved = motion.tree.is_moved()
    by_own, by_turns = is_moved.astype(q.dtype), is_moved[:, motion.coordinates.bodies] * turns
    return jnp.asarray(by_own) @ own + jnp.asarray(by_turns.astype(q.dtype)) @ q


def _orientations(motion: TreeMotion, q: Float[Array, " n"]) -> Float[Array, "b 4"]:
    """Return the quaternions of bodies in space: products along the tree."""
    joints, coordinates, values = _joints(motion), motion.coordinates, jnp.append(q, 0)
    relative = quaternion_about(joints.axis, values[coordinates.angle])
    if coordinates.has("second_angle"):
        angle = values[coordinates.second_angle]
        second = quaternion_about(joints.second_axis_drawn(), angle)
        relative = multiply_quaternions(relative, second)
    if coordinates.has("quaternion"):
        is_ball = coordinates.quaternion[:, :1] < coordinates.size
        relative = jnp.where(is_ball, values[coordinates.quaternion], relative)
    relative = multiply_quaternions(relative, _drawn(motion, joints))
    relative = jnp.where(joints.reversed[:, None], conjugate(relative), relative)
    found = jnp.concatenate([relative, jnp.eye(1, 4, dtype=q.dtype)])
    parents = motion.tree.parents
    while not np.all(parents == parents.size - 1):
        found = multiply_quaternions(found[parents], found)
        parents = parents[parents]
    found = found[:-1]
    return found / jnp.sqrt(dot(found, found))[:, None]


def _joints(motion: TreeMotion) -> TreeJoints:
    return TreeJoints.of(motion.bodies, motion.groups, motion.tree)


def _drawn(motion: TreeMotion, joints: TreeJoints) -> Float[Array, "b 4"]:
    """Return the quaternions of the second in the first bodies, in the drawing."""
    quaternion = with_ground(motion.bodies.drawing.coordinates)[:, 3:]
    relative = multiply_quaternions(conjugate(quaternion[joints.first]), quaternion[joints.second])
    free = np.array([[edge.place == FREE] for edge in motion.tree.edges])
    return jnp.where(free, jnp.eye(1, 4, dtype=relative.dtype), relative)


def coordinates_of(
    motion: TreeMotion, y: tuple[Pose, Pose]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return coordinates and rates of a state of the assembly: of a quaternion those that keep its norm."""
    q = _positions(motion, y[0])
    frames = Frames.of(*y)
    rows = jnp.concatenate(motion.jacobians(motion.place(q)), axis=2)
    A = jnp.moveaxis(rows, 1, 2).reshape(-1, rows.shape[1])
    b = jnp.concatenate([frames.velocity[:-1], frames.spin[:-1]], axis=1).reshape(-1)
    return q, jnp.linalg.lstsq(A, b)[0]


def _positions(motion: TreeMotion, q: Pose) -> Float[Array, " n"]:
    joints, coordinates = _joints(motion), motion.coordinates
    origin, R = Placed.of(with_ground(q.coordinates))
    first, second = joints.first, joints.second
    gap = origin[second] + turn(R[second], joints.at_second)
    gap = turn_back(R[first], gap - origin[first] - turn(R[first], joints.at_first))
    turns = compose(jnp.swapaxes(R[first], 1, 2), R[second])
    turns = compose(turns, jnp.swapaxes(joints.drawn, 1, 2))
    is_universal = coordinates.second_angle < coordinates.size
    other = joints.second_axis_drawn()
    # A turn about the first axis takes the second one to where it is.
    across = turn(turns, other)
    sine, cosine = dot(jnp.cross(joints.axis, other), across), dot(other, across)
    angle = jnp.where(is_universal, jnp.arctan2(sine, cosine), _angle_about(joints.axis, turns))
    rest = compose(about(joints.axis, -angle), turns)
    every = {
        "angle": angle[:, None],
        "second_angle": _angle_about(other, rest)[:, None],
        "shift": jnp.where(coordinates.is_free[:, None], gap, dot(joints.axis, gap)[:, None]),
    }
    if coordinates.has("quaternion"):
        p = with_ground(q.coordinates)[:, 3:]
        relative = multiply_quaternions(conjugate(p[first]), p[second])
        every["quaternion"] = multiply_quaternions(relative, conjugate(_drawn(motion, joints)))
    columns = coordinates.columns
    found = [every[column.kind][column.body, column.number] for column in columns]
    return jnp.stack(found) if found else jnp.zeros((0,), R.dtype)


def _angle_about(axis: Float[Array, "k 3"], R: Float[Array, "k 3 3"]) -> Float[Array, " k"]:
    """Return the angles of turns about axes, from `-pi` to `pi`: of `R = 1 + sin K + (1 - cos) K^2` the trace is
    `1 + 2 cos`, and the antisymmetric part `sin K`."""
    vector = jnp.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    return jnp.arctan2(dot(axis, vector), jnp.trace(R, axis1=1, axis2=2) - 1)
