"""Equations of all joints of one kind, in one array computation.

A joint has a point and an orthonormal frame in each of its two bodies, `d` from the first point to
the second, `(u, v, w)` and `(u', v', w')` the axes. Lengths are in metres, products of axes have no
unit. Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 9.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import joints
from .bodies import Bodies, Frames, in_space, Placed, Pose, stack, with_ground
from .checks import floating, is_concrete, unique_names
from .rotations import basis, compose, dot, turn, turn_back


class Sides(NamedTuple):
    """Points and frames of `k` joints in space, of their first and of their second bodies."""

    first: Float[Array, "k 3"]
    second: Float[Array, "k 3"]
    frame_first: Float[Array, "k 3 3"]
    frame_second: Float[Array, "k 3 3"]

    @property
    def gap(self) -> Float[Array, "k 3"]:
        return self.second - self.first

    def cosine(self, i: int, j: int) -> Float[Array, " k"]:
        """Of the angle between axis `i` of the first and axis `j` of the second body."""
        return dot(self.frame_first[:, :, i], self.frame_second[:, :, j])

    def along(self, i: int) -> Float[Array, " k"]:
        return dot(self.frame_first[:, :, i], self.gap)

    @property
    def angle(self) -> Float[Array, " k"]:
        """About the third axis, zero in the drawing, from `-pi` to `pi`."""
        return jnp.arctan2(self.cosine(1, 0), self.cosine(0, 0))


def _columns(*parts: Float[Array, " k"]) -> Float[Array, "k r"]:
    return jnp.stack(parts, axis=1)


def _spherical(s: Sides, length: Any) -> Float[Array, "k 3"]:
    return s.gap


def _universal(s: Sides, length: Any) -> Float[Array, "k 4"]:
    return jnp.concatenate([s.gap, _columns(s.cosine(2, 2))], axis=1)


def _revolute(s: Sides, length: Any) -> Float[Array, "k 5"]:
    return jnp.concatenate([s.gap, _columns(s.cosine(0, 2), s.cosine(1, 2))], axis=1)


def _fixed(s: Sides, length: Any) -> Float[Array, "k 6"]:
    turned = _columns(s.cosine(0, 2), s.cosine(1, 2), s.cosine(0, 1))
    return jnp.concatenate([s.gap, turned], axis=1)


def _cylindrical(s: Sides, length: Any) -> Float[Array, "k 4"]:
    return _columns(s.along(0), s.along(1), s.cosine(0, 2), s.cosine(1, 2))


def _prismatic(s: Sides, length: Any) -> Float[Array, "k 5"]:
    return jnp.concatenate([_cylindrical(s, length), _columns(s.cosine(0, 1))], axis=1)


def _distance(s: Sides, length: Float[Array, " k"]) -> Float[Array, "k 1"]:
    """`(|d|^2 / L - L) / 2`: the elongation, with a gradient of length one."""
    return _columns((dot(s.gap, s.gap) / length - length) / 2)


def _planar_revolute(s: Sides, length: Any) -> Float[Array, "k 2"]:
    return s.gap[:, :2]


def _planar_prismatic(s: Sides, length: Any) -> Float[Array, "k 2"]:
    normal = jnp.asarray([[0, 0, 1]], s.gap.dtype)
    across = jnp.cross(normal, s.frame_first[:, :, 2])
    return _columns(dot(across, s.gap), dot(across, s.frame_second[:, :, 2]))


def _planar_fixed(s: Sides, length: Any) -> Float[Array, "k 3"]:
    return jnp.concatenate([s.gap[:, :2], _columns(s.cosine(0, 1))], axis=1)


SPATIAL: dict[type, Callable] = {
    joints.Spherical: _spherical,
    joints.Revolute: _revolute,
    joints.Universal: _universal,
    joints.Cylindrical: _cylindrical,
    joints.Prismatic: _prismatic,
    joints.Fixed: _fixed,
    joints.Distance: _distance,
}
PLANAR: dict[type, Callable] = {
    joints.Revolute: _planar_revolute,
    joints.Prismatic: _planar_prismatic,
    joints.Fixed: _planar_fixed,
    joints.Distance: _distance,
}
WITH_AXIS = {
    False: (joints.Revolute, joints.Universal, joints.Cylindrical, joints.Prismatic),
    True: (joints.Prismatic,),
}


class Attachment(eqx.Module):
    """Which bodies `k` joints or forces belong to (static: the graph of the mechanism), and their
    points and frames in those, of first and of second bodies."""

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
        """With the frames of the bodies to which they belong, `(2, k, ...)`."""
        at = placed.origin + turn(placed.rotation, self.points)
        axes = compose(placed.rotation, self.axes)
        return Sides(at[0], at[1], axes[0], axes[1])

    def velocities(self, frames: Frames, sides: Sides) -> Float[Array, "k 3"]:
        """Of the second points against the first."""
        arms = jnp.stack([sides.first, sides.second]) - frames.origin[self.index]
        moving = frames.velocity[self.index] + jnp.cross(frames.spin[self.index], arms)
        return moving[1] - moving[0]


def attach(bodies: Bodies, things: list[Any], names: list[str], axes: list[Any]) -> Attachment:
    """Points and frames of the drawing in the frames of the bodies."""
    first, second = zip(
        *[_indices(bodies, t, name) for t, name in zip(things, names, strict=True)], strict=True
    )
    frames = Frames.of(bodies.drawing, bodies.drawing)
    pairs = [ends(bodies, t, i, name) for t, i, name in zip(things, first, names, strict=True)]
    is_drawn = jnp.asarray(np.array([pair[0] for pair in pairs])[:, None])
    points, local = [], []
    for side, index in ((0, np.asarray(first)), (1, np.asarray(second))):
        given = in_space(stack([pair[1 + side] for pair in pairs]))
        rotation = frames.rotation[index]
        in_body = turn_back(rotation, given - frames.origin[index])
        points.append(jnp.where(is_drawn, in_body, given))
        drawn = basis(stack([floating(pair[side]) for pair in axes]))
        local.append(compose(jnp.swapaxes(rotation, 1, 2), drawn))
    return Attachment(tuple(names), (first, second), jnp.stack(points), jnp.stack(local))


def ends(bodies: Bodies, thing: Any, first: int, name: str) -> tuple[bool, Any, Any]:
    if isinstance(thing, joints.Fixed) and thing.at is None and thing.points is None:
        if first == len(bodies.names):
            first = bodies.index(thing.second, name)
        at = bodies.drawing.position[first]
        return True, at, at
    return joints.ends(thing, name, bodies.planar)


def _indices(bodies: Bodies, thing: Any, name: str) -> tuple[int, int]:
    if thing.first == thing.second:
        raise ValueError(
            f"{name} connects {thing.first!r} with itself. Give two bodies, or `mj.multibody.GROUND`."
        )
    return bodies.index(thing.first, name), bodies.index(thing.second, name)


class JointGroup(eqx.Module):
    """All joints of one kind."""

    kind: type = eqx.field(static=True)
    planar: bool = eqx.field(static=True)
    attachment: Attachment
    length: Float[Array, " k"]

    @staticmethod
    def of(kind: type, bodies: Bodies, things: list[Any], names: list[str]) -> "JointGroup":
        planar = bodies.planar
        if kind not in (PLANAR if planar else SPATIAL):
            known = ", ".join(k.__name__ for k in PLANAR)
            raise ValueError(f"{names[0]}: joints in the plane are {known}.")
        needed = kind in WITH_AXIS[planar]
        axes = [joints.drawn_axes(t, n, planar, needed) for t, n in zip(things, names, strict=True)]
        attachment = attach(bodies, things, names, axes)
        drawn = attachment.sides(Frames.of(bodies.drawing, bodies.drawing)).gap
        if kind is not joints.Distance:
            return JointGroup(kind, planar, attachment, jnp.ones(len(things), drawn.dtype))
        own = jnp.sqrt(dot(drawn, drawn))
        given = [own[i] if t.length is None else floating(t.length) for i, t in enumerate(things)]
        for name, length in zip(names, given, strict=True):
            if length.shape != () or (is_concrete(length) and not float(length) > 0):
                raise ValueError(
                    f"{name}: `length` must be a positive number, got {length}. Two points that stay together are a "
                    "`Spherical` joint, or a `Revolute` one in the plane."
                )
        return JointGroup(kind, planar, attachment, stack(given))

    def residual(self, placed: Placed) -> Float[Array, "k r"]:
        """`placed` are the bodies of the joints, `(2, k, ...)`."""
        return self.equations(self.attachment.sides_of(placed), self.length)

    @property
    def equations(self) -> Callable:
        return (PLANAR if self.planar else SPATIAL)[self.kind]


def residuals(groups: tuple[JointGroup, ...], q: Pose) -> tuple[Float[Array, "k r"], ...]:
    """Of all joints, kind by kind."""
    return _residuals(groups, with_ground(q)[_index(groups)], q.planar)


def jacobian(groups: tuple[JointGroup, ...], q: Pose) -> Float[Array, "r n c"]:
    """Derivatives of all equations of joints with respect to the coordinates of the bodies, of which
    each joint depends on two: one derivative for each coordinate of these, all joints at once."""
    index, rows = _index(groups), with_ground(q)
    number, size = rows.shape
    here = rows[index]
    along = lambda seed: jax.jvp(
        lambda here: _residuals(groups, here, q.planar),
        (here,),
        (jnp.broadcast_to(seed[:, None, :], here.shape),),
    )[1]
    seeds = jnp.eye(2 * size, dtype=here.dtype).reshape(2 * size, 2, size)
    slopes = jax.vmap(along)(seeds)
    entries = [jnp.moveaxis(slope.reshape(2, size, -1), 1, 2) for slope in slopes]
    counts = [slope.shape[2] for slope in slopes]
    per_joint = np.repeat(counts, [len(group.attachment.names) for group in groups])
    bodies = np.repeat(index, per_joint, axis=1)
    equations = np.arange(bodies.shape[1])[None, :]
    whole = jnp.zeros((bodies.shape[1], number, size), here.dtype)
    whole = whole.at[equations, bodies].set(jnp.concatenate(entries, axis=1), unique_indices=True)
    return whole[:, :-1]


def _residuals(groups: tuple[JointGroup, ...], here: Float[Array, "2 k c"], planar: bool) -> Any:
    """From the coordinates of the bodies of all joints."""
    d = 2 if planar else 3
    placed = Placed.of(Pose(here[..., :d], here[..., 2] if planar else here[..., 3:]))
    found, start = [], 0
    for group in groups:
        own = slice(start, start := start + len(group.attachment.names))
        found.append(group.residual(Placed(placed.origin[:, own], placed.rotation[:, own])))
    return tuple(found)


def _index(groups: tuple[JointGroup, ...]) -> np.ndarray:
    """First and second bodies of all joints, `(2, K)`."""
    none = np.zeros((2, 0), int)
    return np.concatenate([none, *(group.attachment.index for group in groups)], axis=1)


def group_joints(bodies: Bodies, given: Any) -> tuple[JointGroup, ...]:
    """The joints by their kinds, in the order in which these come first."""
    kinds: dict[type, tuple[list, list]] = {}
    names = name_all(given, joints.AbstractJoint, "joint")
    for joint, name in zip(given, names, strict=True):
        of_kind = kinds.setdefault(type(joint), ([], []))
        of_kind[0].append(joint)
        of_kind[1].append(name)
    return tuple(JointGroup.of(kind, bodies, *of_kind) for kind, of_kind in kinds.items())


def name_all(given: Any, base: type, what: str) -> tuple[str, ...]:
    """Names of all joints or forces, those that have none made of kind and bodies."""
    names, count = [], {}
    for thing in given:
        if not isinstance(thing, base):
            raise TypeError(
                f"`{what}s` must be a sequence of {what}s of `mj.multibody`, one is {thing!r}."
            )
        name = getattr(thing, "name", None)
        if name is None:
            own = [getattr(thing, part, None) for part in ("first", "second", "body", "joint")]
            name = " ".join([type(thing).__name__, "-".join(str(part) for part in own if part)])
            count[name] = count.get(name, 0) + 1
            name = name if count[name] == 1 else f"{name} ({count[name]})"
        names.append(name)
    return unique_names(what, names)


def reactions(
    group: JointGroup, frames: Frames, multipliers: Float[Array, "k r"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Forces and torques on the second bodies at the second points: `-lambda` times the change of
    the equations when that body is moved or turned."""
    sides = group.attachment.sides(frames)

    def moved(shift: Float[Array, "k 3"], angle: Float[Array, "k 3"]) -> Float[Array, "k r"]:
        """About the second point, to first order."""
        axes = sides.frame_second
        turned = axes + jnp.cross(angle[:, :, None], axes, axis=1)
        return group.equations(
            sides._replace(second=sides.second + shift, frame_second=turned), group.length
        )

    still = jnp.zeros_like(sides.second)
    _, pull = jax.vjp(moved, still, still)
    return pull(-multipliers)
