"""The joints of an assembly, those of one kind together: residuals, Jacobian, and what they transmit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .attachment import Attachment, Sides
from .bodies import Pose
from .checks import Values
from .equations import DRIVEN, PLANAR, SPATIAL
from .frames import Frames, Placed, with_ground


class JointGroup(eqx.Module):
    """All joints of one kind, or all drives of hinges or of sliders: these have `motions`."""

    kind: type = eqx.field(static=True)
    planar: bool = eqx.field(static=True)
    attachment: Attachment
    length: Float[Array, " k"]  # of rods; of drives where their joints have to be
    motions: Values | None = None

    def residual(self, sides: Sides) -> Float[Array, "k r"]:
        if self.motions is not None:
            return DRIVEN[self.kind](sides, self.length)
        return (PLANAR if self.planar else SPATIAL)[self.kind](sides, self.length)

    def at(self, t: RealScalarLike, args: Args) -> "JointGroup":
        """Return the group with its motions at the time."""
        if self.motions is None:
            return self
        return dataclasses.replace(self, length=self.motions.at(t, args))


def residuals(groups: tuple[JointGroup, ...], q: Pose) -> tuple[Float[Array, "k r"], ...]:
    """Return the residuals of all joints, kind by kind."""
    return _residuals(groups, with_ground(q.coordinates)[_index(groups)])


def jacobian(groups: tuple[JointGroup, ...], q: Pose) -> Float[Array, "r n c"]:
    """Derivatives of all equations of joints with respect to the coordinates of the bodies, of which
    each joint depends on two: one derivative for each coordinate of these, all joints at once."""
    index, rows = _index(groups), with_ground(q.coordinates)
    number, size = rows.shape
    if not groups:
        return jnp.zeros((0, number - 1, size), rows.dtype)
    here = rows[index]
    moved = lambda here: _residuals(groups, here)
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


def _residuals(groups: tuple[JointGroup, ...], here: Float[Array, "2 k c"]) -> Any:
    """Compute the residuals from the coordinates of the bodies of all joints."""
    placed = Placed.of(here)
    found, start = [], 0
    for group in groups:
        own = slice(start, start := start + len(group.attachment.names))
        bodies = Placed(placed.origin[:, own], placed.rotation[:, own])
        found.append(group.residual(group.attachment.sides_of(bodies)))
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
        return group.residual(sides._replace(second=sides.second + shift, frame_second=turned))

    still = jnp.zeros_like(sides.second)
    _, pull = jax.vjp(moved, still, still)
    return pull(-multipliers)
