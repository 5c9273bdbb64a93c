"""From links to bodies: what is welded together becomes one body, and links without mass between hinges
become joints with several axes, if there are such joints."""

from collections.abc import Collection, Mapping, Sequence
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
        if not parts:
            origin = self.placed[self.members[group][0].name].origin
            return Body(self.body_name(group), 0.0, np.zeros((3, 3)), position=origin)
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
    tree: KinematicTree,
    groups: Groups,
    axes: Sequence[tuple[bool, np.ndarray, np.ndarray]],
    ends: Collection[str],
    used: Collection[str],
    mimics: Collection[str],
) -> list[Connection]:
    """Return the joints between groups. Those through links without mass become one where there is such a joint;
    links at the `ends` of loops are kept, and so are the joints that are `used` by name, of links that hang on one
    joint only those of `mimics`."""
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
    kept = {groups.of(tree.root), *ends}
    massless = [name for name in groups.members if groups.mass(name) == 0 and name not in kept]
    found = _without_loose_ends(found, massless, mimics)
    for group in massless:
        found = _merged(found, group, used)
    return found


def _without_loose_ends(
    found: list[Connection], massless: Collection[str], mimics: Collection[str]
) -> list[Connection]:
    """Remove links without mass that hang on one joint, unless it mimics or is mimicked."""
    coupled = {end for c in found if c.name in mimics for end in (c.first, c.second)}
    massless = [group for group in massless if group not in coupled]
    while True:
        ends = [end for connection in found for end in (connection.first, connection.second)]
        loose = {group for group in massless if ends.count(group) == 1}
        if not loose:
            return found
        found = [c for c in found if not {c.first, c.second} & loose]


def _merged(found: list[Connection], group: str, used: Collection[str]) -> list[Connection]:
    """Replace a group without mass and its two joints by one joint, if there is one that has all their axes."""
    own = [c for c in found if group in (c.first, c.second)]
    if len(own) != 2 or any(c.name in used for c in own):
        return found
    one, other = own
    one = one if one.second == group else one.reversed()
    other = other if other.first == group else other.reversed()
    merged = Connection(f"{one.name} {other.name}", one.first, other.second, one.axes + other.axes)
    if _joint_with(merged.axes) is None:
        return found
    place = found.index(own[0])
    rest = lambda part: [c for c in part if c not in own]
    return [*rest(found[:place]), merged, *rest(found[place:])]


def _joint_with(axes: list[Axis]) -> type[AbstractJoint] | None:
    """Return the kind of joint that has such axes, one after the other."""
    directions = np.stack([axis.direction for axis in axes])
    turning = sum(axis.turns for axis in axes)
    one_point = all(np.linalg.norm(axis.at - axes[0].at) < _ROUNDING for axis in axes)
    if len(axes) == 1:
        return Revolute if turning else Prismatic
    if turning == len(axes) == 2 and one_point and abs(directions[0] @ directions[1]) < _ROUNDING:
        return Universal
    if turning == len(axes) == 3 and one_point and abs(np.linalg.det(directions)) > 1e-3:
        return Spherical
    parallel = len(axes) == 2 and np.linalg.norm(np.cross(*directions)) < _ROUNDING
    return Cylindrical if parallel and turning == 1 else None


def joint_between(connection: Connection, names: Mapping[str, str]) -> AbstractJoint:
    """Return the joint that has the axes of a connection."""
    axes, kind = connection.axes, _joint_with(connection.axes)
    at = next((axis.at for axis in axes if axis.turns), axes[0].at)
    ends = names[connection.first], names[connection.second]
    given: dict[str, Any] = dict(name=connection.name, at=at)
    direction = axes[0].direction
    if kind is Spherical:
        return Spherical(*ends, **given)
    if kind is Universal:
        # perpendicular to the last digit, as the joint wants them
        aligned = axes[1].direction - direction * (direction @ axes[1].direction)
        return Universal(*ends, axis=(direction, aligned), **given)
    if kind in (Revolute, Prismatic, Cylindrical):
        return kind(*ends, axis=direction, **given)
    raise ValueError(
        f"The joint {connection.name!r} has axes that are none of a joint that is supported: a universal joint has two "
        "perpendicular ones, a ball joint three."
    )


def body_names(
    groups: Groups, root: str, moves: bool, connected: Collection[str]
) -> dict[str, str]:
    """Return the name of the body of every group that has one: those with mass, and those that are connected. That
    of the root may be the ground."""
    root = groups.of(root)
    if moves and groups.mass(root) == 0:
        raise ValueError(
            f"`floating_base=True`, but the root link {root!r} has no mass. Give it mass and inertia in `file`."
        )
    names = {
        group: groups.body_name(group)
        for group in groups.members
        if (groups.mass(group) != 0 or group in connected) and group != root
    }
    names = {root: groups.body_name(root), **names} if moves else names
    if GROUND in names.values():
        raise ValueError(
            f"`file`: the link {GROUND!r} moves, but this is the name of what does not. Rename the link."
        )
    return names if moves else {root: GROUND, **names}
