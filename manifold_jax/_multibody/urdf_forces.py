"""Dampers, motors and stops in the joints of a URDF file."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._base.user_functions import check_function
from .checks import floating
from .contacts import stops_at
from .forces import AbstractForce, JointSpring, Motor
from .joints import AbstractJoint, Prismatic, Revolute
from .urdf_elements import Joint


def dampers_of(elements: Sequence[Joint], joints: Sequence[AbstractJoint]) -> list[AbstractForce]:
    single = _hinges_and_sliders(joints)
    damped = [joint for joint in elements if joint.damping != 0]
    if lost := [joint.name for joint in damped if joint.name not in single]:
        raise ValueError(
            f"`file` gives damping to {', '.join(lost)}, which is part of a joint with several coordinates or does not "
            "move. Remove it, and add a `Damper` or `Torque` by `forces`."
        )
    found: list[Any] = [
        JointSpring(joint.name, damping=joint.damping, name=f"damping of {joint.name}")  # pyright: ignore[reportCallIssue]
        for joint in damped
    ]
    return found


def stops_of(
    stops: Callable | None,
    limits: Mapping[str, tuple[float, float]],
    drawn: Mapping[str, float],
    joints: Sequence[AbstractJoint],
) -> list[AbstractForce]:
    """Return the stops at limits, those of joints that are a hinge or slider here as in the file."""
    single = _hinges_and_sliders(joints)
    return stops_at(
        stops,
        {
            name: (a - drawn[name], b - drawn[name])
            for name, (a, b) in limits.items()
            if name in single
        },
    )


def _hinges_and_sliders(joints: Sequence[AbstractJoint]) -> set[str]:
    single = (joint for joint in joints if isinstance(joint, Revolute | Prismatic))
    return {joint.name for joint in single if joint.name is not None}


def motors_of(
    motors: tuple[str, ...], joints: Sequence[AbstractJoint], control: Callable | None
) -> list[AbstractForce]:
    if control is None:
        return []
    check_function("control", control, "f(t, args)")
    if not motors:
        raise ValueError(
            "`control` needs motors: name their joints in `closures`, {'name_mot': [...]}."
        )
    single = _hinges_and_sliders(joints)
    if passive := [name for name in motors if name not in single]:
        raise ValueError(
            f"`closures`: 'name_mot' has {passive}, which have no single coordinate for a torque or force: motors belong to "
            "hinges and sliders between links with mass."
        )
    values = [_Control(control, i, len(motors)) for i in range(len(motors))]
    found: list[Any] = [Motor(*pair) for pair in zip(motors, values, strict=True)]  # pyright: ignore[reportCallIssue]
    return found


class _Control(eqx.Module):
    """One of the values of `control`."""

    control: Callable
    index: int = eqx.field(static=True)
    number: int = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, args: Args) -> Float[Array, ""]:
        values = floating(self.control(t, args))
        if values.shape != (self.number,):
            raise ValueError(
                f"`control` must return the values of all motors, shape ({self.number},), got {values.shape}."
            )
        return values[self.index]
