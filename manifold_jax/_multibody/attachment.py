"""Attachment points and orthonormal frames of joints and forces in their two bodies."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import joints
from .bodies import Bodies, Pose
from .checks import check_sequence, stack, unique_names
from .frames import Frames, in_space, Placed, Vectors, with_ground
from .rotations import basis, compose, dot, turn, turn_back


class Sides(NamedTuple):
    """Points and frames of `k` joints in world coordinates, of their first and of their second bodies."""

    first: Vectors
    second: Vectors
    frame_first: Float[Array, "k 3 3"]
    frame_second: Float[Array, "k 3 3"]

    @property
    def gap(self) -> Vectors:
        return self.second - self.first

    def cosine(self, i: int, j: int) -> Float[Array, " k"]:
        """Return the cosine of the angle between axis `i` of the first and axis `j` of the second body."""
        return dot(
            jnp.unstack(self.frame_first, axis=2)[i], jnp.unstack(self.frame_second, axis=2)[j]
        )

    def along(self, i: int) -> Float[Array, " k"]:
        return dot(jnp.unstack(self.frame_first, axis=2)[i], self.gap)

    @property
    def angle(self) -> Float[Array, " k"]:
        """Return the angle about the third axis, zero in the drawing, from `-pi` to `pi`."""
        return jnp.arctan2(self.cosine(1, 0), self.cosine(0, 0))

    def coordinate(self, hinge: bool) -> Float[Array, " k"]:
        return self.angle if hinge else self.along(2)


class Attachment(eqx.Module):
    """The bodies to which `k` joints or forces belong (static: the graph of the mechanism), and their
    points and frames in these, for first and second bodies."""

    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[tuple[int, ...], tuple[int, ...]] = eqx.field(static=True)
    points: Float[Array, "2 k 3"]
    axes: Float[Array, "2 k 3 3"]

    @property
    def index(self) -> np.ndarray:
        return np.asarray(self.bodies)

    def sides(self, frames: Frames) -> Sides:
        return self.sides_of(Placed(frames.origin[self.index], frames.rotation[self.index]))

    def sides_of(self, placed: Placed) -> Sides:
        """Return the sides with the frames of the bodies to which they belong, `(2, k, ...)`."""
        at = placed.origin + turn(placed.rotation, self.points)
        axes = compose(placed.rotation, self.axes)
        return Sides(*jnp.unstack(at), *jnp.unstack(axes))

    def velocities(self, frames: Frames, sides: Sides) -> Vectors:
        """Return the velocities of the second points relative to the first."""
        arms = jnp.stack([sides.first, sides.second]) - frames.origin[self.index]
        moving = frames.velocity[self.index] + jnp.cross(frames.spin[self.index], arms)
        return moving[1] - moving[0]

    def rates(self, frames: Frames, sides: Sides, hinge: bool) -> Float[Array, " k"]:
        """Return the time derivatives of the coordinates of hinges, or of sliders."""
        axis = sides.frame_first[:, :, 2]
        first, second = self.index
        if hinge:
            return dot(axis, frames.spin[second] - frames.spin[first])
        turning = jnp.cross(frames.spin[first], axis)
        return dot(axis, self.velocities(frames, sides)) + dot(turning, sides.gap)


def attach(
    bodies: Bodies, things: Sequence[Any], names: Sequence[str], axes: Sequence[Any] | None = None
) -> Attachment:
    """Convert points and frames of the drawing to the frames of the bodies; `axes` are pairs."""
    placed = [_ends(bodies, thing, name) for thing, name in zip(things, names, strict=True)]
    index, is_drawn, ends = zip(*placed, strict=True)
    axes = [joints.UPRIGHT] * len(things) if axes is None else axes
    of_sides = lambda pairs: stack([stack(side) for side in zip(*pairs, strict=True)])
    first, second = zip(*index, strict=True)
    given = np.array(is_drawn), of_sides(ends), of_sides(axes)
    points, frames = _in_bodies(bodies.drawing, np.array((first, second)), *given)
    return Attachment(tuple(names), (first, second), points, frames)


@jax.jit  # one program, not one for each operation
def _in_bodies(
    drawing: Pose, index: Any, is_drawn: Any, given: Array, axes: Array
) -> tuple[Float[Array, "2 k 3"], Float[Array, "2 k 3 3"]]:
    origin, rotation = Placed.of(with_ground(drawing.coordinates)[index])
    given = in_space(given)
    in_body = turn_back(rotation, given - origin)
    frames = compose(jnp.swapaxes(rotation, -1, -2), basis(axes))
    return jnp.where(is_drawn[None, :, None], in_body, given), frames


def _ends(bodies: Bodies, thing: Any, name: str) -> tuple[tuple[int, int], bool, tuple[Any, Any]]:
    """Return the bodies of a joint or force, its points, and whether these are those of the drawing."""
    if thing.first == thing.second:
        raise ValueError(
            f"{name} connects {thing.first!r} with itself. Give two bodies, or `mj.multibody.GROUND`."
        )
    index = bodies.index(thing.first, name), bodies.index(thing.second, name)
    if isinstance(thing, joints.Fixed) and thing.at is None and thing.points is None:
        moving = index[1] if index[0] == len(bodies.names) else index[0]
        at = bodies.drawing.position[moving]
        return index, True, (at, at)
    return index, *joints.ends(thing, name, bodies.planar)


def name_all(given: Any, base: type, what: str) -> list[tuple[Any, str]]:
    """Return all joints or forces with their names; default names consist of kind and bodies."""
    things = check_sequence(f"{what}s", given, base, f"{what}s of `mj.multibody`")
    names, count = [], {}
    for thing in things:
        name = thing.name
        if name is None:
            own = [getattr(thing, part, None) for part in ("first", "second", "body", "joint")]
            own += getattr(thing, "joints", ())
            name = " ".join([type(thing).__name__, "-".join(str(part) for part in own if part)])
            count[name] = count.get(name, 0) + 1
            name = name if count[name] == 1 else f"{name} ({count[name]})"
        names.append(name)
    return list(zip(things, unique_names(what, names), strict=True))


def joints_named_by(things: Iterable[Any]) -> set[str]:
    """Return the names of the joints that forces, drives and couplings name."""
    found: set[str] = set()
    for thing in things:
        found |= {getattr(thing, word) for word in ("joint", "other") if hasattr(thing, word)}
        found |= set(getattr(thing, "joints", ()))
    return found


def grouped(things: Iterable[tuple], kind: Callable) -> dict[Any, zip]:
    """Group things by `kind(*thing)`, in order of first occurrence; transpose each group."""
    groups: dict[Any, list[tuple]] = {}
    for thing in things:
        groups.setdefault(kind(*thing), []).append(thing)
    return {kind: zip(*own, strict=True) for kind, own in groups.items()}
