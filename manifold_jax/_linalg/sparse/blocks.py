"""Batches of small matrices: products and factors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Largest number of rows for which products are written out.
_WRITTEN_OUT = 4


class Pivot(NamedTuple):
    """`A^-1 = right left`, the inverses of the triangular factors of `A = L U`.

    Their product is not formed: an elimination that multiplies by `A^-1` loses twice the digits that
    the condition of the blocks explains, one with triangular factors none of them (Demmel, Higham &
    Schreiber, Numer. Linear Algebra Appl. 2 (1995) 173-190). Without pivoting; not finite, or without
    meaning, for singular matrices.
    """

    left: Float[Array, "*b w w"]  # L^-1, with a unit diagonal
    right: Float[Array, "*b w w"]  # U^-1

    @staticmethod
    def of(A: Float[Array, "*b w w"]) -> "Pivot":
        """Invert a block in place, by Gauss-Jordan elimination without the steps that form the product."""
        width = A.shape[-1]
        if width == 0:
            return Pivot(A, A)
        if width <= _WRITTEN_OUT:
            return _entry_by_entry(A)
        numbers = jnp.arange(width)

        def eliminate(k, P):
            row, column, pivot = P[..., k, :], P[..., :, k], P[..., k, k, None]
            here, done = numbers == k, numbers < k
            upper = row / pivot
            P = P - jnp.where(
                done[:, None] & done[None, :], 0, column[..., :, None] * upper[..., None, :]
            )
            column = jnp.where(numbers > k, -column / pivot, column)
            P = jnp.where(here[None, :], column[..., :, None], P)
            row = jnp.where(numbers > k, -upper, row)
            return jnp.where(here[:, None], row[..., None, :], P)

        P = jax.lax.fori_loop(0, width, eliminate, A)
        diagonal = jnp.diagonal(P, axis1=-2, axis2=-1)[..., None, :]
        eye = jnp.eye(width, dtype=A.dtype)
        return Pivot(jnp.tril(P, -1) + eye, (jnp.triu(P, 1) + eye) / diagonal)


def _entry_by_entry(A: Float[Array, "*b w w"]) -> Pivot:
    """Do the same entry by entry, so that it fuses: half the time of masked operations."""
    numbers = range(A.shape[-1])
    one, zero = jnp.ones_like(A[..., 0, 0]), jnp.zeros_like(A[..., 0, 0])
    P = [[A[..., i, j] for j in numbers] for i in numbers]
    for k in numbers:
        inverse = 1 / P[k][k]
        upper = [P[k][j] * inverse for j in numbers]
        for i in numbers:
            for j in numbers:
                if (i > k and j != k) or (i < k and j > k):
                    P[i][j] = P[i][j] - P[i][k] * upper[j]
        for i in numbers[k + 1 :]:
            P[i][k], P[k][i] = -P[i][k] * inverse, -upper[i]
        P[k][k] = inverse
    left = [[P[i][j] if i > j else one if i == j else zero for j in numbers] for i in numbers]
    right = [[P[i][j] * P[j][j] if i < j else P[i][i] for j in numbers] for i in numbers]
    right = [[right[i][j] if i <= j else zero for j in numbers] for i in numbers]
    stacked = lambda rows: jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return Pivot(stacked(left), stacked(right))


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
