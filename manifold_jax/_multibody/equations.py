"""Equations of all joints of one kind, in one array computation.

A joint has a point and an orthonormal frame in each of its two bodies, `d` from the first point to
the second, `(u, v, w)` and `(u', v', w')` the axes. Lengths are in metres, products of axes have no
unit. Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 9.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import joints
from .attachment import Sides
from .rotations import dot, turn_back


def _columns(*parts: Float[Array, " k"]) -> Float[Array, "k r"]:
    return jnp.stack(parts, axis=1)


def _tilted(s: Sides) -> Float[Array, "k 2"]:
    """Return the components of `w'` along `u` and `v`."""
    return turn_back(s.frame_first[:, :, :2], jnp.unstack(s.frame_second, axis=2)[2])


def _twisted(s: Sides) -> Float[Array, "k 1"]:
    return s.cosine(0, 1)[:, None]


def _beside(*parts: Float[Array, "k _"]) -> Float[Array, "k more"]:
    return jnp.concatenate(parts, axis=1)


def _gap(s: Sides) -> Float[Array, "k 3"]:
    """Return the components of `d` along the axes of the first body. Those in the world would not do: where the
    equation across the plane of a linkage follows from the others, it would be another one whenever the plane
    turns."""
    return turn_back(s.frame_first, s.gap)


def _cylindrical(s: Sides, length: Any) -> Float[Array, "k 4"]:
    return _beside(turn_back(s.frame_first[:, :, :2], s.gap), _tilted(s))


def _distance(s: Sides, length: Float[Array, " k"]) -> Float[Array, "k 1"]:
    """Return `(|d|^2 / L - L) / 2`: the elongation, with a gradient of length one."""
    return _columns((dot(s.gap, s.gap) / length - length) / 2)


def _planar_prismatic(s: Sides, length: Any) -> Float[Array, "k 2"]:
    normal = jnp.asarray([[0, 0, 1]], s.gap.dtype)
    across = jnp.cross(normal, s.frame_first[:, :, 2])
    return _columns(dot(across, s.gap), dot(across, s.frame_second[:, :, 2]))


def _driven_angle(s: Sides, target: Float[Array, " k"]) -> Float[Array, "k 1"]:
    """Return the angle by which the second body is ahead, from `-pi` to `pi`."""
    sine, cosine = s.cosine(1, 0), s.cosine(0, 0)
    ahead = sine * jnp.cos(target) - cosine * jnp.sin(target)
    return _columns(jnp.arctan2(ahead, cosine * jnp.cos(target) + sine * jnp.sin(target)))


SPATIAL: dict[type, Callable] = {
    joints.Spherical: lambda s, length: _gap(s),
    joints.Revolute: lambda s, length: _beside(_gap(s), _tilted(s)),
    joints.Universal: lambda s, length: _beside(_gap(s), s.cosine(2, 2)[:, None]),
    joints.Cylindrical: _cylindrical,
    joints.Prismatic: lambda s, length: _beside(_cylindrical(s, length), _twisted(s)),
    joints.Fixed: lambda s, length: _beside(_gap(s), _tilted(s), _twisted(s)),
    joints.Distance: _distance,
}
PLANAR: dict[type, Callable] = {
    joints.Revolute: lambda s, length: s.gap[:, :2],
    joints.Prismatic: _planar_prismatic,
    joints.Fixed: lambda s, length: _beside(s.gap[:, :2], _twisted(s)),
    joints.Distance: _distance,
}
DRIVEN: dict[type, Callable] = {
    joints.Revolute: _driven_angle,
    joints.Prismatic: lambda s, target: _columns(s.along(2) - target),
}
