"""The joints of a spanning tree: frames of bodies in their parents, and axes, as functions of coordinates."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .bodies import Bodies
from .frames import Placed, with_ground
from .joint_groups import JointGroup
from .rotations import about, compose, length_of, rates_matrix, rotation_matrix, turn, turn_back
from .spanning_tree import FREE, SpanningTree
from .tree_coordinates import TreeCoordinates


class TreeJoints(NamedTuple):
    """The joints of the tree, one for each body: their first and second bodies, axes and points in these, and
    the rotations of the second in the first bodies, in the drawing."""

    first: np.ndarray
    second: np.ndarray
    reversed: np.ndarray  # whether the parent is the second body
    axis: Float[Array, "b 3"]  # in the first body
    second_axis: Float[Array, "b 3"]  # of universal joints: in the second body
    at_first: Float[Array, "b 3"]
    at_second: Float[Array, "b 3"]
    drawn: Float[Array, "b 3 3"]

    @staticmethod
    def of(bodies: Bodies, groups: tuple[JointGroup, ...], tree: SpanningTree) -> "TreeJoints":
        starts = np.cumsum([0] + [len(group.attachment.names) for group in groups])
        # A body that moves freely has a joint with the ground, between both origins.
        is_free = np.array([edge.place == FREE for edge in tree.edges])
        index = [starts[e.place[0]] + e.place[1] if e.place != FREE else -1 for e in tree.edges]
        dtype = bodies.drawing.coordinates.dtype
        still, upright = (
            jnp.zeros((2, 1, 3), dtype),
            jnp.tile(jnp.eye(3, dtype=dtype), (2, 1, 1, 1)),
        )
        points = jnp.concatenate([*(group.attachment.points for group in groups), still], axis=1)
        axes = jnp.concatenate([*(group.attachment.axes for group in groups), upright], axis=1)
        points, axes = points[:, np.array(index)], axes[..., 2][:, np.array(index)]
        turned = np.array([edge.reversed for edge in tree.edges])
        ends = np.arange(len(tree.edges)), tree.parents[:-1]
        first, second = np.where(turned, *ends), np.where(turned, *ends[::-1])
        R = Placed.of(with_ground(bodies.drawing.coordinates)).rotation
        relative = compose(jnp.swapaxes(R[first], 1, 2), R[second])
        drawn = jnp.where(is_free[:, None, None], jnp.eye(3, dtype=dtype)[None], relative)
        ends = first, second, turned
        return TreeJoints(*ends, axes[0], axes[1], points[0], points[1], drawn)

    def second_axis_drawn(self) -> Float[Array, "b 3"]:
        """Return the second axes in the first bodies, in the drawing."""
        return turn(self.drawn, self.second_axis)

    def turns(self, coordinates: TreeCoordinates, q: Float[Array, " n"]) -> Float[Array, "b 3 3"]:
        """Return the rotations of the second bodies from where they are drawn, in the first bodies."""
        values = jnp.append(q, 0)
        found = about(self.axis, values[coordinates.angle])
        if coordinates.has("second_angle"):
            second = about(self.second_axis_drawn(), values[coordinates.second_angle])
            found = compose(found, second)
        if coordinates.has("quaternion"):
            is_ball, quaternion, _ = _quaternions(coordinates, values)
            found = jnp.where(is_ball[:, None, None], rotation_matrix(quaternion), found)
        return found

    def edges(
        self, coordinates: TreeCoordinates, q: Float[Array, " n"], turns: Float[Array, "b 3 3"]
    ) -> tuple[Float[Array, "b 3 3"], Float[Array, "b 3"]]:
        """Return rotations and origins of the bodies in the frames of their parents."""
        shift = self.at_first
        if coordinates.has("shift"):
            values = jnp.append(q, 0)
            along = values[coordinates.shift[:, :1]] * self.axis
            shift = shift + jnp.where(
                coordinates.is_free[:, None], values[coordinates.shift], along
            )
        R = compose(turns, self.drawn)
        origin = shift - turn(R, self.at_second)
        if not self.reversed.any():
            return R, origin
        turned = self.reversed[:, None]
        back = jnp.where(turned[:, :, None], jnp.swapaxes(R, 1, 2), R)
        return back, jnp.where(turned, -turn_back(R, origin), origin)

    def axes(
        self,
        coordinates: TreeCoordinates,
        q: Float[Array, " n"],
        R: Float[Array, "w 3 3"],
        turns: Float[Array, "b 3 3"],
    ) -> Float[Array, "c 3"]:
        """Return the axes of all coordinates in world coordinates."""
        first, dtype = R[self.first], R.dtype
        kinds = {"angle": turn(first, self.axis)[:, None]}
        if coordinates.has("second_angle"):
            kinds["second_angle"] = turn(R[self.second], self.second_axis)[:, None]
        if coordinates.has("shift"):
            free = coordinates.is_free[:, None, None]
            kinds["shift"] = jnp.where(free, jnp.eye(3, dtype=dtype)[None], kinds["angle"])
        if coordinates.has("quaternion"):
            _, quaternion, length = _quaternions(coordinates, jnp.append(q, 0))
            rates = compose(turns, rates_matrix(quaternion)) * (2 / length[:, None, None])
            kinds["quaternion"] = jnp.swapaxes(compose(first, rates), 1, 2)
        starts = np.cumsum([0] + [kind.shape[1] for kind in kinds.values()])
        start = dict(zip(kinds, starts, strict=False))
        columns = coordinates.columns
        place = np.array([start[column.kind] + column.number for column in columns], int)
        signs = jnp.asarray([[column.sign] for column in columns], dtype).reshape(-1, 1)
        return signs * jnp.concatenate(list(kinds.values()), axis=1)[coordinates.bodies, place]


def _quaternions(
    coordinates: TreeCoordinates, values: Float[Array, " n_and_1"]
) -> tuple[np.ndarray, Float[Array, "b 4"], Float[Array, " b"]]:
    """Return which joints have quaternions, these, and their lengths: one, but not while a solver corrects them."""
    is_ball = coordinates.quaternion[:, 0] < coordinates.size
    given = jnp.where(
        is_ball[:, None], values[coordinates.quaternion], jnp.eye(1, 4, dtype=values.dtype)
    )
    length = length_of(given)
    return is_ball, given / length[:, None], length
