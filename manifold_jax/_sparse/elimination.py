r"""Block tridiagonal systems `L_b x_{b-1} + D_b x_b + U_b x_{b+1} = r_b` in linear time.

Blocks are grouped into chunks of neighbours, which are eliminated all at once but for the last block
of each; those are coupled by a smaller system of the same form (Wang, ACM Trans. Math. Softw. 7
(1981) 170-183). One loop over all blocks would take as many iterations as there are blocks, of which
each costs more than its arithmetic. Without pivoting: the matrices met here are close to symmetric
positive definite, for which any order is stable.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Blocks in a chunk, and up to which number of blocks there is one loop over all of them.
_CHUNK = 32
_ONE_LOOP = 64

# Rows up to which products and inverses are written out, as in `_linear`.
_WRITTEN_OUT = 4


class Blocks(NamedTuple):
    """Of a block tridiagonal matrix, `lower[b]` beside `diagonal[b]` to the left of it, `upper[b]` to
    the right. The first lower and the last upper one are zero."""

    lower: Float[Array, "b w w"]
    diagonal: Float[Array, "b w w"]
    upper: Float[Array, "b w w"]

    def transposed(self) -> "Blocks":
        flip = lambda A: jnp.swapaxes(A, -1, -2)
        return Blocks(flip(_before(self.upper)), flip(self.diagonal), flip(_after(self.lower)))


def eliminate(blocks: Blocks) -> "Tridiagonal | InOneLoop | InChunks":
    """The blocks factored, to be solved with right-hand sides of shape `(b, w)`."""
    number, width, _ = blocks.diagonal.shape
    if width == 1:
        return Tridiagonal(blocks)
    return InOneLoop.of(blocks) if number <= _ONE_LOOP else InChunks.of(blocks)


class Tridiagonal(eqx.Module):
    """By the library (LAPACK, cuSPARSE), with row exchanges."""

    blocks: Blocks

    def solve(self, r: Float[Array, "b 1"]) -> Float[Array, "b 1"]:
        lower, diagonal, upper = (A[:, 0, 0] for A in self.blocks)
        return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, r)


class InOneLoop(eqx.Module):
    """One block after the other."""

    multiplier: Float[Array, "b w w"]  # L_b D'_{b-1}^-1
    inverse: Float[Array, "b w w"]  # D'_b^-1
    upper: Float[Array, "b w w"]

    @staticmethod
    def of(blocks: Blocks) -> "InOneLoop":
        def step(before, block):
            (inverse, upper), (L, D, U) = before, block
            multiplier = _times(L, inverse)
            inverse = _inverse(D - _times(multiplier, upper))
            return (inverse, U), (multiplier, inverse)

        nothing = jnp.zeros_like(blocks.diagonal[0])
        _, (multiplier, inverse) = jax.lax.scan(step, (nothing, nothing), tuple(blocks))
        return InOneLoop(multiplier, inverse, blocks.upper)

    def solve(self, r: Float[Array, "b w"]) -> Float[Array, "b w"]:
        reduced = _forwards(self.multiplier, r, jnp.zeros_like(r[0]))
        upper = _times(self.inverse, self.upper)
        return _backwards(upper, _apply(self.inverse, reduced), jnp.zeros_like(r[0]))


class InChunks(eqx.Module):
    """`c` chunks of `1 + k` blocks. The `k` inner ones are `x = g - left s_{c-1} - right s_c` with the
    last ones, `s`, of their own chunk and of the one before, and `g` linear in `r`."""

    multiplier: Float[Array, "k c w w"]
    inverse: Float[Array, "k c w w"]
    upper: Float[Array, "k c w w"]  # times the inverse
    left: Float[Array, "k c w w"]
    right: Float[Array, "k c w w"]
    last_upper: Float[Array, "c w w"]
    last: "InOneLoop | InChunks"

    @staticmethod
    def of(blocks: Blocks) -> "InChunks":
        _, width, _ = blocks.diagonal.shape
        eye = jnp.eye(width, dtype=blocks.diagonal.dtype)
        L, D, U = (
            _chunks(A, fill) for A, fill in zip(blocks, (0 * eye, eye, 0 * eye), strict=True)
        )

        def inwards(before, block):
            """Forwards; `fill` is what couples a block to the last one of the chunk before."""
            (inverse, upper, fill), (L, D, U) = before, block
            multiplier = _times(L, inverse)
            inverse = _inverse(D - _times(multiplier, upper))
            fill = -_times(multiplier, fill)
            return (inverse, U, fill), (multiplier, inverse, fill)

        first = _inverse(D[0])
        (inverse, upper, fill), inner = jax.lax.scan(
            inwards, (first, U[0], L[0]), (L[1:-1], D[1:-1], U[1:-1])
        )
        multiplier = _times(L[-1], inverse)
        last_diagonal = D[-1] - _times(multiplier, upper)
        last_lower = -_times(multiplier, fill)
        multipliers = jnp.concatenate([inner[0], multiplier[None]])
        inverses = jnp.concatenate([first[None], inner[1]])
        fills = jnp.concatenate([L[0][None], inner[2]])
        uppers = _times(inverses, U[:-1])

        def outwards(after, block):
            (left, right), (upper, fill) = after, block
            both = fill - _times(upper, left), -_times(upper, right)
            return both, both

        minus = jnp.broadcast_to(-eye, last_diagonal.shape)
        _, (left, right) = jax.lax.scan(
            outwards, (0 * minus, minus), (uppers, _times(inverses, fills)), reverse=True
        )
        last = Blocks(
            last_lower,
            last_diagonal - _times(U[-1], _after(left[0])),
            -_times(U[-1], _after(right[0])),
        )
        last = InOneLoop.of(last) if last_diagonal.shape[0] <= _ONE_LOOP else InChunks.of(last)
        return InChunks(multipliers, inverses, uppers, left, right, U[-1], last)

    def solve(self, r: Float[Array, "b w"]) -> Float[Array, "b w"]:
        number, width = r.shape
        chunks = _chunks(r, jnp.zeros_like(r[0]))
        reduced = _forwards(self.multiplier, chunks[1:], chunks[0])
        end = reduced[-1]
        inner = jnp.concatenate([chunks[:1], reduced[:-1]])
        g = _backwards(self.upper, _apply(self.inverse, inner), jnp.zeros_like(end))
        s = self.last.solve(end - _apply(self.last_upper, _after(g[0])))
        x = g - _apply(self.left, _before(s)[None]) - _apply(self.right, s[None])
        x = jnp.concatenate([x, s[None]])
        return jnp.swapaxes(x, 0, 1).reshape(-1, width)[:number]


def _chunks(A: Float[Array, "b ..."], fill: Float[Array, "..."]) -> Float[Array, "k c ..."]:
    """Position in the chunk first; the chunks next to each other."""
    number = A.shape[0]
    count = -(-number // _CHUNK)
    missing = jnp.broadcast_to(fill, (count * _CHUNK - number, *A.shape[1:]))
    A = jnp.concatenate([A, missing]).reshape(count, _CHUNK, *A.shape[1:])
    return jnp.swapaxes(A, 0, 1)


def _forwards(multiplier, r, start):
    def step(before, block):
        multiplier, r = block
        r = r - _apply(multiplier, before)
        return r, r

    return jax.lax.scan(step, start, (multiplier, r))[1]


def _backwards(upper, r, start):
    def step(after, block):
        upper, r = block
        x = r - _apply(upper, after)
        return x, x

    return jax.lax.scan(step, start, (upper, r), reverse=True)[1]


def _after(A: Array) -> Array:
    return jnp.concatenate([A[1:], jnp.zeros_like(A[:1])])


def _before(A: Array) -> Array:
    return jnp.concatenate([jnp.zeros_like(A[:1]), A[:-1]])


def _times(A: Float[Array, "*b w w"], B: Float[Array, "*b w w"]) -> Float[Array, "*b w w"]:
    width = A.shape[-1]
    if width > _WRITTEN_OUT:
        return A @ B
    return sum(A[..., :, k, None] * B[..., None, k, :] for k in range(width))  # pyright: ignore[reportReturnType]


def _apply(A: Float[Array, "*b w w"], x: Float[Array, "*c w"]) -> Float[Array, "*b w"]:
    width = A.shape[-1]
    if width > _WRITTEN_OUT:
        return jnp.einsum("...ij,...j->...i", A, x)
    return sum(A[..., :, k] * x[..., None, k] for k in range(width))  # pyright: ignore[reportReturnType]


def _inverse(A: Float[Array, "*b w w"]) -> Float[Array, "*b w w"]:
    """Gauss-Jordan elimination; not finite, or without meaning, for singular matrices."""
    width = A.shape[-1]

    def column(k, A):
        here = jnp.broadcast_to(jnp.arange(width) == k, A.shape[:-1])
        row = jnp.where(here, 1, A[..., k, :]) / A[..., k, k, None]
        others = jnp.where(here[..., None, :], 0, A) - A[..., :, k, None] * row[..., None, :]
        return jnp.where(here[..., :, None], row[..., None, :], others)

    return jax.lax.fori_loop(0, width, column, A, unroll=width <= _WRITTEN_OUT)
