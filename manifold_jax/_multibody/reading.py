"""What the states of an assembly say: bodies by name, joints by name, energies."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, FloatScalar, RealScalarLike
from .bodies import Pose
from .checks import check_vector, floating
from .frames import Frames
from .joint_groups import reactions
from .joints import Prismatic, Revolute
from .loads import coordinate
from .rotations import rates_matrix, turn


Times = RealScalarLike | Float[Array | np.ndarray, "*t"]  # of one state, or of each


class Motion(NamedTuple):
    """The motion of one body: its centre of mass and orientation, velocity, and angular velocity
    in the
    coordinates of space (in the plane a number)."""

    position: Float[Array, "*t d"]
    orientation: Float[Array, "..."]
    velocity: Float[Array, "*t d"]
    angular_velocity: Float[Array, "..."]


class JointForce(NamedTuple):
    """What a joint does to its second body: a force (N) at the joint's point of that body and a
    torque (N m) about it, in the coordinates of space; the opposite acts on the first."""

    force: Float[Array, "*t d"]
    torque: Float[Array, "..."]


class Energy(NamedTuple):
    """Kinetic energy, and potential energy of weight and springs (J)."""

    kinetic: Float[Array, "*t"]
    potential: Float[Array, "*t"]

    @property
    def total(self) -> Float[Array, "*t"]:
        return self.kinetic + self.potential


def over_times(function: Callable) -> Callable:
    """Map a function over states with leading axes, too, such as `sol.ys`."""

    def spread(assembly: Any, y: tuple[Pose, Pose], *rest: Any) -> Any:
        if y[0].position.ndim == 2:
            return function(assembly, y, *rest)
        return jax.vmap(lambda y: spread(assembly, y, *rest))(y)

    return spread


@over_times
def motion(assembly: Any, y: tuple[Pose, Pose], name: str) -> Motion:
    i = assembly.bodies.moving_index(name, "`motion`")
    q, v = y
    spin = Frames.of(q, v).spin[i]
    return Motion(
        q.position[i], q.orientation[i], v.position[i], spin[2] if assembly.bodies.planar else spin
    )


@over_times
def point(assembly: Any, y: tuple[Pose, Pose], name: str, at: Any) -> tuple[Array, Array]:
    """Position and velocity."""
    d = 2 if assembly.bodies.planar else 3
    i = assembly.bodies.index(name, "`point`")
    at = check_vector("`at`", at, d)
    frames = Frames.of(*y)
    arm = frames.rotation[i][:, :d] @ at
    return (
        (frames.origin[i] + arm)[:d],
        (frames.velocity[i] + jnp.cross(frames.spin[i], arm))[:d],
    )


@over_times
def joint_coordinates(assembly: Any, y: tuple[Pose, Pose]) -> dict[str, FloatScalar]:
    frames, found = Frames.of(*y), {}
    for group in assembly.joints:
        if group.kind in (Revolute, Prismatic) and group.motions is None:
            values = coordinate(group.attachment.sides(frames), group.kind is Revolute)
            found |= dict(zip(group.attachment.names, values, strict=True))
    return found


@over_times
def energy(assembly: Any, y: tuple[Pose, Pose]) -> Energy:
    q, v = y
    bodies, frames = assembly.bodies, Frames.of(q, v)
    moving = jnp.sum(bodies.mass[:, None] * v.position**2)
    if bodies.planar:
        turning = jnp.sum(bodies.inertia * v.orientation**2)
    else:
        spin = 2 * turn(rates_matrix(q.orientation), v.orientation)
        turning = jnp.sum(spin * turn(bodies.inertia, spin))
    weight = -jnp.sum(bodies.mass * (frames.origin[:-1] @ assembly.gravity))
    stored = sum((loads.potential(frames) for loads in assembly.loads), weight)
    return Energy((moving + turning) / 2, stored)


def joint_forces(
    assembly: Any, t: Times, y: tuple[Pose, Pose], args: Args
) -> dict[str, JointForce]:
    if y[0].position.ndim > 2:
        times = jnp.broadcast_to(floating(t), y[0].position.shape[:1])
        return jax.vmap(lambda t, y: joint_forces(assembly, t, y, args))(times, y)
    multipliers = assembly.system.multipliers(t, y, args)
    frames, planar = Frames.of(*y), assembly.bodies.planar
    found, start = {}, 0
    for group in assembly.joints_at(t, args):
        k, r = group.equations(group.attachment.sides(frames), group.length).shape
        own = multipliers[start : start + k * r].reshape(k, r)
        start += k * r
        for name, force, torque in zip(
            group.attachment.names, *reactions(group, frames, own), strict=True
        ):
            found[name] = JointForce(
                force[:2] if planar else force, torque[2] if planar else torque
            )
    return found
