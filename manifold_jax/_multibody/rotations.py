"""Unit quaternions, scalar first, and the rotation of vectors; all for many bodies at once.

Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 9.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar
from .checks import check_axis, check_shape


def quaternion(axis: Any, angle: Any) -> Float[Array, "4"]:
    """Return the unit quaternion `(cos(angle/2), sin(angle/2) axis / |axis|)` of a turn about an axis.

    **Arguments:**

    - `axis`: shape `(3,)`, not zero. `angle`: in radian, counter-clockwise seen from its tip.
    """
    return _about(check_axis("`axis`", axis), check_shape("`angle`", angle, ()))


@jax.jit
def _about(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    unit = axis / jnp.sqrt(jnp.sum(axis * axis))
    return jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * unit])


def rotation_matrix(p: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Return `R(p)`, which turns vectors of the body to world coordinates; quadratic in `p`.

    One product of all `p_k p_l` with a constant matrix: written out, the entries were a third of the operations
    that a mechanism's program is traced and compiled from.
    """
    batch = p.shape[:-1]
    products = (p[..., :, None] * p[..., None, :]).reshape(*batch, 16)
    entries = jnp.matmul(products, jnp.asarray(_OF_PRODUCTS, p.dtype), precision="highest")
    return entries.reshape(*batch, 3, 3)


def rates_matrix(p: Float[Array, "*n 4"]) -> Float[Array, "*n 3 4"]:
    """Return `G(p)`: the angular velocity in the body is `2 G(p) p'`, and `p' = G(p)^T omega / 2`.

    Its rows are `p` with its halves, its pairs, or both exchanged, times signs.
    """
    backwards = p[..., ::-1]
    rows = [_halves_exchanged(backwards), _halves_exchanged(p), backwards]
    signs = _SIGNS.astype(p.dtype).reshape(*(1,) * (p.ndim - 1), 3, 4)
    return jnp.stack(rows, axis=-2) * signs


def _halves_exchanged(p: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    return jnp.concatenate([p[..., 2:], p[..., :2]], axis=-1)


_SIGNS = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])


def _of_products() -> np.ndarray:
    """Return the matrix that makes the entries of `R(p)` from all `p_k p_l`, shape `(16, 9)`: each entry is
    `p^T A p` with a symmetric `A`."""

    def rotation(p: np.ndarray) -> np.ndarray:
        a, b, c, d = p
        rows = [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
        ]
        return np.array(rows)

    units = np.eye(4)
    found = [rotation(p + r) - rotation(p) - rotation(r) for p in units for r in units]
    return np.array(found).reshape(16, 9) / 2


_OF_PRODUCTS = _of_products()


@jax.jit
def quaternion_rate(p: Float[Array, "*n 4"], spin: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Return `p' = G(p)^T R(p)^T omega / 2` for angular velocities in world coordinates."""
    return turn_back(rates_matrix(p), turn_back(rotation_matrix(p), spin)) / 2


def about(axis: Float[Array, "*n 3"], angle: Float[Array, "*n"]) -> Float[Array, "*n 3 3"]:
    """Return the turns about unit vectors, `1 + sin(angle) K + (1 - cos(angle)) K^2` with `K x = axis cross x`."""
    along = axis[..., :, None] * axis[..., None, :]
    x, y, z, zero = axis[..., 0], axis[..., 1], axis[..., 2], jnp.zeros_like(angle)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    across = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=axis.dtype), along.shape)
    c, s = jnp.cos(angle)[..., None, None], jnp.sin(angle)[..., None, None]
    return c * identity + s * across + (1 - c) * along


def multiply_quaternions(p: Float[Array, "*n 4"], r: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Return the quaternions of the turns `R(p) R(r)`."""
    a, b, c, d = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    rows = [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]
    return turn(jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2), r)


def conjugate(p: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Return the quaternions of the turns back."""
    return jnp.concatenate([p[..., :1], -p[..., 1:]], axis=-1)


def quaternion_about(axis: Float[Array, "*n 3"], angle: Float[Array, "*n"]) -> Float[Array, "*n 4"]:
    """Return the quaternions of turns about unit vectors."""
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], axis=-1)


def planar_rotation(angle: Float[Array, "*n"]) -> Float[Array, "*n 3 3"]:
    """Return the turn by an angle about the third axis."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def turn(R: Float[Array, "*n i j"], s: Float[Array, "*n j"]) -> Float[Array, "*n i"]:
    """Return `R_k s_k`; small products as sums, which fuse."""
    return jnp.sum(R * s[..., None, :], axis=-1)


def turn_back(R: Float[Array, "*n i j"], s: Float[Array, "*n i"]) -> Float[Array, "*n j"]:
    """Return `R_k^T s_k`."""
    return jnp.sum(R * s[..., :, None], axis=-2)


def compose(R: Float[Array, "*n i j"], S: Float[Array, "*n j k"]) -> Float[Array, "*n i k"]:
    """Return `R_k S_k`."""
    return jnp.sum(R[..., :, :, None] * S[..., None, :, :], axis=-2)


def inverted(A: Float[Array, "n 3 3"]) -> tuple[Float[Array, "n 3 3"], BoolScalar]:
    """Return the inverses of symmetric matrices (cofactors), and whether all are positive definite."""
    after, before = jnp.roll(A, -1, axis=(1, 2)), jnp.roll(A, 1, axis=(1, 2))
    crossed = jnp.roll(A, (-1, 1), axis=(1, 2)) * jnp.roll(A, (1, -1), axis=(1, 2))
    cofactors = after * before - crossed
    determinant = jnp.sum(A[:, 0] * cofactors[:, 0], axis=1)
    # the leading minors relative to the size of their terms
    tiny = 100 * jnp.finfo(A.dtype).eps
    diagonal = jnp.sum(A * jnp.eye(3, dtype=A.dtype)[None], axis=2)
    second = cofactors[:, 2, 2] > tiny * diagonal[:, 0] * diagonal[:, 1]
    positive = jnp.all(diagonal > 0, axis=1) & second
    positive &= determinant > tiny * jnp.prod(diagonal, axis=1)
    safe = jnp.where(positive, determinant, 1)
    return cofactors / safe[:, None, None], jnp.all(positive)


def dot(a: Float[Array, "*n i"], b: Float[Array, "*n i"]) -> Float[Array, "*n"]:
    return jnp.sum(a * b, axis=-1)


def length_of(a: Float[Array, "*n i"]) -> Float[Array, "*n"]:
    """Return `|a|`, with derivative zero where it is zero."""
    square = dot(a, a)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def basis(axis: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Return right-handed orthonormal frames whose third column has the direction of `axis`."""
    w = axis / jnp.sqrt(dot(axis, axis))[..., None]
    least = jnp.argmin(jnp.abs(w), axis=-1)
    helper = jnp.eye(3, dtype=w.dtype)[least]
    u = jnp.cross(helper, w)
    u = u / jnp.sqrt(dot(u, u))[..., None]
    return jnp.stack([u, jnp.cross(w, u), w], axis=-1)
