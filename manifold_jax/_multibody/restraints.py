"""What restrains an assembly: its joints and, behind them, the drives of some, those of one kind together."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import joints
from .attachment import attach, Attachment, grouped, name_all
from .bodies import Bodies, Pose
from .checks import check_shape, is_concrete, on_host, stack, Values
from .equations import DRIVEN, PLANAR, SPATIAL
from .frames import Placed, with_ground
from .joint_groups import JointGroup
from .rotations import length_of


Found = tuple[JointGroup, int]  # a joint: its group and its place in that


def group_restraints(bodies: Bodies, given: Any) -> tuple[JointGroup, ...]:
    named = name_all(given, joints.AbstractRestraint, "joint")
    of_joints = [pair for pair in named if not isinstance(pair[0], joints.Drive)]
    kinds = grouped(of_joints, lambda joint, name: type(joint))
    groups = tuple(_group_joints(kind, bodies, *own) for kind, own in kinds.items())
    advice = "Drives belong to `Revolute` and `Prismatic` joints."
    drives = [
        (drive, name, find_joint(groups, drive.joint, name, advice))
        for drive, name in named
        if isinstance(drive, joints.Drive)
    ]
    driven = [drive.joint for drive, *_ in drives]
    if len(set(driven)) < len(driven):
        twice = sorted({joint for joint in driven if driven.count(joint) > 1})
        raise ValueError(f"A joint has one drive; there are several of {twice}.")
    kinds = grouped(drives, lambda drive, name, found: found[0].kind)
    return groups + tuple(_group_drives(kind, bodies.planar, *own) for kind, own in kinds.items())


def find_joint(groups: tuple[JointGroup, ...], joint: str, name: str, advice: str) -> Found:
    """Find the hinge or slider for the force or drive called `name`."""
    groups = tuple(group for group in groups if group.motions is None)
    for group in groups:
        if joint not in group.attachment.names:
            continue
        if group.kind not in DRIVEN:
            raise ValueError(
                f"{name}: the joint {joint!r} is a {group.kind.__name__}, which has no single coordinate. {advice}"
            )
        return group, group.attachment.names.index(joint)
    known = [name for group in groups for name in group.attachment.names][:12]
    raise ValueError(f"{name} names the joint {joint!r}, which is not there. Joints are {known}.")


def attachment_of(found: tuple[Found, ...], names: tuple[str, ...]) -> Attachment:
    """Return the attachment to the bodies of joints, as these are."""
    first, second = (
        tuple(group.attachment.bodies[side][i] for group, i in found) for side in (0, 1)
    )
    points = stack([on_host(group.attachment.points)[:, i] for group, i in found], axis=1)
    axes = stack([on_host(group.attachment.axes)[:, i] for group, i in found], axis=1)
    return Attachment(names, (first, second), points, axes)


def _group_drives(
    kind: type, planar: bool, drives: tuple, names: tuple[str, ...], found: tuple[Found, ...]
) -> JointGroup:
    motions = Values("motion", names, (), [drive.motion for drive in drives])
    return JointGroup(kind, planar, attachment_of(found, names), jnp.zeros(len(names)), motions)


def _group_joints(kind: type, bodies: Bodies, things: tuple, names: tuple[str, ...]) -> JointGroup:
    planar = bodies.planar
    known = PLANAR if planar else SPATIAL
    if kind not in known:
        where = "the plane" if planar else "space"
        known = ", ".join(k.__name__ for k in known)
        raise ValueError(f"{names[0]}: joints in {where} are {known}.")
    axes = [joints.drawn_axes(t, n, planar) for t, n in zip(things, names, strict=True)]
    attachment = attach(bodies, things, names, axes)
    if kind is not joints.Distance:
        return JointGroup(kind, planar, attachment, stack([np.ones(())] * len(things)))
    return JointGroup(kind, planar, attachment, _lengths(bodies, attachment, things))


def _lengths(bodies: Bodies, attachment: Attachment, rods: tuple) -> Float[Array, " k"]:
    given: list[Array] = [rod.length for rod in rods]
    if any(length is None for length in given):
        drawn = _drawn_lengths(attachment, bodies.drawing)
        given = [drawn[i] if length is None else length for i, length in enumerate(given)]
    for i, name in enumerate(attachment.names):
        given[i] = length = check_shape(f"{name}: `length`", given[i], ())
        if is_concrete(length) and not float(length) > 0:
            raise ValueError(
                f"{name}: `length` must be a positive number, got {length}. Two points that stay together are a "
                "`Spherical` joint, or a `Revolute` one in the plane."
            )
    return stack(given)


@eqx.filter_jit
def _drawn_lengths(attachment: Attachment, drawing: Pose) -> Float[Array, " k"]:
    placed = Placed.of(with_ground(drawing.coordinates)[attachment.index])
    return length_of(attachment.sides_of(placed).gap)
