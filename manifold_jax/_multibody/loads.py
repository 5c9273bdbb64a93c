"""Loads: the effects of forces on the bodies, all of one kind in one array computation."""

import abc
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, FloatScalar, RealScalarLike
from .attachment import Attachment, Sides
from .bodies import Pose
from .checks import floating, is_concrete, Values
from .frames import Frames, in_space, Vectors
from .known_coordinates import HALF_TURN, KnownCoordinates
from .rotations import dot, length_of, turn


Wrench = tuple[Float[Array, "n 3"], Float[Array, "n 3"]]  # forces, torques about the origins
State = tuple[Pose, Pose]


class AbstractLoads(eqx.Module):
    """All forces of one kind."""

    @abc.abstractmethod
    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        """Return forces and torques on the bodies and, last, the ground, in the state `y` with these
        `frames`, where some coordinates of joints are `known`."""

    @abc.abstractmethod
    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        """Return the energy stored in springs."""

    @property
    def joints_with_whole_turns(self) -> tuple[str, ...]:
        """The hinges whose angles must be known beyond half a turn."""
        return ()


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

    def nearest(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return x

    @property
    def reach_beyond_half_a_turn(self) -> np.ndarray:
        if not (is_concrete(self.rest) and is_concrete(self.stiffness)):
            return np.zeros(self.rest.shape, bool)
        is_far = np.abs(np.asarray(self.rest)) > HALF_TURN
        return is_far & (np.asarray(self.stiffness) != 0)


class LineLoads(AbstractLoads):
    """Loads along lines between two points, against their distance: springs, dampers, cylinders."""

    attachment: Attachment
    laws: SpringLaws

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
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

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        return self.laws.energy(length_of(self.attachment.sides(frames).gap))


class JointLoads(AbstractLoads):
    """Loads in hinges, or in sliders, with the names `joints`."""

    hinge: bool = eqx.field(static=True)
    joints: tuple[str, ...] = eqx.field(static=True)
    attachment: Attachment
    laws: Any  # `SpringLaws`, or others with the same methods

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        sides = self.attachment.sides(frames)
        axis = sides.frame_first[:, :, 2]
        first, second = self.attachment.index
        rate = self.attachment.rates(frames, sides, self.hinge)
        x = self._coordinates(sides, known)
        push = -self.laws.force(x, rate, t, args)[:, None] * axis
        none = jnp.zeros_like(axis)
        force, torque = (none, push) if self.hinge else (push, none)
        # both at the second point: a slider's force and its opposite lie on one line
        on_second = apply(frames, second, sides.second, force, torque)
        return add(on_second, apply(frames, first, sides.second, -force, -torque))

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        return self.laws.energy(self._coordinates(self.attachment.sides(frames), known))

    def _coordinates(self, sides: Sides, known: KnownCoordinates) -> Float[Array, " k"]:
        read = sides.coordinate(self.hinge)
        return known.instead_of(self.laws.nearest(read) if self.hinge else read, self.joints)

    @property
    def joints_with_whole_turns(self) -> tuple[str, ...]:
        if not self.hinge:
            return ()
        return tuple(itertools.compress(self.joints, self.laws.reach_beyond_half_a_turn))


class BodyLoads(AbstractLoads):
    """Forces at points of bodies, or torques."""

    torque: bool = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    points: Float[Array, "k 3"]
    values: Values

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        index, value = np.asarray(self.bodies), self.values.at(t, args)
        if value.ndim == 1:  # about the normal of the plane
            value = jnp.pad(value[:, None], ((0, 0), (2, 0)))
        value, none = in_space(value), jnp.zeros_like(self.points)
        if self.torque:
            return apply(frames, index, frames.origin[index], none, value)
        arm = turn(frames.rotation[index], self.points)
        return apply(frames, index, frames.origin[index] + arm, value, none)

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


class ControlledLoads(AbstractLoads):
    """Loads of one controller in hinges and sliders."""

    hinges: tuple[bool, ...] = eqx.field(static=True)
    attachment: Attachment
    law: Callable

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        values = floating(self.law(t, y, args))
        if values.shape != (len(self.hinges),):
            raise ValueError(
                f"`law` of a `Controller` must return one value for each of its joints, shape ({len(self.hinges)},), got "
                f"{values.shape}."
            )
        return apply_in_joints(frames, self.attachment, self.hinges, values)

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


class RotationalLoads(AbstractLoads):
    """Loads of dampers against the angular velocities of second bodies relative to first ones."""

    bodies: tuple[tuple[int, ...], tuple[int, ...]] = eqx.field(static=True)
    damping: Float[Array, " k"]

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        first, second = np.asarray(self.bodies)
        torque = self.damping[:, None] * (frames.spin[first] - frames.spin[second])
        none = jnp.zeros_like(torque)
        on_second = apply(frames, second, frames.origin[second], none, torque)
        return add(on_second, apply(frames, first, frames.origin[first], none, -torque))

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        return jnp.zeros((), frames.origin.dtype)


def apply_in_joints(
    frames: Frames, attachment: Attachment, hinges: tuple[bool, ...], values: Float[Array, " k"]
) -> Wrench:
    """Apply torques in hinges, and forces in sliders, in the directions of their coordinates."""
    sides = attachment.sides(frames)
    push = values[:, None] * sides.frame_first[:, :, 2]
    turns = np.array(hinges)[:, None]
    force, torque = jnp.where(turns, 0, push), jnp.where(turns, push, 0)
    first, second = attachment.index
    on_second = apply(frames, second, sides.second, force, torque)
    return add(on_second, apply(frames, first, sides.second, -force, -torque))


def apply(frames: Frames, index: np.ndarray, at: Vectors, force: Any, torque: Any) -> Wrench:
    """Sum forces at points in world coordinates, and torques, for every body about its origin."""
    torque = torque + jnp.cross(at - frames.origin[index], force)
    none = jnp.zeros_like(frames.origin)
    return none.at[index].add(force), none.at[index].add(torque)


def add(a: Wrench, b: Wrench) -> Wrench:
    return a[0] + b[0], a[1] + b[1]
