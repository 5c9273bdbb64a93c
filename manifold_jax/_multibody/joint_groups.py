"""The joints of an assembly, those of one kind together: residuals, Jacobian, and what they transmit."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from . import joints
from .attachment import attach, Attachment
from .bodies import Bodies, Pose
from .checks import check_number, evaluate, is_concrete, stack
from .equations import DRIVEN, PLANAR, SPATIAL
from .frames import Frames, Placed, with_ground
from .rotations import length_of


class JointGroup(eqx.Module):
    """All joints of one kind, or all drives of hinges or of sliders: these have `motions`."""

    kind: type = eqx.field(static=True)
    planar: bool = eqx.field(static=True)
    attachment: Attachment
    length: Float[Array, " k"]  # of rods; of drives where their joints have to be
    motions: tuple | None = None

    @staticmethod
    def of(kind: type, bodies: Bodies, things: list[Any], names: list[str]) -> "JointGroup":
        planar = bodies.planar
        if kind not in (PLANAR if planar else SPATIAL):
            known = ", ".join(k.__name__ for k in (PLANAR if planar else SPATIAL))
            where = "the plane" if planar else "space"
            raise ValueError(f"{names[0]}: joints in {where} are {known}.")
        axes = [joints.drawn_axes(t, n, planar) for t, n in zip(things, names, strict=True)]
        attachment = attach(bodies, things, names, axes)
        if kind is not joints.Distance:
            return JointGroup(kind, planar, attachment, stack([np.ones(())] * len(things)))
        return JointGroup(kind, planar, attachment, _lengths(bodies, attachment, things))

    def residual(self, placed: Placed) -> Float[Array, "k r"]:
        """`placed` are the bodies of the joints, `(2, k, ...)`."""
        return self.equations(self.attachment.sides_of(placed), self.length)

    def at(self, t: RealScalarLike, args: Args) -> "JointGroup":
        """Return the group with its motions at the time."""
        if self.motions is None:
            return self
        names = self.attachment.names
        return dataclasses.replace(
            self, length=evaluate("motion", self.motions, t, args, (), names)
        )

    @property
    def equations(self) -> Callable:
        if self.motions is not None:
            return DRIVEN[self.kind]
        return (PLANAR if self.planar else SPATIAL)[self.kind]


def group_joints(
    bodies: Bodies, named: Iterable[tuple[joints.AbstractJoint, str]]
) -> tuple[JointGroup, ...]:
    """The joints by their kinds, in the order in which these come first."""
    kinds: dict[type, tuple[list, list]] = {}
    for joint, name in named:
        of_kind = kinds.setdefault(type(joint), ([], []))
        of_kind[0].append(joint)
        of_kind[1].append(name)
    return tuple(JointGroup.of(kind, bodies, *of_kind) for kind, of_kind in kinds.items())


Found = tuple[JointGroup, int]  # a joint: its group and its place in that


def find_joint(groups: tuple[JointGroup, ...], joint: str, name: str) -> Found:
    """Find the joint for the force or drive called `name`."""
    groups = tuple(group for group in groups if group.motions is None)
    for group in groups:
        if joint in group.attachment.names:
            return group, group.attachment.names.index(joint)
    known = [name for group in groups for name in group.attachment.names][:12]
    raise ValueError(f"{name} names the joint {joint!r}, which is not there. Joints are {known}.")


def attachment_of(found: list[Found], names: Sequence[str]) -> Attachment:
    """Return the attachment to the bodies of joints, as these are."""

    def of_joints(part: str) -> Array:
        rows = [(getattr(group.attachment, part), i) for group, i in found]
        if all(is_concrete(row) for row, _ in rows):
            return jnp.asarray(np.stack([np.asarray(row)[:, i] for row, i in rows], axis=1))
        return jnp.stack([row[:, i] for row, i in rows], axis=1)

    first, second = (
        tuple(group.attachment.bodies[side][i] for group, i in found) for side in (0, 1)
    )
    return Attachment(tuple(names), (first, second), of_joints("points"), of_joints("axes"))


def _lengths(bodies: Bodies, attachment: Attachment, things: list[Any]) -> Float[Array, " k"]:
    given: list[Array] = [rod.length for rod in things]
    if any(length is None for length in given):
        drawn = _drawn_lengths(attachment, bodies.drawing)
        given = [drawn[i] if length is None else length for i, length in enumerate(given)]
    for i, name in enumerate(attachment.names):
        given[i] = length = check_number(f"{name}: `length`", given[i])
        if is_concrete(length) and not float(length) > 0:
            raise ValueError(
                f"{name}: `length` must be a positive number, got {length}. Two points that stay together are a "
                "`Spherical` joint, or a `Revolute` one in the plane."
            )
    return stack(given)


@eqx.filter_jit
def _drawn_lengths(attachment: Attachment, drawing: Pose) -> Float[Array, " k"]:
    rows = with_ground(drawing)[attachment.index]
    return length_of(attachment.sides_of(Placed.of_rows(rows, drawing.planar)).gap)


def residuals(groups: tuple[JointGroup, ...], q: Pose) -> tuple[Float[Array, "k r"], ...]:
    """Return the residuals of all joints, kind by kind."""
    return _residuals(groups, with_ground(q)[_index(groups)], q.planar)


def jacobian(groups: tuple[JointGroup, ...], q: Pose) -> Float[Array, "r n c"]:
    """Derivatives of all equations of joints with respect to the coordinates of the bodies, of which
    each joint depends on two: one derivative for each coordinate of these, all joints at once."""
    index, rows = _index(groups), with_ground(q)
    number, size = rows.shape
    if not groups:
        return jnp.zeros((0, number - 1, size), rows.dtype)
    here = rows[index]
    along = lambda seed: jax.jvp(
        lambda here: _residuals(groups, here, q.planar),
        (here,),
        (jnp.broadcast_to(seed[:, None, :], here.shape),),
    )[1]
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


def _residuals(groups: tuple[JointGroup, ...], here: Float[Array, "2 k c"], planar: bool) -> Any:
    """Compute the residuals from the coordinates of the bodies of all joints."""
    placed = Placed.of_rows(here, planar)
    found, start = [], 0
    for group in groups:
        own = slice(start, start := start + len(group.attachment.names))
        found.append(group.residual(Placed(placed.origin[:, own], placed.rotation[:, own])))
    return tuple(found)


def _index(groups: tuple[JointGroup, ...]) -> np.ndarray:
    """First and second bodies of all joints, `(2, K)`."""
    none = np.zeros((2, 0), int)
    return np.concatenate([none, *(group.attachment.index for group in groups)], axis=1)


def reactions(
    group: JointGroup, frames: Frames, multipliers: Float[Array, "k r"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Forces and torques on the second bodies at the second points: `-lambda` times the change of
    the equations when that body is moved or turned."""
    sides = group.attachment.sides(frames)

    def moved(shift: Float[Array, "k 3"], angle: Float[Array, "k 3"]) -> Float[Array, "k r"]:
        """About the second point, to first order."""
        axes = sides.frame_second
        turned = axes + jnp.cross(angle[:, :, None], axes, axis=1)
        return group.equations(
            sides._replace(second=sides.second + shift, frame_second=turned), group.length
        )

    still = jnp.zeros_like(sides.second)
    _, pull = jax.vjp(moved, still, still)
    return pull(-multipliers)
