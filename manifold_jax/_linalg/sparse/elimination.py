r"""Block tridiagonal systems `L_b x_{b-1} + D_b x_b + U_b x_{b+1} = r_b` in linear time.

Blocks are grouped into chunks of neighbours. All chunks are eliminated at the same time, except for
the last block of each; these are coupled by a smaller system of the same form (Wang, ACM Trans. Math.
Softw. 7 (1981) 170-183). One loop over all blocks would take as many iterations as there are blocks,
and an iteration costs more than its arithmetic. Without pivoting: the matrices met here are close to
symmetric positive definite, for which any order is stable.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..lapack import tridiagonal_solve
from .blocks import apply, Pivot, times


# Number of blocks in a chunk, and the largest number of blocks that are eliminated in one loop.
_CHUNK = 32
_ONE_LOOP = 64


class Blocks(NamedTuple):
    """The blocks of a block tridiagonal matrix: `lower[b]` to the left of `diagonal[b]`, `upper[b]` to
    the right. The first lower and the last upper one are zero."""

    lower: Float[Array, "b w w"]
    diagonal: Float[Array, "b w w"]
    upper: Float[Array, "b w w"]

    def transposed(self) -> "Blocks":
        flip = lambda A: jnp.swapaxes(A, -1, -2)
        return Blocks(flip(_before(self.upper)), flip(self.diagonal), flip(_after(self.lower)))


def eliminate(blocks: Blocks) -> "Tridiagonal | InOneLoop | InChunks":
    """Factor the matrix, to be solved with right-hand sides of shape `(b, w)`."""
    number, width, _ = blocks.diagonal.shape
    if width == 1:
        return Tridiagonal(blocks)
    return InOneLoop.of(blocks) if number <= _ONE_LOOP else InChunks.of(blocks)


class Tridiagonal(eqx.Module):
    """Elimination by the library (LAPACK, cuSPARSE), with row exchanges."""

    blocks: Blocks

    def solve(self, r: Float[Array, "b 1"]) -> Float[Array, "b 1"]:
        lower, diagonal, upper = (A[:, 0, 0] for A in self.blocks)
        return tridiagonal_solve(lower, diagonal, upper, r)


class InOneLoop(eqx.Module):
    """Elimination of one block after the other: with `R_b S_b` the inverse of the pivot `P_b`,

        M_b = L_b R_{b-1},    P_b = D_b - M_b W_{b-1},    W_b = S_b U_b,
        y_b = S_b (r_b - M_b y_{b-1}),    x_b = R_b (y_b - W_b x_{b+1}).

    `lower` holds `S_b M_b` and `upper` holds `R_b W_b`, so that each takes one product."""

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
    """Elimination of `c` chunks of `k + 1` blocks, all at the same time. See `of`."""

    pivots: Pivot  # of the inner blocks; `lower` and `upper` as in `InOneLoop`
    lower: Float[Array, "k c w w"]
    upper: Float[Array, "k c w w"]
    before: Float[Array, "k c w w"]
    after: Float[Array, "k c w w"]
    last_multiplier: Float[Array, "c w w"]
    last_upper: Float[Array, "c w w"]
    last: "Tridiagonal | InOneLoop | InChunks"

    @staticmethod
    def of(blocks: Blocks) -> "InChunks":
        """Eliminate the inner blocks `x_1, ..., x_k` of each chunk. They lie between its last block `s`
        and that of the chunk before, `s'`; forwards, with `M_j`, `P_j` and `W_j` as in `InOneLoop`,

            F_1 = S_1 L_1,    F_j = -S_j M_j F_{j-1},    x_j = R_j (y_j - W_j x_{j+1} - F_j s'),

        and backwards, from `x_{k+1} = s`, hence `g = 0`, `B = 0` and `A = -1` there,

            x_j = g_j - B_j s' - A_j s,
            g_j = R_j (y_j - W_j g_{j+1}),    B_j = R_j (F_j - W_j B_{j+1}),    A_j = -R_j W_j A_{j+1}.

        The remaining rows `L x_k + D s + U x_1 = r` of the last blocks, with `x_1`, `g_1`, `B_1` and
        `A_1` of the chunk after and `M = L R_k`, are a system of the same form for `s`:

            -M F_k s' + (D - M W_k - U B_1) s - U A_1 s'' = r - M y_k - U g_1.
        """
        _, width, _ = blocks.diagonal.shape
        eye = jnp.eye(width, dtype=blocks.diagonal.dtype)
        L, D, U = (
            _chunks(A, fill) for A, fill in zip(blocks, (0 * eye, eye, 0 * eye), strict=True)
        )

        def inwards(before, block):
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

        def outwards(following, block):
            (before, after), (upper, fill) = following, block
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
    """Return the pivot of the block row `L, D, U`, its multiplier `M` and `W`, from `R` and `W` of the
    row before (see `InOneLoop`)."""
    multiplier = times(L, right)
    pivot = Pivot.of(D - times(multiplier, upper))
    return pivot, multiplier, times(pivot.left, U)


def _chunks(A: Float[Array, "b ..."], fill: Float[Array, "..."]) -> Float[Array, "k c ..."]:
    """Group the blocks, with the position in a chunk in front; `fill` completes the last chunk."""
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
