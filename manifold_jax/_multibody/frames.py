"""Where the bodies are in space, and how they move: origins and rotation matrices of their frames."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .bodies import Pose
from .rotations import planar_rotation, rates_matrix, rotation_matrix, turn


class Placed(NamedTuple):
    """Where the frames of bodies are in space; those in the plane are turned about the third axis."""

    origin: Float[Array, "*n 3"]
    rotation: Float[Array, "*n 3 3"]

    @staticmethod
    def of(q: Pose) -> "Placed":
        turned = planar_rotation if q.planar else rotation_matrix
        return Placed(in_space(q.position), turned(q.orientation))

    @staticmethod
    def of_rows(rows: Float[Array, "*n c"], planar: bool) -> "Placed":
        """Make frames from rows of coordinates."""
        d = 2 if planar else 3
        return Placed.of(Pose(rows[..., :d], rows[..., 2] if planar else rows[..., 3:]))


def with_ground(q: Pose) -> Float[Array, "n_and_1 c"]:
    """A row of coordinates for each body and, last, for the ground."""
    upright = np.zeros((1, q.coordinates.shape[-1]))
    upright[0, 3:4] = 1  # of a quaternion
    return jnp.concatenate([q.coordinates, jnp.asarray(upright, q.coordinates.dtype)])


class Frames(NamedTuple):
    """Origins, rotations, velocities and angular velocities in space of all bodies and, last, of
    the ground."""

    origin: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    velocity: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]

    @staticmethod
    def of(q: Pose, v: Pose) -> "Frames":
        n = q.position.shape[0]
        origin, rotation = Placed.of(q)
        if q.planar:
            spin = jnp.stack([jnp.zeros(n, v.orientation.dtype)] * 2 + [v.orientation], axis=1)
        else:
            spin = turn(rotation, 2 * turn(rates_matrix(q.orientation), v.orientation))
        ground = jnp.eye(3, dtype=rotation.dtype)[None]
        still = lambda rows: jnp.concatenate([in_space(rows), jnp.zeros((1, 3), rows.dtype)])
        return Frames(
            still(origin), jnp.concatenate([rotation, ground]), still(v.position), still(spin)
        )


@jax.jit
def in_space(rows: Float[Array, "*n d"]) -> Float[Array, "*n 3"]:
    """Vectors in the plane with a third component of zero."""
    return jnp.pad(rows, ((0, 0),) * (rows.ndim - 1) + ((0, 3 - rows.shape[-1]),))
