"""What restrains an assembly: its joints and, behind them, the drives of some."""

import itertools
from typing import Any

import jax.numpy as jnp

from . import joints
from .attachment import name_all
from .bodies import Bodies
from .checks import check_value
from .equations import DRIVEN
from .joint_groups import attachment_of, find_joint, Found, group_joints, JointGroup


def group_restraints(bodies: Bodies, given: Any) -> tuple[JointGroup, ...]:
    named = list(zip(*name_all(given, joints.AbstractRestraint, "joint"), strict=True))
    is_drive = lambda pair: isinstance(pair[0], joints.Drive)
    drives = list(filter(is_drive, named))
    groups = group_joints(bodies, itertools.filterfalse(is_drive, named))
    kinds: dict[type, list[tuple[joints.Drive, str, Found]]] = {}
    for drive, name in drives:
        found = find_joint(groups, drive.joint, name)
        kinds.setdefault(_kind(found, drive, name), []).append((drive, name, found))
    _check_once([drive for drive, _ in drives])
    return (*groups, *(_group(kind, bodies.planar, given) for kind, given in kinds.items()))


def _kind(found: Found, drive: joints.Drive, name: str) -> type:
    kind = found[0].kind
    if kind not in DRIVEN:
        raise ValueError(
            f"{name}: the joint {drive.joint!r} is a {kind.__name__}, which has no single coordinate. Drives belong to "
            "`Revolute` and `Prismatic` joints."
        )
    return kind


def _check_once(drives: list[joints.Drive]) -> None:
    driven = [drive.joint for drive in drives]
    if len(set(driven)) < len(driven):
        twice = sorted({joint for joint in driven if driven.count(joint) > 1})
        raise ValueError(f"A joint has one drive; there are several of {twice}.")


def _group(kind: type, planar: bool, given: list[tuple[joints.Drive, str, Found]]) -> JointGroup:
    drives, names, found = zip(*given, strict=True)
    motions = tuple(
        check_value("motion", drive.motion, name, ())
        for drive, name in zip(drives, names, strict=True)
    )
    attachment = attachment_of(list(found), names)
    return JointGroup(kind, planar, attachment, jnp.zeros(len(names)), motions)
