"""Rotations as matrices and as unit quaternions; their algebra is that of vectors."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .algebra import cross, hat, is_within_half_a_turn, Rotation, rotation_rate, vee
from .group import AbstractLieGroup, check_shape


class SO3(AbstractLieGroup):
    r"""Rotation matrices, shape `(3, 3)`, $R' = R\,\hat\omega$ with the angular velocity $\omega$ in
    the frame of the body. The constraint is [`Stiefel`][]."""

    dimension: ClassVar[int] = 3

    def tangent(self, y, velocity):
        check_shape(y, (3, 3), "SO3")
        return _product(y, hat(velocity))

    def velocity(self, y, tangent):
        check_shape(y, (3, 3), "SO3")
        return vee(_product(y.T, tangent))

    def moved(self, y, w, cayley):
        return _product(y, Rotation.of(w, cayley).matrix())

    def rate(self, w, velocity, cayley):
        return rotation_rate(w, velocity, cayley)

    def is_within(self, w, cayley):
        return is_within_half_a_turn(w, cayley)


class UnitQuaternion(AbstractLieGroup):
    r"""Unit quaternions, scalar first, shape `(4,)`, $2 q' = q\,\omega$ with the angular velocity
    $\omega$ in the frame of the body. The constraint is [`Sphere`][]."""

    dimension: ClassVar[int] = 3

    def tangent(self, y, velocity):
        check_shape(y, (4,), "UnitQuaternion")
        return quaternion_product(y, _pure(velocity / 2))

    def velocity(self, y, tangent):
        check_shape(y, (4,), "UnitQuaternion")
        conjugate = y * jnp.array([1, -1, -1, -1], y.dtype)
        return 2 * quaternion_product(conjugate, tangent)[1:]

    def moved(self, y, w, cayley):
        return quaternion_product(y, Rotation.of(w, cayley).quaternion())

    def rate(self, w, velocity, cayley):
        return rotation_rate(w, velocity, cayley)

    def is_within(self, w, cayley):
        return is_within_half_a_turn(w, cayley)


def quaternion_product(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    vector = p[0] * q[1:] + q[0] * p[1:] + cross(p[1:], q[1:])
    return jnp.concatenate([(p[0] * q[0] - jnp.sum(p[1:] * q[1:]))[None], vector])


def _pure(v: Float[Array, "3"]) -> Float[Array, "4"]:
    return jnp.concatenate([jnp.zeros_like(v[:1]), v])


def _product(A: Float[Array, "i j"], B: Float[Array, "j k"]) -> Float[Array, "i k"]:
    """Multiply matrices as a sum, which fuses with the surrounding operations."""
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)
