"""Small matrices, many at once: products, and factors to divide by one."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


# Rows up to which products are written out, as in `_linear`.
_WRITTEN_OUT = 4


class Pivot(NamedTuple):
    """`A^-1 = right left`, the inverses of the triangular factors of `A = L U`.

    Not their product: an elimination that divides by `A^-1` loses twice the digits that the
    condition of the blocks explains, one that uses triangular factors none of them (Demmel, Higham
    & Schreiber, Numer. Linear Algebra Appl. 2 (1995) 173-190). Without pivoting; not finite, or
    without meaning, for singular matrices.
    """

    left: Float[Array, "*b w w"]  # L^-1, with a unit diagonal
    right: Float[Array, "*b w w"]  # U^-1

    @staticmethod
    def of(A: Float[Array, "*b w w"]) -> "Pivot":
        """By halves, `A = [[A, B], [C, D]]`: most of it are products."""
        half = A.shape[-1] // 2
        if half == 0:
            return Pivot(jnp.ones_like(A), 1 / A)
        first = Pivot.of(A[..., :half, :half])
        lower = times(A[..., half:, :half], first.right)
        upper = times(first.left, A[..., :half, half:])
        second = Pivot.of(A[..., half:, half:] - times(lower, upper))
        below = -times(second.left, times(lower, first.left))
        beside = -times(first.right, times(upper, second.right))
        none = jnp.zeros_like(beside)
        return Pivot(
            _joined(first.left, none, below, second.left),
            _joined(first.right, beside, jnp.swapaxes(none, -1, -2), second.right),
        )


def times(A: Float[Array, "*b i j"], B: Float[Array, "*b j k"]) -> Float[Array, "*b i k"]:
    """`A B`."""
    if A.shape[-1] > _WRITTEN_OUT:
        return A @ B
    return sum(A[..., :, j, None] * B[..., None, j, :] for j in range(A.shape[-1]))  # pyright: ignore[reportReturnType]


def apply(A: Float[Array, "*b w w"], x: Float[Array, "*c w"]) -> Float[Array, "*b w"]:
    """`A x`."""
    width = A.shape[-1]
    if width > _WRITTEN_OUT:
        return jnp.einsum("...ij,...j->...i", A, x)
    return sum(A[..., :, k] * x[..., None, k] for k in range(width))  # pyright: ignore[reportReturnType]


def _joined(A: Array, B: Array, C: Array, D: Array) -> Array:
    rows = jnp.concatenate([A, B], axis=-1), jnp.concatenate([C, D], axis=-1)
    return jnp.concatenate(rows, axis=-2)
