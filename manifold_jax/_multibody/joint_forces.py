"""Forces and torques in joints, from the multipliers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.numbers import numbers_as_arrays
from .._base.types import Args, RealScalarLike
from .bodies import Pose
from .frames import Frames
from .joint_groups import reactions, residuals
from .known_coordinates import KnownCoordinates, NONE_KNOWN
from .reading import JointForce
from .system import system_in_poses


@numbers_as_arrays("args", times=("t",))
@eqx.filter_jit
def find_joint_forces(
    assembly: Any,
    t: RealScalarLike,
    y: tuple[Pose, Pose],
    args: Args,
    known: KnownCoordinates = NONE_KNOWN,
) -> dict[str, JointForce]:
    """Compiled also when called alone: operation by operation it takes many times as long."""
    multipliers, frames = _all_multipliers(assembly, t, y, args, known), Frames.of(*y)
    found, start = {}, 0
    for group in assembly.joints_at(t, args):
        k, r = group.residual(group.attachment.sides(frames)).shape
        own = multipliers[start : start + k * r].reshape(k, r)
        start += k * r
        forces, torques = reactions(group, frames, own)
        if assembly.bodies.planar:
            forces, torques = forces[:, :2], torques[:, 2]
        on_second = map(JointForce, forces, torques)
        found |= dict(zip(group.attachment.names, on_second, strict=True))
    return found


def _all_multipliers(
    assembly: Any,
    t: RealScalarLike,
    y: tuple[Pose, Pose],
    args: Args,
    known: KnownCoordinates,
) -> Float[Array, " m"]:
    """Return the multipliers of all joints; zero for equations that are not solved."""
    multipliers = system_in_poses(assembly, known).multipliers(t, y, args)
    if assembly.independent is None:
        return multipliers
    joints = sum(part.size for part in residuals(assembly.joints_at(t, args), y[0]))
    everything = jnp.zeros(joints + len(assembly.names), multipliers.dtype)
    return everything.at[np.array(assembly.independent.rows)].set(multipliers)
