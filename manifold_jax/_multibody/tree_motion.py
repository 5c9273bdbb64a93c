"""Placements, velocities and accelerations of all bodies as functions of the coordinates of a tree.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 3 and 4; but the frames of all bodies are
composed along the tree by doubling, in as many array computations as its depth has binary digits.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .bodies import Bodies
from .frames import Frames, Placed
from .joint_groups import JointGroup
from .rotations import compose, turn
from .spanning_tree import SpanningTree
from .tree_coordinates import TreeCoordinates
from .tree_joints import TreeJoints


class TreePlacement(NamedTuple):
    """Rotations and origins of all bodies and, last, of the ground; and for every coordinate the axis
    about or along which it moves, and a point of the axis; in world coordinates."""

    rotation: Float[Array, "n 3 3"]
    origin: Float[Array, "n 3"]
    axis: Float[Array, "c 3"]
    point: Float[Array, "c 3"]

    @property
    def placed(self) -> Placed:
        return Placed(self.origin, self.rotation)


class TreeMotion(eqx.Module):
    """The bodies of an assembly as functions of the coordinates `q` of the joints of a spanning tree, and of
    their rates `v`."""

    bodies: Bodies
    groups: tuple[JointGroup, ...]
    tree: SpanningTree = eqx.field(static=True)

    @property
    def coordinates(self) -> TreeCoordinates:
        kinds = tuple(group.kind for group in self.groups)
        names = tuple(group.attachment.names for group in self.groups)
        return _coordinates(self.tree, kinds, names, self.bodies.names, self.bodies.planar)

    def place(self, q: Float[Array, " n"]) -> TreePlacement:
        joints = TreeJoints.of(self.bodies, self.groups, self.tree)
        turns = joints.turns(self.coordinates, q)
        R, origin = _composed(self.tree.parents, *joints.edges(self.coordinates, q, turns))
        axes = joints.axes(self.coordinates, q, R, turns)
        point = origin[joints.second] + turn(R[joints.second], joints.at_second)
        return TreePlacement(R, origin, axes, point[self.coordinates.bodies])

    def jacobians(self, at: TreePlacement) -> tuple[Float[Array, "b n 3"], Float[Array, "b n 3"]]:
        """Return the derivatives of velocities and angular velocities of the bodies by those of `q`."""
        moved, turns = self._moved()
        arm = at.origin[:-1, None] - at.point[None]
        axis = jnp.broadcast_to(at.axis[None], arm.shape)
        spin = jnp.where(moved & turns, axis, 0)
        return jnp.where(moved, jnp.where(turns, jnp.cross(axis, arm), axis), 0), spin

    def frames(self, at: TreePlacement, v: Float[Array, " n"]) -> Frames:
        rates = v[None, :, None]
        velocity, spin = (jnp.sum(J * rates, axis=1) for J in self.jacobians(at))
        pad = lambda rows: jnp.pad(rows, ((0, 1), (0, 0)))
        return Frames(at.origin, at.rotation, pad(velocity), pad(spin))

    def bias(
        self, at: TreePlacement, frames: Frames, v: Float[Array, " n"]
    ) -> tuple[Float[Array, "b 3"], Float[Array, "b 3"]]:
        """Return the accelerations of all bodies, and their angular ones, where those of `q` are zero: the
        changes of axes and points, which are fixed in bodies, times the rates. The four axes of a
        quaternion change in its own frame, too, by what adds up to zero for rates that keep its norm."""
        moved, turns = self._moved()
        of_axis, of_point = self.coordinates.holders(self.tree)
        axis_rate = jnp.cross(frames.spin[of_axis], at.axis)
        point_rate = frames.velocity[of_point] + jnp.cross(
            frames.spin[of_point], at.point - at.origin[of_point]
        )
        arm = at.origin[:-1, None] - at.point[None]
        arm_rate = frames.velocity[:-1, None] - point_rate[None]
        turning = jnp.cross(axis_rate[None], arm) + jnp.cross(at.axis[None], arm_rate)
        rates, along = v[None, :, None], jnp.broadcast_to(axis_rate[None], arm.shape)
        linear = jnp.where(moved, jnp.where(turns, turning, along), 0)
        angular = jnp.where(moved & turns, along, 0)
        return jnp.sum(linear * rates, axis=1), jnp.sum(angular * rates, axis=1)

    def inertia(self, at: TreePlacement) -> Float[Array, "b 3 3"]:
        """Return the moments of inertia in world coordinates."""
        if self.bodies.planar:
            inertia = self.bodies.inertia[:, None, None]
            return jnp.pad(inertia, ((0, 0), (2, 0), (2, 0)))
        R = at.rotation[:-1]
        return compose(compose(R, self.bodies.inertia), jnp.swapaxes(R, 1, 2))

    def _moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Return whether a body is moved by a coordinate, and which coordinates turn."""
        turns = np.array([column.turns for column in self.coordinates.columns], bool)
        return self.tree.is_moved()[:, self.coordinates.bodies, None], turns[None, :, None]


@functools.lru_cache(maxsize=32)
def _coordinates(*of: Any) -> TreeCoordinates:
    return TreeCoordinates.of(*of)


def _composed(
    parents: np.ndarray, R: Float[Array, "b 3 3"], origin: Float[Array, "b 3"]
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """Compose the frames of bodies in their parents to those in the world, and append the ground."""
    ground = parents.size - 1
    R = jnp.concatenate([R, jnp.eye(3, dtype=R.dtype)[None]])
    origin = jnp.concatenate([origin, jnp.zeros((1, 3), origin.dtype)])
    while not np.all(parents == ground):
        origin = origin[parents] + turn(R[parents], origin)
        R = compose(R[parents], R)
        parents = parents[parents]
    return R, origin
