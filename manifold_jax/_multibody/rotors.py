"""Rotors that turn with hinges and sliders, all of one kind of joint together."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import forces, joints
from .attachment import Attachment, grouped, name_all
from .checks import check_shape, is_concrete, stack
from .frames import Frames
from .joint_groups import attachment_of, find_joint, JointGroup


_ADVICE = "Rotors belong to `Revolute` and `Prismatic` joints."


class Rotors(eqx.Module):
    """Inertias `(k,)` against the coordinates of hinges, or of sliders, with the names `joints`."""

    joints: tuple[str, ...] = eqx.field(static=True)
    hinge: bool = eqx.field(static=True)
    attachment: Attachment
    inertia: Float[Array, " k"]

    def energy(self, frames: Frames) -> Float[Array, ""]:
        """Return the kinetic energy."""
        sides = self.attachment.sides(frames)
        rates = self.attachment.rates(frames, sides, self.hinge)
        return jnp.sum(self.inertia * rates**2) / 2


def group_rotors(groups: tuple[JointGroup, ...], given: Any) -> tuple[Rotors, ...]:
    named = [
        (rotor, name, find_joint(groups, rotor.joint, name, _ADVICE))
        for rotor, name in name_all(given, forces.AbstractForce, "force")
        if isinstance(rotor, forces.RotorInertia)
    ]
    kinds = grouped(named, lambda rotor, name, found: found[0].kind)
    return tuple(_of_kind(kind is joints.Revolute, *own) for kind, own in kinds.items())


def _of_kind(hinge: bool, rotors: tuple, names: tuple[str, ...], found: tuple) -> Rotors:
    inertia = [
        check_shape(f"{n}: `inertia`", rotor.inertia, ())
        for rotor, n in zip(rotors, names, strict=True)
    ]
    for value, name in zip(inertia, names, strict=True):
        if is_concrete(value) and np.asarray(value) < 0:
            raise ValueError(f"{name}: `inertia` must not be negative, got {float(value)}.")
    of_joints = tuple(rotor.joint for rotor in rotors)
    return Rotors(of_joints, hinge, attachment_of(found, names), stack(inertia))


def names_of(rotors: tuple[Rotors, ...]) -> tuple[str, ...]:
    """Return the names of all joints with rotors."""
    return tuple(name for group in rotors for name in group.joints)
