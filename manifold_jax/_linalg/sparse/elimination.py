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

from .blocks import apply, Pivot, times


# Blocks in a chunk, and up to which number of blocks there is one loop over all of them.
_CHUNK = 32
_ONE_LOOP = 64


class Blocks(NamedTuple):
    """The blocks of a block tridiagonal matrix, `lower[b]` beside `diagonal[b]` to the left of it,
    `upper[b]` to the right. The first lower and the last upper one are zero."""

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
    """Elimination by the library (LAPACK, cuSPARSE), with row exchanges."""

    blocks: Blocks

    def solve(self, r: Float[Array, "b 1"]) -> Float[Array, "b 1"]:
        lower, diagonal, upper = (A[:, 0, 0] for A in self.blocks)
        return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, r)


class InOneLoop(eqx.Module):
    """One block after the other, `x_b = R_b (y_b - W_b x_{b+1})`, `y_b = S_b (r_b - M_b y_{b-1})` with
    `R_b S_b` the inverse of what is left of `D_b`. Held as `S M` and `R W`, one product for each."""

    pivots: Pivot
    lower: Float[Array, "b w w"]
    upper: Float[Array, "b w w"]

    @staticmethod
    def of(blocks: Blocks) -> "InOneLoop":
        def step(before, block):
            pivot, multiplier, upper = _next_pivot(*before, *block)
            return (pivot.right, upper), (pivot, multiplier, upper)

        nothing = jnp.zeros_like(blocks.diagonal[0])
        _, (pivots, lower, upper) = jax.lax.scan(step, (nothing, nothing), tuple(blocks))
        return InOneLoop(pivots, times(pivots.left, lower), times(pivots.right, upper))

    def solve(self, r: Float[Array, "b w"]) -> Float[Array, "b w"]:
        y = _substitute(self.lower, apply(self.pivots.left, r))
        return _substitute(self.upper, apply(self.pivots.right, y), backwards=True)


class InChunks(eqx.Module):
    """`c` chunks of `1 + k` blocks. The `k` inner ones are `x = g - before s_{c-1} - after s_c` with the
    last ones, `s`, of their own chunk and of the one before, and `g` linear in `r`."""

    pivots: Pivot  # of the inner ones, as `lower` and `upper` in one loop
    lower: Float[Array, "k c w w"]
    upper: Float[Array, "k c w w"]
    before: Float[Array, "k c w w"]
    after: Float[Array, "k c w w"]
    last_multiplier: Float[Array, "c w w"]
    last_upper: Float[Array, "c w w"]
    last: "Tridiagonal | InOneLoop | InChunks"

    @staticmethod
    def of(blocks: Blocks) -> "InChunks":
        _, width, _ = blocks.diagonal.shape
        eye = jnp.eye(width, dtype=blocks.diagonal.dtype)
        L, D, U = (
            _chunks(A, fill) for A, fill in zip(blocks, (0 * eye, eye, 0 * eye), strict=True)
        )

        def inwards(before, block):
            """Forwards; `fill` is what couples a block to the last one of the chunk before."""
            *before, fill = before
            pivot, multiplier, upper = _next_pivot(*before, *block)
            fill = -times(pivot.left, times(multiplier, fill))
            return (pivot.right, upper, fill), (pivot, multiplier, upper, fill)

        nothing, minus = jnp.zeros_like(D[0]), jnp.broadcast_to(-eye, D[0].shape)
        pivot = Pivot.of(D[0])
        first = pivot.right, times(pivot.left, U[0]), times(pivot.left, L[0])
        (right, upper, fill), inner = jax.lax.scan(inwards, first, (L[1:-1], D[1:-1], U[1:-1]))
        joined = lambda first, rest: jnp.concatenate([first[None], rest])
        pivots = jax.tree_util.tree_map(joined, pivot, inner[0])
        lower, uppers, fills = map(joined, (nothing, *first[1:]), inner[1:])
        multiplier = times(L[-1], right)
        last_diagonal = D[-1] - times(multiplier, upper)
        last_lower = -times(multiplier, fill)
        lower = times(pivots.left, lower)
        uppers, fills = times(pivots.right, uppers), times(pivots.right, fills)

        def outwards(behind, block):
            (before, after), (upper, fill) = behind, block
            both = fill - times(upper, before), -times(upper, after)
            return both, both

        _, (before, after) = jax.lax.scan(outwards, (nothing, minus), (uppers, fills), reverse=True)
        last_diagonal = last_diagonal - times(U[-1], _after(before[0]))
        last = eliminate(Blocks(last_lower, last_diagonal, -times(U[-1], _after(after[0]))))
        return InChunks(pivots, lower, uppers, before, after, multiplier, U[-1], last)

    def solve(self, r: Float[Array, "b w"]) -> Float[Array, "b w"]:
        number, width = r.shape
        chunks = _chunks(r, jnp.zeros_like(r[0]))
        y = _substitute(self.lower, apply(self.pivots.left, chunks[:-1]))
        g = _substitute(self.upper, apply(self.pivots.right, y), backwards=True)
        end = chunks[-1] - apply(self.last_multiplier, y[-1])
        s = self.last.solve(end - apply(self.last_upper, _after(g[0])))
        x = g - apply(self.before, _before(s)[None]) - apply(self.after, s[None])
        x = jnp.concatenate([x, s[None]])
        return jnp.swapaxes(x, 0, 1).reshape(-1, width)[:number]


def _next_pivot(right, upper, L, D, U):
    """Of a block `L, D, U`, its multiplier and `upper`, from those before."""
    multiplier = times(L, right)
    pivot = Pivot.of(D - times(multiplier, upper))
    return pivot, multiplier, times(pivot.left, U)


def _chunks(A: Float[Array, "b ..."], fill: Float[Array, "..."]) -> Float[Array, "k c ..."]:
    """Position in the chunk first; the chunks next to each other."""
    number = A.shape[0]
    count = -(-number // _CHUNK)
    missing = jnp.broadcast_to(fill, (count * _CHUNK - number, *A.shape[1:]))
    A = jnp.concatenate([A, missing]).reshape(count, _CHUNK, *A.shape[1:])
    return jnp.swapaxes(A, 0, 1)


def _substitute(factors, r, backwards: bool = False):
    """`x_b = r_b - factors_b x_{b-1}`, or `x_{b+1}`."""

    def step(before, block):
        factor, r = block
        x = r - apply(factor, before)
        return x, x

    start = jnp.zeros(r.shape[1:], r.dtype)
    return jax.lax.scan(step, start, (factors, r), reverse=backwards)[1]


def _after(A: Array) -> Array:
    return jnp.concatenate([A[1:], jnp.zeros_like(A[:1])])


def _before(A: Array) -> Array:
    return jnp.concatenate([jnp.zeros_like(A[:1]), A[:-1]])
