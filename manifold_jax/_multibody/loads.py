"""What forces do to the bodies, all of one kind in one array computation."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalar, RealScalarLike
from .._user_function import check_function
from . import forces, joints
from .bodies import Bodies, Frames, in_space, stack
from .checks import check_vector, floating
from .equations import attach, Attachment, JointGroup, name_all


Wrench = tuple[Float[Array, "n 3"], Float[Array, "n 3"]]  # forces, torques about the origins


class AbstractLoads(eqx.Module):
    """All forces of one kind."""

    @abc.abstractmethod
    def wrench(self, t: RealScalarLike, frames: Frames, args: Args) -> Wrench:
        """Forces and torques on the bodies and, last, the ground."""

    @abc.abstractmethod
    def potential(self, frames: Frames) -> FloatScalar:
        """The energy stored in springs."""


def evaluate(
    values: tuple, t: RealScalarLike, args: Args, shape: tuple[int, ...], names: tuple[str, ...]
) -> Array:
    """Numbers, and functions `f(t, args)`, in one array `(k, *shape)`."""
    found = []
    for value, name in zip(values, names, strict=True):
        value = floating(value(t, args) if callable(value) else value)
        if value.shape != shape:
            raise ValueError(f"{name}: `value` must be of shape {shape}, got {value.shape}.")
        found.append(value)
    return stack(found)


class LineLoads(AbstractLoads):
    """Between two points: springs, dampers, cylinders."""

    attachment: Attachment
    stiffness: Float[Array, " k"]
    length: Float[Array, " k"]
    damping: Float[Array, " k"]
    values: tuple | None

    def wrench(self, t: RealScalarLike, frames: Frames, args: Args) -> Wrench:
        sides = self.attachment.sides(frames)
        distance = jnp.sqrt(jnp.sum(sides.gap**2, axis=1))
        direction = sides.gap / distance[:, None]
        rate = jnp.sum(direction * self.attachment.velocities(frames, sides), axis=1)
        tension = self.stiffness * (distance - self.length) + self.damping * rate
        if self.values is not None:
            tension = tension - evaluate(self.values, t, args, (), self.attachment.names)
        pull = tension[:, None] * direction
        none = jnp.zeros_like(pull)
        first, second = (np.asarray(index) for index in self.attachment.bodies)
        at_first = apply(frames, first, sides.first, pull, none)
        return add(at_first, apply(frames, second, sides.second, -pull, none))

    def potential(self, frames: Frames) -> FloatScalar:
        gap = self.attachment.sides(frames).gap
        stretch = jnp.sqrt(jnp.sum(gap**2, axis=1)) - self.length
        return jnp.sum(self.stiffness * stretch**2) / 2


class JointLoads(AbstractLoads):
    """In hinges, or in sliders."""

    hinge: bool = eqx.field(static=True)
    attachment: Attachment
    stiffness: Float[Array, " k"]
    rest: Float[Array, " k"]
    damping: Float[Array, " k"]
    values: tuple | None

    def wrench(self, t: RealScalarLike, frames: Frames, args: Args) -> Wrench:
        sides = self.attachment.sides(frames)
        axis = sides.frame_first[:, :, 2]
        first, second = (np.asarray(index) for index in self.attachment.bodies)
        if self.hinge:
            rate = jnp.sum(axis * (frames.spin[second] - frames.spin[first]), axis=1)
        else:
            turning = jnp.cross(frames.spin[first], axis)
            rate = jnp.sum(axis * self.attachment.velocities(frames, sides), axis=1)
            rate = rate + jnp.sum(turning * sides.gap, axis=1)
        size = -self.stiffness * (coordinate(sides, self.hinge) - self.rest) - self.damping * rate
        if self.values is not None:
            size = size + evaluate(self.values, t, args, (), self.attachment.names)
        push, none = size[:, None] * axis, jnp.zeros_like(axis)
        force, torque = (none, push) if self.hinge else (push, none)
        # both at the second point: a slider's force and its opposite lie on one line
        on_second = apply(frames, second, sides.second, force, torque)
        return add(on_second, apply(frames, first, sides.second, -force, -torque))

    def potential(self, frames: Frames) -> FloatScalar:
        stretch = coordinate(self.attachment.sides(frames), self.hinge) - self.rest
        return jnp.sum(self.stiffness * stretch**2) / 2


def coordinate(sides: Any, hinge: bool) -> Float[Array, " k"]:
    return sides.angle if hinge else sides.along(2)


class BodyLoads(AbstractLoads):
    """Forces at points of bodies, or torques."""

    torque: bool = eqx.field(static=True)
    planar: bool = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    points: Float[Array, "k 3"]
    values: tuple

    def wrench(self, t: RealScalarLike, frames: Frames, args: Args) -> Wrench:
        index = np.asarray(self.bodies)
        shape = (() if self.torque else (2,)) if self.planar else (3,)
        value = evaluate(self.values, t, args, shape, self.names)
        if value.ndim == 1:  # about the normal of the plane
            value = jnp.pad(value[:, None], ((0, 0), (2, 0)))
        value, none = in_space(value), jnp.zeros_like(self.points)
        if self.torque:
            return apply(frames, index, frames.origin[index], none, value)
        arm = jnp.sum(frames.rotation[index] * self.points[:, None, :], axis=2)
        return apply(frames, index, frames.origin[index] + arm, value, none)

    def potential(self, frames: Frames) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


def apply(
    frames: Frames,
    index: np.ndarray,
    at: Float[Array, "k 3"],
    force: Float[Array, "k 3"],
    torque: Float[Array, "k 3"],
) -> Wrench:
    """Forces at points of space, and torques, summed for every body about its origin."""
    torque = torque + jnp.cross(at - frames.origin[index], force)
    none = jnp.zeros_like(frames.origin)
    return none.at[index].add(force), none.at[index].add(torque)


def add(a: Wrench, b: Wrench) -> Wrench:
    return a[0] + b[0], a[1] + b[1]


def group_forces(
    bodies: Bodies, groups: tuple[JointGroup, ...], given: Any
) -> tuple[AbstractLoads, ...]:
    """Forces of one kind together."""
    kinds: dict[Any, tuple[list, list]] = {}
    names = name_all(given, forces.AbstractForce, "force")
    for force, name in zip(given, names, strict=True):
        value = getattr(force, "value", None)
        if callable(value):
            check_function(f"value` of `{name}", value, "f(t, args)")
        kind = _kind(force, name, groups)
        of_kind = kinds.setdefault(kind, ([], []))
        of_kind[0].append(force)
        of_kind[1].append(name)
    build = {"line": _lines, "hinge": _in_joints, "slider": _in_joints}
    return tuple(
        build.get(kind, _on_bodies)(bodies, groups, things, list(own), kind)
        for kind, (things, own) in kinds.items()
    )


def _kind(force: Any, name: str, groups: tuple[JointGroup, ...]) -> str:
    if isinstance(force, forces.Spring | forces.Damper | forces.LinearActuator):
        return "line"
    if isinstance(force, forces.JointSpring | forces.Motor):
        kind = _find_joint(groups, force.joint, name)[0].kind
        if kind not in (joints.Revolute, joints.Prismatic):
            raise ValueError(
                f"{name}: the joint {force.joint!r} is a {kind.__name__}, which has no single coordinate. Springs and "
                "motors belong to `Revolute` and `Prismatic` joints; between points use `Spring` and `LinearActuator`."
            )
        return "hinge" if kind is joints.Revolute else "slider"
    return "torque" if isinstance(force, forces.Torque) else "force"


def _find_joint(groups: tuple[JointGroup, ...], joint: str, name: str) -> tuple[JointGroup, int]:
    for group in groups:
        if joint in group.attachment.names:
            return group, group.attachment.names.index(joint)
    known = [name for group in groups for name in group.attachment.names][:12]
    raise ValueError(f"{name} names the joint {joint!r}, which is not there. Joints are {known}.")


def _numbers(things: list[Any], names: list[str], *parts: str) -> list[Array]:
    arrays = []
    for part in parts:
        values = [floating(getattr(thing, part)) for thing in things]
        for value, name in zip(values, names, strict=True):
            if value.shape != ():
                raise ValueError(f"{name}: `{part}` must be a number, got shape {value.shape}.")
        arrays.append(stack(values))
    return arrays


def _values(things: list[Any]) -> tuple | None:
    """`None` where nothing is driven."""
    values = tuple(
        thing.value if callable(thing.value) else floating(thing.value) for thing in things
    )
    driven = any(isinstance(thing, forces.Motor | forces.LinearActuator) for thing in things)
    return values if driven else None


def _lines(bodies: Bodies, groups: Any, things: list, names: list[str], kind: str) -> LineLoads:
    axes = [(np.array([0.0, 0.0, 1.0]),) * 2] * len(things)
    attachment = attach(bodies, things, names, axes)
    numbers = _numbers(things, names, "stiffness", "length", "damping")
    return LineLoads(attachment, *numbers, _values(things))  # pyright: ignore[reportCallIssue]


def _in_joints(
    bodies: Bodies, groups: Any, things: list, names: list[str], kind: str
) -> JointLoads:
    found = [
        _find_joint(groups, thing.joint, name) for thing, name in zip(things, names, strict=True)
    ]
    both = lambda part: jnp.stack([getattr(g.attachment, part)[:, i] for g, i in found], axis=1)
    index = tuple(tuple(g.attachment.bodies[side][i] for g, i in found) for side in (0, 1))
    attachment = Attachment(tuple(names), index, both("points"), both("axes"))  # pyright: ignore[reportArgumentType]
    numbers = _numbers(things, names, "stiffness", "rest", "damping")
    return JointLoads(kind == "hinge", attachment, *numbers, _values(things))  # pyright: ignore[reportCallIssue]


def _on_bodies(bodies: Bodies, groups: Any, things: list, names: list[str], kind: str) -> BodyLoads:
    index, points = [], []
    d = 2 if bodies.planar else 3
    for thing, name in zip(things, names, strict=True):
        index.append(bodies.index(thing.body, name))
        point = getattr(thing, "point", None)
        points.append(check_vector(f"{name}: `point`", np.zeros(d) if point is None else point, d))
    values = tuple(t.value if callable(t.value) else floating(t.value) for t in things)
    return BodyLoads(
        kind == "torque", bodies.planar, tuple(names), tuple(index), in_space(stack(points)), values
    )
