"""What a file of closures says beside a URDF: closed loops, joints of another type, and motors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._base.extras import require
from .kinematic_tree import DegreeOfFreedom
from .loops import Closure
from .urdf_elements import BALL, Joint


_WORDS = {"closed_loop", "type", "name_mot", "joint_name", "joint_type"}
_AXES = {"X": np.array([1.0, 0, 0]), "Y": np.array([0, 1.0, 0]), "Z": np.array([0, 0, 1.0])}


class Additions(NamedTuple):
    """The contents of such a file."""

    closures: list[Closure]
    joint_types: dict[str, str]
    motors: tuple[str, ...]

    @property
    def used(self) -> set[str]:
        """Return the links and joints that it names."""
        ends = {link for closure in self.closures for link in (closure.first, closure.second)}
        return ends | set(self.joint_types) | set(self.motors)


def read_additions(given: Any, links: Mapping[str, Any], joints: Sequence[Joint]) -> Additions:
    """Return what `closures` says: a mapping, or the path of a YAML file."""
    if given is None:
        return Additions([], {}, ())
    if isinstance(given, str | Path):
        require("yaml", "robots", "A file of `closures`")
        import yaml

        given = yaml.safe_load(Path(given).read_text(encoding="utf-8"))
    if not isinstance(given, Mapping):
        raise TypeError(
            "`closures` must be the path of a YAML file or a mapping with 'closed_loop' and 'type', got "
            f"{type(given).__name__}."
        )
    if unknown := sorted(set(given) - _WORDS):
        raise ValueError(f"`closures` has the entries {unknown}; known are {sorted(_WORDS)}.")
    names = [joint.name for joint in joints]
    types = dict(_pairs(given, "joint_name", "joint_type"))
    motors = tuple(given.get("name_mot") or ())
    for word, used in (("joint_name", types), ("name_mot", motors)):
        if missing := [name for name in used if name not in names]:
            raise ValueError(f"`closures`: {word!r} has {missing}, and `file` has no such joints.")
    frames = {joint.name: joint.child for joint in joints} | {name: name for name in links}
    loops = [_closure(pair, kind, frames) for pair, kind in _pairs(given, "closed_loop", "type")]
    return Additions(loops, types, motors)


def _pairs(given: Mapping, one: str, other: str) -> list[tuple[Any, Any]]:
    first, second = given.get(one) or (), given.get(other) or ()
    if len(first) != len(second):
        raise ValueError(
            f"`closures`: {one!r} and {other!r} must have as many entries, got {len(first)} and {len(second)}."
        )
    return list(zip(first, second, strict=True))


def _closure(pair: Any, kind: Any, frames: Mapping[str, str]) -> Closure:
    """Return a closure; `frames` has the link of every frame: links, and children of joints."""
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise ValueError(f"`closures`: 'closed_loop' must have pairs of links, got {pair!r}.")
    first, second = pair
    if missing := [name for name in pair if name not in frames]:
        raise ValueError(
            f"`closures`: 'closed_loop' has {missing}, and `file` has no such links or joints."
        )
    if str(kind).lower() not in ("3d", "6d"):
        raise ValueError(
            f"`closures`: the type of {first}-{second} must be '3d' (a ball joint) or '6d' (a weld), got {kind!r}."
        )
    is_rigid = str(kind).lower() == "6d"
    return Closure(f"{first}-{second}", frames[first], frames[second], is_rigid)


def motions_of(joint: Joint, joint_types: Mapping[str, str]) -> list[DegreeOfFreedom]:
    """Return the degrees of freedom of a joint: of its type in the file, or of that in `closures`."""
    kind = "SPHERICAL" if joint.kind == BALL else joint_types.get(joint.name)
    if kind is None:
        if joint.kind in ("fixed", "floating"):
            return []
        return [DegreeOfFreedom(joint.kind != "prismatic", joint.axis)]
    if kind == "FIXED":
        return []
    axes = "XYZ" if kind == "SPHERICAL" else kind.removeprefix("UJOINT_")
    if not (
        kind == "SPHERICAL"
        or (kind.startswith("UJOINT_") and len(axes) == 2 and set(axes) <= set("XYZ"))
    ):
        raise ValueError(
            f"`closures`: the type of the joint {joint.name!r} must be 'SPHERICAL', 'FIXED' or 'UJOINT_XY' (two different "
            f"axes of its frame), got {kind!r}."
        )
    return [DegreeOfFreedom(True, _AXES[axis]) for axis in axes]
