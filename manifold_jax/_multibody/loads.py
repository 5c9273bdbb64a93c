"""Loads: the effects of forces on the bodies, all of one kind in one array computation."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, FloatScalar, RealScalarLike
from .._base.user_functions import check_function
from . import forces, joints
from .attachment import attach, Attachment, grouped, name_all
from .bodies import Bodies, Pose
from .checks import check_shape, floating, is_concrete, stack, Values
from .equations import DRIVEN
from .frames import Frames, in_space, Vectors
from .joint_groups import attachment_of, find_joint, Found, JointGroup
from .rotations import dot, length_of, turn


_ADVICE = "Springs and motors belong to `Revolute` and `Prismatic` joints; between points use `Spring` and `LinearActuator`."
Wrench = tuple[Float[Array, "n 3"], Float[Array, "n 3"]]  # forces, torques about the origins
State = tuple[Pose, Pose]


class AbstractLoads(eqx.Module):
    """All forces of one kind."""

    @abc.abstractmethod
    def wrench(self, t: RealScalarLike, y: State, frames: Frames, args: Args) -> Wrench:
        """Return forces and torques on the bodies and, last, the ground, in the state `y` with these
        `frames`."""

    @abc.abstractmethod
    def potential(self, frames: Frames) -> FloatScalar:
        """Return the energy stored in springs."""


class SpringLaws(eqx.Module):
    """`stiffness (x - rest) + damping x' - value` against the coordinates `x` of `k` forces; `values`
    is `None` if there are none."""

    stiffness: Float[Array, " k"]
    rest: Float[Array, " k"]
    damping: Float[Array, " k"]
    values: Values | None

    def force(
        self, x: Float[Array, " k"], rate: Float[Array, " k"], t: RealScalarLike, args: Args
    ) -> Float[Array, " k"]:
        size = self.stiffness * (x - self.rest) + self.damping * rate
        if self.values is None:
            return size
        return size - self.values.at(t, args)

    def energy(self, x: Float[Array, " k"]) -> FloatScalar:
        return jnp.sum(self.stiffness * (x - self.rest) ** 2) / 2


class LineLoads(AbstractLoads):
    """Loads along lines between two points, against their distance: springs, dampers, cylinders."""

    attachment: Attachment
    laws: SpringLaws

    def wrench(self, t: RealScalarLike, y: State, frames: Frames, args: Args) -> Wrench:
        sides = self.attachment.sides(frames)
        velocities = self.attachment.velocities(frames, sides)
        pull = self._pull(t, sides.gap, velocities, args)
        none = jnp.zeros_like(pull)
        first, second = self.attachment.index
        at_first = apply(frames, first, sides.first, pull, none)
        return add(at_first, apply(frames, second, sides.second, -pull, none))

    def _pull(self, t: RealScalarLike, gap: Vectors, velocity: Vectors, args: Args) -> Vectors:
        """Return the forces on the first points. Where two points coincide, their relative motion gives
        the direction of the line: the limit for forces that have one; NaN for forces that jump from one
        side to the other."""
        distance = length_of(gap)
        apart = distance > 0
        direction = gap / jnp.where(apart, distance, 1)[:, None]
        rate = dot(direction, velocity)
        along = self.laws.force(distance, rate, t, args)[:, None] * direction
        none = jnp.zeros_like(distance)
        jump = self.laws.force(none, none, t, args)
        smooth = self.laws.stiffness[:, None] * gap + self.laws.damping[:, None] * velocity
        undefined = jnp.where(jump == 0, 0, jnp.nan).astype(gap.dtype)
        return jnp.where(apart[:, None], along, smooth + undefined[:, None])

    def potential(self, frames: Frames) -> FloatScalar:
        return self.laws.energy(length_of(self.attachment.sides(frames).gap))


class JointLoads(AbstractLoads):
    """Loads in hinges, or in sliders."""

    hinge: bool = eqx.field(static=True)
    attachment: Attachment
    laws: SpringLaws

    def wrench(self, t: RealScalarLike, y: State, frames: Frames, args: Args) -> Wrench:
        sides = self.attachment.sides(frames)
        axis = sides.frame_first[:, :, 2]
        first, second = self.attachment.index
        if self.hinge:
            rate = dot(axis, frames.spin[second] - frames.spin[first])
        else:
            turning = jnp.cross(frames.spin[first], axis)
            rate = dot(axis, self.attachment.velocities(frames, sides)) + dot(turning, sides.gap)
        push = -self.laws.force(sides.coordinate(self.hinge), rate, t, args)[:, None] * axis
        none = jnp.zeros_like(axis)
        force, torque = (none, push) if self.hinge else (push, none)
        # both at the second point: a slider's force and its opposite lie on one line
        on_second = apply(frames, second, sides.second, force, torque)
        return add(on_second, apply(frames, first, sides.second, -force, -torque))

    def potential(self, frames: Frames) -> FloatScalar:
        return self.laws.energy(self.attachment.sides(frames).coordinate(self.hinge))


class BodyLoads(AbstractLoads):
    """Forces at points of bodies, or torques."""

    torque: bool = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    points: Float[Array, "k 3"]
    values: Values

    def wrench(self, t: RealScalarLike, y: State, frames: Frames, args: Args) -> Wrench:
        index, value = np.asarray(self.bodies), self.values.at(t, args)
        if value.ndim == 1:  # about the normal of the plane
            value = jnp.pad(value[:, None], ((0, 0), (2, 0)))
        value, none = in_space(value), jnp.zeros_like(self.points)
        if self.torque:
            return apply(frames, index, frames.origin[index], none, value)
        arm = turn(frames.rotation[index], self.points)
        return apply(frames, index, frames.origin[index] + arm, value, none)

    def potential(self, frames: Frames) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


class ControlledLoads(AbstractLoads):
    """Loads of one controller in hinges and sliders."""

    hinges: tuple[bool, ...] = eqx.field(static=True)
    attachment: Attachment
    law: Callable

    def wrench(self, t: RealScalarLike, y: State, frames: Frames, args: Args) -> Wrench:
        values = floating(self.law(t, y, args))
        if values.shape != (len(self.hinges),):
            raise ValueError(
                f"`law` of a `Controller` must return one value for each of its joints, shape ({len(self.hinges)},), got "
                f"{values.shape}."
            )
        sides = self.attachment.sides(frames)
        push = values[:, None] * sides.frame_first[:, :, 2]
        turns = np.array(self.hinges)[:, None]
        force, torque = jnp.where(turns, 0, push), jnp.where(turns, push, 0)
        first, second = self.attachment.index
        on_second = apply(frames, second, sides.second, force, torque)
        return add(on_second, apply(frames, first, sides.second, -force, -torque))

    def potential(self, frames: Frames) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


def apply(frames: Frames, index: np.ndarray, at: Vectors, force: Any, torque: Any) -> Wrench:
    """Sum forces at points in world coordinates, and torques, for every body about its origin."""
    torque = torque + jnp.cross(at - frames.origin[index], force)
    none = jnp.zeros_like(frames.origin)
    return none.at[index].add(force), none.at[index].add(torque)


def add(a: Wrench, b: Wrench) -> Wrench:
    return a[0] + b[0], a[1] + b[1]


def group_forces(
    bodies: Bodies, groups: tuple[JointGroup, ...], given: Any
) -> tuple[AbstractLoads, ...]:
    in_joint = lambda force: isinstance(force, forces.AbstractJointForce)
    everything = name_all(given, forces.AbstractForce, "force")
    named = [
        (force, name, find_joint(groups, force.joint, name, _ADVICE) if in_joint(force) else None)
        for force, name in everything
        if not isinstance(force, forces.Controller)
    ]
    controlled = [
        _controlled(groups, force, name)
        for force, name in everything
        if isinstance(force, forces.Controller)
    ]
    kinds = grouped(named, _kind).items()
    return (*(_loads(kind, bodies, *own) for kind, own in kinds), *controlled)


def _controlled(
    groups: tuple[JointGroup, ...], controller: forces.Controller, name: str
) -> ControlledLoads:
    check_function(f"law` of `{name}", controller.law, "f(t, y, args)")
    if not controller.joints:
        raise ValueError(f"{name}: `joints` must name at least one hinge or slider.")
    advice = "Controllers belong to `Revolute` and `Prismatic` joints."
    found = tuple(find_joint(groups, joint, name, advice) for joint in controller.joints)
    hinges = tuple(group.kind is joints.Revolute for group, _ in found)
    return ControlledLoads(hinges, attachment_of(found, controller.joints), controller.law)


def _kind(force: Any, name: str, found: Found | None) -> type:
    """Return the kind of the joint that a force acts in, otherwise its own kind."""
    if found is not None:
        return found[0].kind
    kinds = forces.AbstractLineForce, forces.Torque
    return next((kind for kind in kinds if isinstance(force, kind)), forces.Force)


def _loads(
    kind: type, bodies: Bodies, things: tuple, names: tuple[str, ...], found: tuple
) -> AbstractLoads:
    if kind is forces.AbstractLineForce:
        return LineLoads(attach(bodies, things, names), _laws(things, names, "length"))
    if kind in DRIVEN:
        laws = _laws(things, names, "rest")
        return JointLoads(kind is joints.Revolute, attachment_of(found, names), laws)
    return _on_bodies(kind is forces.Torque, bodies, things, names)


def _laws(things: tuple, names: tuple[str, ...], rest: str) -> SpringLaws:
    """Return the laws of forces; missing arguments are zero."""
    named = list(zip(things, names, strict=True))
    stiffness, rest_at, damping = (
        stack([check_shape(f"{n}: `{word}`", getattr(thing, word, 0.0), ()) for thing, n in named])
        for word in ("stiffness", rest, "damping")
    )
    values = Values("value", names, (), [getattr(thing, "value", 0.0) for thing in things])
    driven = any(callable(v) or not is_concrete(v) or np.any(np.asarray(v)) for v in values.given)
    return SpringLaws(stiffness, rest_at, damping, values if driven else None)


def _on_bodies(torque: bool, bodies: Bodies, things: tuple, names: tuple[str, ...]) -> BodyLoads:
    d = 2 if bodies.planar else 3
    index, points = [], []
    for thing, name in zip(things, names, strict=True):
        index.append(bodies.moving_index(thing.body, name))
        point = getattr(thing, "point", None)
        point = np.zeros(d) if point is None else point
        points.append(check_shape(f"{name}: `point`", point, (d,)))
    shape = () if torque and bodies.planar else (d,)
    values = Values("value", names, shape, [thing.value for thing in things])
    return BodyLoads(torque, tuple(index), in_space(stack(points)), values)
