"""The coordinates of the joints of a spanning tree: which numbers of `q` belong to which joint."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from . import joints
from .known_coordinates import KnownCoordinates
from .spanning_tree import FREE, SpanningTree


class Column(NamedTuple):
    """One number of `q`: the body that it moves, and the `number`-th of the coordinates of one kind: an
    `angle` about the axis of the joint, a `second_angle` about the second one of a universal joint, a `shift`
    along the axis or of a free body along x, y, z, or the `quaternion` of a ball joint or a free body."""

    name: str
    body: int
    kind: str
    number: int
    sign: int  # -1 where the body is the first of its joint

    @property
    def turns(self) -> bool:
        return self.kind != "shift"


class TreeCoordinates(NamedTuple):
    """All numbers of `q`, and for each body those of its joint, `size` for none: `angle` and
    `second_angle`, `(N,)`, `shift`, `(N, 3)`, and `quaternion`, `(N, 4)`."""

    columns: tuple[Column, ...]
    angle: np.ndarray
    second_angle: np.ndarray
    shift: np.ndarray
    quaternion: np.ndarray

    @property
    def size(self) -> int:
        return len(self.columns)

    @property
    def bodies(self) -> np.ndarray:
        """The bodies that the numbers move."""
        return np.array([column.body for column in self.columns], int)

    @property
    def is_free(self) -> np.ndarray:
        """Whether a body moves freely."""
        return self.shift[:, 1] < self.size

    def holders(self, tree: SpanningTree) -> tuple[np.ndarray, np.ndarray]:
        """Return the bodies in which the axis of each number is fixed, and the point of the axis: the first and
        the second of its joint, but the second axis of a universal joint is fixed in the second."""
        of_axis, of_point = [], []
        for column in self.columns:
            ends = tree.edges[column.body].ends
            of_axis.append(ends[1 if column.kind == "second_angle" else 0])
            of_point.append(ends[1])
        return np.array(of_axis, int), np.array(of_point, int)

    def numbers_of(self, names: tuple[str, ...]) -> np.ndarray:
        """Return the numbers of joints with one coordinate, by name."""
        known = {column.name: c for c, column in enumerate(self.columns)}
        return np.array([known[name] for name in names], int)

    def known(self, q: Float[Array, " n"]) -> KnownCoordinates:
        """Return the coordinates of the joints with one, by name."""
        return KnownCoordinates(tuple(column.name for column in self.columns), q)

    def has(self, kind: str) -> bool:
        """Return whether any joint has coordinates of a kind."""
        return any(column.kind == kind for column in self.columns)

    def quaternions(self) -> np.ndarray:
        """Return the numbers of all quaternions, shape `(k, 4)`."""
        return self.quaternion[self.quaternion[:, 0] < self.size]

    @staticmethod
    def of(
        tree: SpanningTree,
        kinds: tuple[type, ...],
        joint_names: tuple[tuple[str, ...], ...],
        body_names: tuple[str, ...],
        planar: bool,
    ) -> "TreeCoordinates":
        columns: list[Column] = []
        for edge in tree.edges:
            group, i = edge.place
            free = edge.place == FREE
            own = _of_joint(None if free else kinds[group], planar)
            name = body_names[edge.body] if free else joint_names[group][i]
            for k, (kind, number) in enumerate(own):
                label = name if len(own) == 1 else f"{name}[{k}]"
                columns.append(Column(label, edge.body, kind, number, -1 if edge.reversed else 1))
        number, size = len(tree.edges), len(columns)
        widths = {"angle": 1, "second_angle": 1, "shift": 3, "quaternion": 4}
        place = {kind: np.full((number, width), size) for kind, width in widths.items()}
        for c, column in enumerate(columns):
            place[column.kind][column.body, column.number] = c
        angle, second_angle = place["angle"][:, 0], place["second_angle"][:, 0]
        return TreeCoordinates(
            tuple(columns), angle, second_angle, place["shift"], place["quaternion"]
        )


def _of_joint(kind: type | None, planar: bool) -> list[tuple[str, int]]:
    """Return the kinds of the coordinates of a joint and their numbers, of a free body for `None`."""
    turn, slide = [("angle", 0)], [("shift", 0)]
    ball = [("quaternion", k) for k in range(4)]
    if kind is None:
        return [("shift", 0), ("shift", 1), *(turn if planar else [("shift", 2), *ball])]
    return {
        joints.Fixed: [],
        joints.Revolute: turn,
        joints.Prismatic: slide,
        joints.Universal: [*turn, ("second_angle", 0)],
        joints.Cylindrical: [*turn, *slide],
        joints.Spherical: ball,
    }[kind]
