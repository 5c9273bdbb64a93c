"""Origins, rotation matrices and velocities of the frames of bodies in world coordinates."""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .bodies import Pose
from .rotations import planar_rotation, rates_matrix, rotation_matrix, turn


Vectors: TypeAlias = Float[Array, "k 3"]  # one for each of several joints or forces


class Placed(NamedTuple):
    """The placement of the frames of bodies; those in the plane are turned about the third axis."""

    origin: Float[Array, "*n 3"]
    rotation: Float[Array, "*n 3 3"]

    @staticmethod
    def of(rows: Float[Array, "*n c"]) -> "Placed":
        """Make frames from the coordinates of a [`Pose`][]."""
        if rows.shape[-1] == 3:
            return Placed(in_space(rows[..., :2]), planar_rotation(rows[..., 2]))
        return Placed(rows[..., :3], rotation_matrix(rows[..., 3:]))


def with_ground(rows: Float[Array, "n c"]) -> Float[Array, "n_and_1 c"]:
    """Append the coordinates of the ground to those of the bodies."""
    upright = np.zeros((1, rows.shape[-1]))
    upright[0, 3:4] = 1  # of a quaternion
    return jnp.concatenate([rows, jnp.asarray(upright, rows.dtype)])


class Frames(NamedTuple):
    """Origins, rotations, velocities and angular velocities of all bodies and, last, of the ground, in
    world coordinates."""

    origin: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    velocity: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]

    @staticmethod
    def of(q: Pose, v: Pose) -> "Frames":
        rows = with_ground(q.coordinates)
        origin, rotation = Placed.of(rows)
        rates = jnp.pad(v.coordinates, ((0, 1), (0, 0)))
        if q.planar:
            spin = jnp.pad(rates[:, 2:], ((0, 0), (2, 0)))
            return Frames(origin, rotation, in_space(rates[:, :2]), spin)
        spin = turn(rotation, 2 * turn(rates_matrix(rows[:, 3:]), rates[:, 3:]))
        return Frames(origin, rotation, rates[:, :3], spin)


@jax.jit
def in_space(rows: Float[Array, "*n d"]) -> Float[Array, "*n 3"]:
    """Return vectors in the plane with a third component of zero."""
    return jnp.pad(rows, ((0, 0),) * (rows.ndim - 1) + ((0, 3 - rows.shape[-1]),))
