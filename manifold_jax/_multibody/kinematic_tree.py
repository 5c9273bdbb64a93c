"""The tree of links and joints of a file, and where every link is: by NumPy, before anything is compiled."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .urdf_elements import about, Joint, Link, Placement


class DegreeOfFreedom(NamedTuple):
    """One degree of freedom: a turn about an axis or a shift along it, in the frame of its joint."""

    turns: bool
    axis: np.ndarray

    def by(self, value: float) -> Placement:
        if self.turns:
            return Placement(about(self.axis, value), np.zeros(3))
        return Placement(np.eye(3), value * self.axis)


class KinematicTree:
    """Links and joints, from the root to the ends.

    A joint moves by its `motions` one after the other, and then by the constant `rest`, of ball joints a
    turn: their coordinates are started again from zero whenever it is changed, where they are regular.
    """

    def __init__(
        self,
        links: dict[str, Link],
        joints: Sequence[Joint],
        motions: Mapping[str, list[DegreeOfFreedom]],
    ):
        self.links, self.motions = links, motions
        self.joint_of = {joint.child: joint for joint in joints}
        self.root, self.order = from_root(links, joints)
        starts = np.cumsum([0] + [len(motions[joint.name]) for joint in self.order])
        self.columns = {
            joint.name: range(a, b)
            for joint, a, b in zip(self.order, starts[:-1], starts[1:], strict=True)
        }
        self.size = int(starts[-1])
        self.rest = {joint.name: joint.rest for joint in self.order}

    def mimics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `A` and `b` of the equations `A x = b` of joints that mimic others."""
        pairs = [(joint, joint.mimic) for joint in self.order if joint.mimic is not None]
        matrix, offset = np.zeros((len(pairs), self.size)), np.zeros(len(pairs))
        for row, (joint, mimic) in enumerate(pairs):
            matrix[row, self.columns[joint.name][0]] = 1
            matrix[row, self.columns[mimic.other][0]] -= mimic.multiplier
            offset[row] = mimic.offset
        return matrix, offset

    def place(
        self, x: np.ndarray
    ) -> tuple[dict[str, Placement], list[tuple[bool, np.ndarray, np.ndarray]]]:
        """Return the placement of all links, and for every coordinate whether it turns, its axis and a
        point of it, in the frame of the root."""
        placed, axes = {self.root: Placement.none()}, []
        for joint in self.order:
            frame = placed[joint.parent].then(joint.origin)
            for motion, i in zip(self.motions[joint.name], self.columns[joint.name], strict=True):
                axes.append((motion.turns, frame.rotation @ motion.axis, frame.origin))
                frame = frame.then(motion.by(x[i]))
            placed[joint.child] = frame.then(self.rest[joint.name])
        return placed, axes

    def turn_ball_joints(self, x: np.ndarray) -> None:
        """Move the coordinates of ball joints to their constant turns."""
        for joint in self.order:
            motions, columns = self.motions[joint.name], self.columns[joint.name]
            if len(columns) == 3:
                for motion, i in zip(motions[::-1], columns[::-1], strict=True):
                    self.rest[joint.name] = motion.by(x[i]).then(self.rest[joint.name])
                    x[i] = 0

    def ancestors(self, link: str) -> list[int]:
        """Return the coordinates on which the placement of a link depends."""
        found: list[int] = []
        while link in self.joint_of:
            joint = self.joint_of[link]
            found += self.columns[joint.name]
            link = joint.parent
        return found


def from_root(links: Mapping[str, Any], joints: Sequence[Joint]) -> tuple[str, list[Joint]]:
    """Return the root, and the joints in an order in which parents come first."""
    children = [joint.child for joint in joints]
    if twice := sorted({child for child in children if children.count(child) > 1}):
        raise ValueError(
            f"`file`: the links {twice[:5]} are children of several joints. URDF describes trees; give loops in `closures`."
        )
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise ValueError(
            f"`file` must be one tree of links with one root, got {len(roots)} links without a parent: {roots[:5]}."
        )
    below: dict[str, list[Joint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    order, waiting = [], [roots[0]]
    while waiting:
        for joint in below.get(waiting.pop(0), []):
            order.append(joint)
            waiting.append(joint.child)
    if len(order) < len(joints):
        lost = sorted(set(links) - {roots[0]} - {joint.child for joint in order})
        raise ValueError(f"`file`: the links {lost[:5]} are their own ancestors.")
    return roots[0], order
