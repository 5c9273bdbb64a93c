"""Results of an assembly from its states: bodies by name, joints by name, energies."""

import functools
from collections.abc import Callable
from typing import Any, cast, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .bodies import Pose


Times = RealScalarLike | Float[Array | np.ndarray, "*t"]  # of one state, or of each


class Motion(NamedTuple):
    """The motion of one body: its centre of mass and orientation, velocity, and angular velocity in
    world coordinates (in the plane a number)."""

    position: Float[Array, "*t d"]
    orientation: Float[Array, "..."]
    velocity: Float[Array, "*t d"]
    angular_velocity: Float[Array, "..."]


class JointForce(NamedTuple):
    """The reaction of a joint on its second body: a force (N) at the joint's point of that body and a
    torque (N m) about it, in world coordinates; the opposite acts on the first."""

    force: Float[Array, "*t d"]
    torque: Float[Array, "..."]


class Energy(NamedTuple):
    """Kinetic energy, and potential energy of weight and springs (J)."""

    kinetic: Float[Array, "*t"]
    potential: Float[Array, "*t"]

    @property
    def total(self) -> Float[Array, "*t"]:
        return self.kinetic + self.potential


Reading = TypeVar("Reading", bound=Callable)


def over_times(function: Reading) -> Reading:
    """Map a method over states with leading axes, too, such as `sol.ys`."""

    @functools.wraps(function)
    def spread(assembly: Any, y: tuple[Pose, Pose], *rest: Any, **named: Any) -> Any:
        if y[0].position.ndim == 2:
            return function(assembly, y, *rest, **named)
        return jax.vmap(lambda y: spread(assembly, y, *rest, **named))(y)

    return cast(Reading, spread)
