"""Links and joints of a URDF file, as it gives them.

Source: the specification of URDF, https://wiki.ros.org/urdf/XML. A link has a frame; a joint places the
frame of its child in that of its parent, `origin` first, then its motion about or along `axis`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np


class Placement(NamedTuple):
    """A frame: its rotation `(3, 3)` and its origin `(3,)` in another one."""

    rotation: np.ndarray
    origin: np.ndarray

    @staticmethod
    def none() -> "Placement":
        return Placement(np.eye(3), np.zeros(3))

    def then(self, inner: "Placement") -> "Placement":
        """Return the frame `inner`, which is given in this one, where this one is given."""
        return Placement(self.rotation @ inner.rotation, self.point(inner.origin))

    def point(self, at: np.ndarray) -> np.ndarray:
        return self.origin + self.rotation @ at


class Link(NamedTuple):
    """A link: mass (kg), centre of mass and its frame, and inertia (kg m^2) about it."""

    name: str
    mass: float
    center: Placement
    inertia: np.ndarray


class Mimic(NamedTuple):
    """What a joint does as another one: `x = multiplier z + offset` (rad or m), `other` is the joint of `z`."""

    other: str
    multiplier: float
    offset: float


class Joint(NamedTuple):
    """A joint between two links, by their names, and its type in the file."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Placement
    axis: np.ndarray
    damping: float
    friction: float
    limits: tuple[float, float] | None
    mimic: "Mimic | None"
    rest: Placement = Placement(np.eye(3), np.zeros(3))  # after its motion


BALL = "ball"  # three hinges in one, not a type of files
KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating")


def read_elements(file: Any) -> tuple[dict[str, Link], list[Joint]]:
    """Return the links by name, and the joints."""
    robot = _root(file)
    links = {link.name: link for link in map(_link, robot.findall("link"))}
    if len(links) < len(robot.findall("link")):
        raise ValueError("Every link of `file` needs its own name; some have the same.")
    joints = [_joint(element, links) for element in robot.findall("joint")]
    names = [joint.name for joint in joints]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"Every joint of `file` needs its own name; there are several of {twice}.")
    return links, joints


def _root(file: Any) -> ElementTree.Element:
    if isinstance(file, Path) or (isinstance(file, str) and "<" not in file):
        text = Path(file).read_text(encoding="utf-8")
    elif isinstance(file, str):
        text = file
    else:
        raise TypeError(f"`file` must be a path or a string of XML, got {type(file).__name__}.")
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"`file` is not XML: {error}.") from None
    if robot.tag != "robot":
        raise ValueError(
            f"`file` must be a URDF, whose first element is <robot>, got <{robot.tag}>. MJCF is read by "
            "`mj.multibody.from_mujoco`, xacro files must be expanded first."
        )
    return robot


def _link(element: ElementTree.Element) -> Link:
    name = _attribute(element, "name", "a link")
    what, inertial = f"the link {name!r}", element.find("inertial")
    if inertial is None:
        return Link(name, 0.0, Placement.none(), np.zeros((3, 3)))
    mass = _number(inertial.find("mass"), "value", 0.0, what)
    found = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (
        _number(found, name, 0.0, what) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass == 0 and np.any(inertia):
        raise ValueError(
            f"`file`: {what} has moments of inertia but no mass. Give it a mass, or leave its <inertia> out."
        )
    return Link(name, mass, _origin(inertial, what), inertia)


def _joint(element: ElementTree.Element, links: dict[str, Link]) -> Joint:
    name = _attribute(element, "name", "a joint")
    what, kind = f"the joint {name!r}", _attribute(element, "type", f"the joint {name!r}")
    if kind not in KINDS:
        raise ValueError(f"`file`: {what} is of type {kind!r}; supported are {', '.join(KINDS)}.")
    parent, child = (_linked(element, end, what, links) for end in ("parent", "child"))
    dynamics, limit = element.find("dynamics"), element.find("limit")
    is_limited = limit is not None and kind in ("revolute", "prismatic")
    limits = [_number(limit, end, 0.0, what) for end in ("lower", "upper")] if is_limited else None
    return Joint(
        name,
        kind,
        parent,
        child,
        _origin(element, what),
        _axis(element, kind, what),
        _number(dynamics, "damping", 0.0, what),
        _number(dynamics, "friction", 0.0, what),
        None if limits is None else (limits[0], limits[1]),
        _mimic(element.find("mimic"), what),
    )


def _mimic(element: ElementTree.Element | None, what: str) -> Mimic | None:
    if element is None:
        return None
    what = f"<mimic> of {what}"
    multiplier = _number(element, "multiplier", 1.0, what)
    return Mimic(
        _attribute(element, "joint", what), multiplier, _number(element, "offset", 0.0, what)
    )


def _axis(element: ElementTree.Element, kind: str, what: str) -> np.ndarray:
    axis = _vector(element.find("axis"), "xyz", (1.0, 0.0, 0.0), what)
    length = np.linalg.norm(axis)
    if kind in ("fixed", "floating"):  # some programs write zeros
        return axis
    if not length > 0:
        raise ValueError(f"`file`: the axis of {what} is zero: an axis needs a direction.")
    return axis / length


def _linked(element: ElementTree.Element, end: str, what: str, links: dict[str, Link]) -> str:
    found = element.find(end)
    if found is None:
        raise ValueError(f"`file`: {what} has no <{end}>.")
    name = _attribute(found, "link", f"<{end}> of {what}")
    if name not in links:
        raise ValueError(f"`file`: {what} has the {end} {name!r}, and there is no such link.")
    return name


def _origin(element: ElementTree.Element, what: str) -> Placement:
    origin, zeros = element.find("origin"), (0.0, 0.0, 0.0)
    roll, pitch, yaw = _vector(origin, "rpy", zeros, what)
    rotation = about((0, 0, 1), yaw) @ about((0, 1, 0), pitch) @ about((1, 0, 0), roll)
    return Placement(rotation, _vector(origin, "xyz", zeros, what))


def about(axis: Any, angle: float) -> np.ndarray:
    """Return the rotation by an angle about a unit vector (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _attribute(element: ElementTree.Element, name: str, what: str) -> str:
    value = element.get(name)
    if not value:
        raise ValueError(f"`file`: {what} has no attribute {name!r}.")
    return value


def _number(element: ElementTree.Element | None, name: str, default: float, what: str) -> float:
    text = None if element is None else element.get(name)
    return default if text is None else _converted(text, float, name, what, "a number")


def _vector(element: ElementTree.Element | None, name: str, default: Any, what: str) -> np.ndarray:
    text = None if element is None else element.get(name)
    if text is None:
        return np.array(default)
    numbers = lambda text: np.array([float(part) for part in text.split()])
    vector = _converted(text, numbers, name, what, "three numbers")
    if vector.shape != (3,):
        raise ValueError(f"`file`: {name!r} of {what} must be three numbers, got {text!r}.")
    return vector


def _converted(text: str, convert: Callable, name: str, what: str, expected: str) -> Any:
    try:
        value = convert(text)
    except ValueError:
        raise ValueError(f"`file`: {name!r} of {what} must be {expected}, got {text!r}.") from None
    if not np.all(np.isfinite(value)):
        raise ValueError(f"`file`: {name!r} of {what} must be finite, got {text!r}.")
    return value
