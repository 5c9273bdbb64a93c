"""Joints and drives of an assembly, grouped by kind: residuals, Jacobian, and reaction forces."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from . import joints
from .attachment import attach, Attachment, grouped, name_all, Sides
from .bodies import Bodies, Pose
from .checks import check_shape, is_concrete, on_host, stack, Values
from .equations import DRIVEN, PLANAR, SPATIAL
from .frames import Frames, Placed, Vectors, with_ground
from .rotations import length_of


class JointGroup(eqx.Module):
    """All joints of one kind, or all drives of hinges or of sliders: the latter have `motions`."""

    kind: type = eqx.field(static=True)
    planar: bool = eqx.field(static=True)
    attachment: Attachment
    length: Float[Array, " k"]  # of rods; of drives the prescribed coordinates
    motions: Values | None = None

    def residual(self, sides: Sides) -> Float[Array, "k r"]:
        if self.motions is not None:
            return DRIVEN[self.kind](sides, self.length)
        return (PLANAR if self.planar else SPATIAL)[self.kind](sides, self.length)

    @property
    def unit(self) -> str | None:
        """The unit of the equations of drives; those of joints have several."""
        if self.motions is None:
            return None
        return "rad" if self.kind is joints.Revolute else "m"

    def at(self, t: RealScalarLike, args: Args) -> "JointGroup":
        """Return the group with its motions at the time."""
        if self.motions is None:
            return self
        return dataclasses.replace(self, length=self.motions.at(t, args))


Found = tuple[JointGroup, int]  # a joint: its group, and its place in the group


def group_restraints(bodies: Bodies, given: Any) -> tuple[JointGroup, ...]:
    named = name_all(given, joints.AbstractRestraint, "joint")
    of_joints = [pair for pair in named if isinstance(pair[0], joints.AbstractJoint)]
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
    """Return the attachments of these joints."""
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


def residuals(groups: tuple[JointGroup, ...], q: Pose) -> tuple[Float[Array, "k r"], ...]:
    """Return the residuals of all joints, kind by kind."""
    return residuals_of(groups, Placed.of(with_ground(q.coordinates)[bodies_of(groups)]))


def jacobian(groups: tuple[JointGroup, ...], q: Pose) -> Float[Array, "r n c"]:
    """Return the derivatives of all equations of joints with respect to the coordinates of the bodies.
    Each joint depends on two: one derivative for each of their coordinates, for all joints at once."""
    index, rows = bodies_of(groups), with_ground(q.coordinates)
    number, size = rows.shape
    if not groups:
        return jnp.zeros((0, number - 1, size), rows.dtype)
    here = rows[index]
    moved = lambda here: residuals_of(groups, Placed.of(here))
    along = lambda seed: jax.jvp(moved, (here,), (jnp.broadcast_to(seed[:, None, :], here.shape),))[
        1
    ]
    seeds = jnp.eye(2 * size, dtype=here.dtype).reshape(2 * size, 2, size)
    slopes = jax.vmap(along)(seeds)
    entries = [jnp.moveaxis(slope.reshape(2, size, -1), 1, 2) for slope in slopes]
    counts = [slope.shape[2] for slope in slopes]
    per_joint = np.repeat(np.array(counts, int), [len(group.attachment.names) for group in groups])
    bodies = np.repeat(index, per_joint, axis=1)
    equations = np.arange(bodies.shape[1])[None, :]
    whole = jnp.zeros((bodies.shape[1], number, size), here.dtype)
    whole = whole.at[equations, bodies].set(jnp.concatenate(entries, axis=1), unique_indices=True)
    return whole[:, :-1]


def residuals_of(groups: tuple[JointGroup, ...], placed: Placed) -> tuple[Float[Array, "k r"], ...]:
    """Return the residuals from the frames of the first and second bodies of all joints, `(2, K, ...)`."""
    found, start = [], 0
    for group in groups:
        own = slice(start, start := start + len(group.attachment.names))
        bodies = Placed(placed.origin[:, own], placed.rotation[:, own])
        found.append(group.residual(group.attachment.sides_of(bodies)))
    return tuple(found)


def bodies_of(groups: tuple[JointGroup, ...]) -> np.ndarray:
    """Return the first and second bodies of all joints, shape `(2, K)`."""
    none = np.zeros((2, 0), int)
    return np.concatenate([none, *(group.attachment.index for group in groups)], axis=1)


def reactions(
    group: JointGroup, frames: Frames, multipliers: Float[Array, "k r"]
) -> tuple[Vectors, Vectors]:
    """Return forces and torques on the second bodies at the second points: `-lambda` times the change
    of the equations when that body is moved or turned."""
    sides = group.attachment.sides(frames)

    def moved(shift: Vectors, angle: Vectors) -> Float[Array, "k r"]:
        """Move and turn about the second point, to first order."""
        axes = sides.frame_second
        turned = axes + jnp.cross(angle[:, :, None], axes, axis=1)
        return group.residual(sides._replace(second=sides.second + shift, frame_second=turned))

    still = jnp.zeros_like(sides.second)
    _, pull = jax.vjp(moved, still, still)
    return pull(-multipliers)
