"""From links to bodies: what is welded together becomes one body, and links without mass between hinges
become joints with several axes."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .bodies import Body, GROUND
from .joints import AbstractJoint, Cylindrical, Prismatic, Revolute, Spherical, Universal
from .kinematic_tree import KinematicTree
from .loops import Closure
from .urdf_elements import Link, Placement


# Axes through one point, or parallel, to this tolerance (m, or the sine of an angle): digits of files.
_ROUNDING = 1e-6


class Axis(NamedTuple):
    """One axis of a joint in the drawing, in the frame of the root."""

    turns: bool
    direction: np.ndarray
    at: np.ndarray


class Connection(NamedTuple):
    """What joins two groups of links: axes in order from the first to the second."""

    name: str
    first: str
    second: str
    axes: list[Axis]

    def reversed(self) -> "Connection":
        backwards = [axis._replace(direction=-axis.direction) for axis in self.axes[::-1]]
        return Connection(self.name, self.second, self.first, backwards)


class Groups:
    """The links of a tree in groups that do not move in themselves."""

    def __init__(
        self, tree: KinematicTree, closures: Sequence[Closure], placed: Mapping[str, Placement]
    ):
        self.links, self.placed = tree.links, placed
        self.group = {name: name for name in tree.links}
        for joint in tree.order:
            if not tree.motions[joint.name] and joint.kind != "floating":
                self._join(joint.parent, joint.child)
        for closure in closures:
            if closure.is_rigid:
                self._join(closure.first, closure.second)
        self.members: dict[str, list[Link]] = {}
        for name, link in tree.links.items():
            self.members.setdefault(self.of(name), []).append(link)

    def of(self, link: str) -> str:
        """Return the link that stands for the group."""
        while self.group[link] != link:
            link = self.group[link]
        return link

    def _join(self, first: str, second: str) -> None:
        self.group[self.of(second)] = self.of(first)

    def mass(self, group: str) -> float:
        return sum(link.mass for link in self.members[group])

    def body_name(self, group: str) -> str:
        """Return the name of the heaviest link."""
        return max(self.members[group], key=lambda link: link.mass).name

    def body(self, group: str) -> Body:
        """Return the body of all links of a group: its frame has the directions of the root's."""
        parts = [link for link in self.members[group] if link.mass != 0]
        mass, centers = self.mass(group), [self._center(link) for link in parts]
        center = sum(link.mass * at.origin for link, at in zip(parts, centers, strict=True)) / mass
        inertia = np.zeros((3, 3))
        for link, at in zip(parts, centers, strict=True):
            arm = at.origin - center
            inertia += at.rotation @ link.inertia @ at.rotation.T
            inertia += link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        symmetric = (inertia + inertia.T) / 2
        return Body(self.body_name(group), mass, symmetric, position=center)

    def _center(self, link: Link) -> Placement:
        return self.placed[link.name].then(link.center)


def connections(
    tree: KinematicTree, groups: Groups, axes: Sequence[tuple[bool, np.ndarray, np.ndarray]]
) -> list[Connection]:
    """Return the joints between groups; those through links without mass become one."""
    found = []
    for joint in tree.order:
        own = [Axis(*axes[i]) for i in tree.columns[joint.name]]
        first, second = groups.of(joint.parent), groups.of(joint.child)
        if own and first == second:
            raise ValueError(
                f"The joint {joint.name!r} cannot move: both its links belong to one rigid body, as `closures` weld them "
                "together. Use closures of type '3d', or make it fixed."
            )
        if own:
            found.append(Connection(joint.name, first, second, own))
    for group in groups.members:
        if groups.mass(group) == 0 and group != groups.of(tree.root):
            found = _without(found, group, groups)
    return found


def _without(found: list[Connection], group: str, groups: Groups) -> list[Connection]:
    """Remove a group without mass: what hangs on one joint, or is between two."""
    own = [c for c in found if group in (c.first, c.second)]
    rest = [c for c in found if group not in (c.first, c.second)]
    if len(own) < 2:
        return rest
    if len(own) > 2:
        names = ", ".join(repr(c.name) for c in own)
        raise ValueError(
            f"The link {groups.body_name(group)!r} has no mass, but joins {names}. Give it mass and inertia in `file`."
        )
    one, other = own
    one = one if one.second == group else one.reversed()
    other = other if other.first == group else other.reversed()
    name = f"{one.name} {other.name}"
    place = found.index(own[0])
    merged = Connection(name, one.first, other.second, one.axes + other.axes)
    return (
        [c for c in found[:place] if c in rest] + [merged] + [c for c in found[place:] if c in rest]
    )


def joint_between(connection: Connection, names: Mapping[str, str]) -> AbstractJoint:
    """Return the joint that has the axes of a connection."""
    first, second, name = names[connection.first], names[connection.second], connection.name
    axes = connection.axes
    a, *others = axes
    turning = [axis for axis in axes if axis.turns]
    given: dict[str, Any] = dict(name=name, at=turning[0].at if turning else a.at)
    if len(axes) == 1:
        kind = Revolute if a.turns else Prismatic
        return kind(first, second, axis=a.direction, **given)
    one_point = all(np.linalg.norm(axis.at - a.at) < _ROUNDING for axis in others)
    directions = np.stack([axis.direction for axis in axes])
    if (
        len(turning) == len(axes) == 2
        and one_point
        and abs(directions[0] @ directions[1]) < _ROUNDING
    ):
        # perpendicular to the last digit, as the joint wants them
        aligned = directions[1] - directions[0] * (directions[0] @ directions[1])
        return Universal(first, second, axis=(directions[0], aligned), **given)
    if len(turning) == len(axes) == 3 and one_point and abs(np.linalg.det(directions)) > 1e-3:
        return Spherical(first, second, **given)
    if len(axes) == 2 and len(turning) == 1 and np.linalg.norm(np.cross(*directions)) < _ROUNDING:
        return Cylindrical(first, second, axis=a.direction, **given)
    kinds = ", ".join("hinge" if axis.turns else "slider" for axis in axes)
    raise ValueError(
        f"The joints {name!r} ({kinds}) have only links without mass between them, and together are none of the joints "
        "supported: two perpendicular hinges through one point, three that do not lie in a plane, or a hinge and a "
        "slider on one axis. Give the links between them mass and inertia in `file`."
    )


def body_names(groups: Groups, root: str, moves: bool) -> dict[str, str]:
    """Return the name of the body of every group that has one; that of the root may be the ground."""
    root = groups.of(root)
    if moves and groups.mass(root) == 0:
        raise ValueError(
            f"`floating_base=True`, but the root link {root!r} has no mass. Give it mass and inertia in `file`."
        )
    names = {
        group: groups.body_name(group)
        for group in groups.members
        if groups.mass(group) != 0 and group != root
    }
    return {root: groups.body_name(root) if moves else GROUND, **names}
