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
from .rotations import dot


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


def _driven_angle(s: Sides, target: Float[Array, " k"]) -> Float[Array, "k 1"]:
    """Return by how much the second body is ahead, from `-pi` to `pi`."""
    sine, cosine = s.cosine(1, 0), s.cosine(0, 0)
    ahead = sine * jnp.cos(target) - cosine * jnp.sin(target)
    return _columns(jnp.arctan2(ahead, cosine * jnp.cos(target) + sine * jnp.sin(target)))


def _driven_distance(s: Sides, target: Float[Array, " k"]) -> Float[Array, "k 1"]:
    return _columns(s.along(2) - target)


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
DRIVEN: dict[type, Callable] = {
    joints.Revolute: _driven_angle,
    joints.Prismatic: _driven_distance,
}
