"""The tree of joints whose coordinates describe all bodies, and the joints that are left to close loops."""

from typing import NamedTuple

import numpy as np

from . import joints
from .joint_groups import JointGroup


# Joints that can be part of the tree, and how many freedoms they leave.
FREEDOMS: dict[type, int] = {
    joints.Fixed: 0,
    joints.Revolute: 1,
    joints.Prismatic: 1,
    joints.Universal: 2,
    joints.Cylindrical: 2,
    joints.Spherical: 3,
}
FREE = (-1, -1)  # the place of the joint of a body that is tied to the ground by none


class Edge(NamedTuple):
    """How a body is reached: from its parent, by a joint, `place` among the groups of joints. With
    `reversed` the body is the first one of the joint, and the parent the second."""

    body: int
    parent: int
    place: tuple[int, int]
    reversed: bool

    @property
    def ends(self) -> tuple[int, int]:
        """The first and the second body of the joint."""
        return (self.body, self.parent) if self.reversed else (self.parent, self.body)


class SpanningTree(NamedTuple):
    """`edges`, one for each body, in the order of the bodies; `loops`, for each group the joints that are
    no part of the tree."""

    edges: tuple[Edge, ...]
    loops: tuple[tuple[int, ...], ...]

    @property
    def parents(self) -> np.ndarray:
        """The parents of all bodies, and of the ground, which is its own."""
        ground = len(self.edges)
        return np.array([*(edge.parent for edge in self.edges), ground])

    def is_moved(self) -> np.ndarray:
        """Return whether body `i` is moved by the joint of body `j`, shape `(N, N)`."""
        parents, number = self.parents, len(self.edges)
        found = np.eye(number + 1, dtype=bool)
        while np.any(parents != number):
            found = found | found[parents]
            parents = parents[parents]
        return found[:number, :number]


def find_spanning_tree(
    groups: tuple[JointGroup, ...], number: int, needed: tuple[str, ...] = ()
) -> SpanningTree:
    """Return a tree with the fewest coordinates: a minimum spanning tree by Prim's algorithm, from the
    ground, or for bodies that are not tied to it from the first of them, which moves freely.

    Joints with the names `needed` come first, whatever their freedoms; of joints with as many freedoms
    those nearest to the ground.
    """
    candidates = [
        ((name not in needed, FREEDOMS[group.kind]), (g, i), first, second)
        for g, group in enumerate(groups)
        if group.motions is None and group.kind in FREEDOMS
        for i, (name, first, second) in enumerate(
            zip(group.attachment.names, *group.attachment.bodies, strict=True)
        )
    ]
    edges: dict[int, Edge] = {}
    depth = {number: 0}
    while len(depth) <= number:
        across = [
            (weight, depth[parent], place, parent, body, turned)
            for weight, place, first, second in candidates
            for parent, body, turned in ((first, second, False), (second, first, True))
            if parent in depth and body not in depth
        ]
        if across:
            _, _, place, parent, body, turned = min(across)
        else:
            place, parent, turned = FREE, number, False
            body = next(i for i in range(number) if i not in depth)
        edges[body] = Edge(body, parent, place, turned)
        depth[body] = depth[parent] + 1
    used = {edge.place for edge in edges.values()}
    loops = tuple(
        tuple(i for i in range(len(group.attachment.names)) if (g, i) not in used)
        for g, group in enumerate(groups)
    )
    return SpanningTree(tuple(edges[i] for i in range(number)), loops)
