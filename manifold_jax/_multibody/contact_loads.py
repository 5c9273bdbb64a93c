"""Loads of contacts that yield, and of friction, all of one kind together."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, FloatScalar, RealScalarLike
from .bodies import Bodies
from .checks import check_axis, check_shape, is_concrete, stack
from .frames import Frames, in_space
from .known_coordinates import KnownCoordinates
from .loads import AbstractLoads, apply, State, Wrench
from .rotations import dot, length_of, turn


_LARGEST = float(np.finfo(np.float32).max)  # limits beyond it are never reached


class StopLaws(eqx.Module):
    """The laws of [`JointStop`][] in `k` joints."""

    lower: Float[Array, " k"]
    upper: Float[Array, " k"]
    stiffness: Float[Array, " k"]
    dissipation: Float[Array, " k"]

    def force(
        self, x: Float[Array, " k"], rate: Float[Array, " k"], t: RealScalarLike, args: Args
    ) -> Float[Array, " k"]:
        below, above = self._depths(x)
        push = lambda depth, rate: _push(depth, rate, self.stiffness, self.dissipation)
        return push(above, rate) - push(below, -rate)

    def energy(self, x: Float[Array, " k"]) -> FloatScalar:
        below, above = self._depths(x)
        return jnp.sum(self.stiffness * (below**2 + above**2)) / 2

    def nearest(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """Return angles that are known but for whole turns: those nearest to the middle of the stops."""
        has_middle = (self.lower > -_LARGEST) & (self.upper < _LARGEST)
        middle = jnp.where(has_middle, (self.lower + self.upper) / 2, 0)
        return x - 2 * jnp.pi * jnp.round((x - middle) / (2 * jnp.pi))

    @property
    def reach_beyond_half_a_turn(self) -> np.ndarray:
        if not (is_concrete(self.lower) and is_concrete(self.upper)):
            return np.zeros(self.lower.shape, bool)
        limits = np.stack([self.lower, self.upper])
        number = np.sum(np.abs(limits) < _LARGEST, axis=0)
        is_alone = (number == 1) & (np.abs(limits).min(axis=0) >= np.pi)
        return is_alone | ((number == 2) & (limits[1] - limits[0] >= 2 * np.pi))

    def _depths(self, x: Float[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        return jax.nn.relu(self.lower - x), jax.nn.relu(x - self.upper)


class FrictionLaws(eqx.Module):
    """The laws of [`JointFriction`][] in `k` joints."""

    torque: Float[Array, " k"]
    slip: Float[Array, " k"]

    def force(
        self, x: Float[Array, " k"], rate: Float[Array, " k"], t: RealScalarLike, args: Args
    ) -> Float[Array, " k"]:
        return self.torque * rate / jnp.sqrt(rate**2 + self.slip**2)

    def energy(self, x: Float[Array, " k"]) -> FloatScalar:
        return jnp.zeros((), x.dtype)

    def nearest(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return x

    @property
    def reach_beyond_half_a_turn(self) -> np.ndarray:
        return np.zeros(self.torque.shape, bool)


class ContactLoads(AbstractLoads):
    """The forces of [`GroundContact`][] at `k` points, with a point and the unit normal of each plane."""

    bodies: tuple[int, ...] = eqx.field(static=True)
    points: Float[Array, "k 3"]
    at: Float[Array, "k 3"]
    normal: Float[Array, "k 3"]
    stiffness: Float[Array, " k"]
    dissipation: Float[Array, " k"]
    friction: Float[Array, " k"]
    slip: Float[Array, " k"]

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        index = np.asarray(self.bodies)
        arm = turn(frames.rotation[index], self.points)
        place = frames.origin[index] + arm
        velocity = frames.velocity[index] + jnp.cross(frames.spin[index], arm)
        rising = dot(self.normal, velocity)
        depth = self._depth(place)
        push = _push(depth, -rising, self.stiffness, self.dissipation)
        along = velocity - rising[:, None] * self.normal
        braking = self.friction * push / jnp.sqrt(dot(along, along) + self.slip**2)
        force = push[:, None] * self.normal - braking[:, None] * along
        return apply(frames, index, place, force, jnp.zeros_like(force))

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        index = np.asarray(self.bodies)
        place = frames.origin[index] + turn(frames.rotation[index], self.points)
        return jnp.sum(self.stiffness * self._depth(place) ** 2) / 2

    def _depth(self, place: Float[Array, "k 3"]) -> Float[Array, " k"]:
        return jax.nn.relu(dot(self.normal, self.at - place))


def _push(
    depth: Float[Array, " k"],
    rate: Float[Array, " k"],
    stiffness: Float[Array, " k"],
    dissipation: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return forces for the depths of contacts and their rates."""
    return stiffness * depth * jax.nn.relu(1 + dissipation * rate)


def stop_laws(stops: tuple, names: tuple[str, ...]) -> StopLaws:
    lower, upper = (_limits(word, stops, names) for word in ("lower", "upper"))
    if is_concrete(lower) and is_concrete(upper):
        for low, high, name in zip(np.asarray(lower), np.asarray(upper), names, strict=True):
            if not low < high:
                raise ValueError(
                    f"{name}: `lower` must be less than `upper`, got {low:.6g} and {high:.6g}."
                )
    stiffness = _numbers("stiffness", stops, names, positive=True)
    return StopLaws(lower, upper, stiffness, _numbers("dissipation", stops, names))


def _limits(word: str, stops: tuple, names: tuple[str, ...]) -> Float[Array, " k"]:
    found = []
    for stop, name in zip(stops, names, strict=True):
        value = getattr(stop, word)
        is_number = isinstance(value, float | np.number | np.ndarray | jax.Array)
        if is_number and is_concrete(value) and np.all(np.isinf(value)):
            value = np.copysign(_LARGEST, value)
        found.append(check_shape(f"{name}: `{word}`", value, ()))
    return stack(found)


def friction_laws(frictions: tuple, names: tuple[str, ...]) -> FrictionLaws:
    slip = _numbers("slip", frictions, names, positive=True)
    return FrictionLaws(_numbers("torque", frictions, names), slip)


def contact_loads(bodies: Bodies, contacts: tuple, names: tuple[str, ...]) -> ContactLoads:
    d = 2 if bodies.planar else 3
    index, points, places, normals = [], [], [], []
    for contact, name in zip(contacts, names, strict=True):
        index.append(bodies.moving_index(contact.body, name))
        points.append(check_shape(f"{name}: `point`", contact.point, (d,)))
        at = np.zeros(d) if contact.at is None else contact.at
        places.append(check_shape(f"{name}: `at`", at, (d,)))
        normal = np.eye(d)[-1] if contact.normal is None else contact.normal
        normal = in_space(check_shape(f"{name}: `normal`", normal, (d,)))
        normals.append(check_axis(f"{name}: `normal`", normal))
    normal = stack(normals)
    return ContactLoads(
        tuple(index),
        in_space(stack(points)),
        in_space(stack(places)),
        normal / length_of(normal)[:, None],
        _numbers("stiffness", contacts, names, positive=True),
        _numbers("dissipation", contacts, names),
        _numbers("friction", contacts, names),
        _numbers("slip", contacts, names, positive=True),
    )


def _numbers(
    word: str, things: tuple, names: tuple[str, ...], positive: bool = False
) -> Float[Array, " k"]:
    """Check numbers that are not negative, or positive."""
    found = []
    for thing, name in zip(things, names, strict=True):
        value = check_shape(f"{name}: `{word}`", getattr(thing, word), ())
        if is_concrete(value) and (value < 0 or (positive and value == 0)):
            allowed = "positive" if positive else "not negative"
            raise ValueError(f"{name}: `{word}` must be {allowed}, got {float(value)}.")
        found.append(value)
    return stack(found)
