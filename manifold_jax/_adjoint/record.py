"""The record of a solve for its reverse sweep: when each step was made, and from which state."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.compat import buffer_at_set, MaybeBuffer, Progress, unvmap_max, while_loop
from .._base.types import IntScalar
from .._resets.controller import record_of_resets


# Blocks have `_FEWEST` steps if their states then take at most `_SMALL` bytes: XLA for CPUs runs the
# operations of a loop on such small arrays one after the other instead of handing them to threads. With
# larger blocks gradients take 1.3 times as long with jaxlib 0.10.2, and as long with 0.12.0.1
# (`python -m benchmarks.speed.thresholds`).
_SMALL, _FEWEST = 512, 8
# All states of the first steps are kept: as many as fit into `_BYTES`, but at most `_STATES`, as memory
# that is not in a cache takes longer to fill than a small state to compute again.
_BYTES, _STATES = 2**20, 512


class Sizes(NamedTuple):
    """The division of the steps of a solve into blocks, and of blocks into segments."""

    block: int  # steps in a block
    segment: int  # blocks in a segment
    blocks: int  # blocks in all
    kept: int  # blocks, the first ones, of which all states are kept

    @staticmethod
    def of(nbytes: int, max_steps: int, checkpoints: int | None) -> "Sizes":
        """Choose sizes for states of `nbytes` bytes. A segment has about `sqrt(max_steps)` steps, or more
        where `checkpoints` states, one for each segment, would not suffice for that.

        For 32 bytes, 4096 steps and `checkpoints=None`: segments of 64 steps, in 8 blocks of 8 steps,
        which take 256 bytes. There are 64 segments in 512 blocks. The states of 512 steps fit, so those
        of the first 64 blocks are kept: `Sizes(8, 8, 512, 64)`."""
        steps = max(math.isqrt(max_steps), -(-max_steps // (checkpoints or max_steps)))
        block = min(_FEWEST, steps) if nbytes * _FEWEST <= _SMALL else steps
        segment = -(-steps // block)
        segments = -(-max_steps // (segment * block))
        if checkpoints is None:
            checkpoints = segments + min(_STATES, _BYTES // max(nbytes, 1))
        kept = (
            segments if checkpoints >= max_steps else (checkpoints - segments) // (segment * block)
        )
        return Sizes(block, segment, segments * segment, min(kept, segments) * segment)


Vectors = dict[str, Any]  # one vector for each dtype, or a buffer of such vectors


class Packing(eqx.Module):
    """Packs a pytree of arrays into one vector for each dtype, and unpacks it."""

    leaves: list[jax.ShapeDtypeStruct] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @staticmethod
    def of(tree: Any) -> "Packing":
        leaves, structure = jtu.tree_flatten(jax.eval_shape(lambda: tree))
        return Packing(leaves, structure)

    def pack(self, tree: Any) -> Vectors:
        groups: dict[str, list[Array]] = {}
        for leaf, like in zip(jtu.tree_leaves(tree), self.leaves, strict=True):
            groups.setdefault(str(like.dtype), []).append(jnp.ravel(jnp.asarray(leaf, like.dtype)))
        return {dtype: jnp.concatenate(group) for dtype, group in groups.items()}

    def unpack(self, vectors: Vectors) -> Any:
        position = dict.fromkeys(vectors, 0)
        leaves = []
        for like in self.leaves:
            dtype = str(like.dtype)
            part = lax.dynamic_slice_in_dim(vectors[dtype], position[dtype], like.size)
            leaves.append(part.reshape(like.shape))
            position[dtype] += like.size
        return jtu.tree_unflatten(self.structure, leaves)

    @property
    def nbytes(self) -> int:
        return sum(like.size * like.dtype.itemsize for like in self.leaves)


class Record(eqx.Module):
    """The steps of a solve, rejected ones included: their times, and states from which they were made.
    All states of the first blocks are kept, of later ones only the first state of each segment.

    Rejected steps take rows so that the trajectories of a batch, which have the same number of
    steps until they end, write to the same row: with an index for each of them the slice would
    become a scatter, which takes longer than the step.
    """

    times: MaybeBuffer[Float[Array, "blocks block columns"]]
    states: Vectors  # (kept blocks, block, n)
    firsts: Vectors  # (segments, n); empty if all states are kept
    packing: Packing = eqx.field(static=True)
    sizes: Sizes = eqx.field(static=True)
    jumps: bool = eqx.field(static=True)  # whether steps may begin after jumps of the field
    resets: bool = eqx.field(static=True)  # whether steps may end at a reset
    noise: bool = eqx.field(static=True)  # which has no derivatives with respect to times

    @staticmethod
    def empty(
        state: Any,
        time_dtype: Any,
        max_steps: int,
        checkpoints: int | None,
        jumps: bool,
        resets: bool,
        noise: bool,
    ) -> "Record":
        """Return a record without steps. Its columns are the start and the end of a step, whether it begins
        after a jump of the field, and twice the number of the reset at its end (-1 for none), one more if it
        begins at a reset; the last two only where they are used."""
        packing = Packing.of(state)
        sizes = Sizes.of(packing.nbytes, max_steps, checkpoints)
        x = packing.pack(state)
        room = lambda rows, v: jnp.zeros((*rows, v.size), v.dtype)
        segments = 0 if sizes.kept == sizes.blocks else sizes.blocks // sizes.segment
        kept = {k: room((sizes.kept, sizes.block), v) for k, v in x.items() if sizes.kept}
        times = jnp.full((sizes.blocks, sizes.block, 2 + jumps + resets), -jnp.inf, time_dtype)
        firsts = {k: room((segments,), v) for k, v in x.items() if segments}
        return Record(times, kept, firsts, packing, sizes, jumps, resets, noise)

    def including(self, i: IntScalar, row: Float[Array, " columns"], x: Vectors) -> "Record":
        """Return the record with step number `i`, made from `x`."""
        sizes = self.sizes
        block, within = i // sizes.block, i % sizes.block
        segment, begins = block // sizes.segment, (block % sizes.segment == 0) & (within == 0)
        firsts = {k: buffer_at_set(b, segment, x[k], pred=begins) for k, b in self.firsts.items()}  # pyright: ignore[reportArgumentType]
        at = jnp.minimum(block, sizes.kept - 1), within
        is_kept = block < sizes.kept
        states = {k: buffer_at_set(b, at, x[k], pred=is_kept) for k, b in self.states.items()}  # pyright: ignore[reportArgumentType]
        times = buffer_at_set(self.times, (block, within), row)
        kinds = self.jumps, self.resets, self.noise
        return Record(times, states, firsts, self.packing, sizes, *kinds)  # pyright: ignore[reportArgumentType]


def counted_down(count: IntScalar, through: Callable, carry: Any) -> Any:
    """`through(carry, i)` for all `i` from `count - 1` down to 0."""
    once = lambda state: (state[0] - 1, through(state[1], state[0] - 1))
    return lax.while_loop(lambda state: state[0] > 0, once, (count, carry))[1]


def rows_backwards(rows: Any, count: IntScalar, through: Callable, carry: Any) -> Any:
    """`through(carry, row)` for the first `count` rows of arrays, beginning with the last one."""
    # Fetched one step ahead: XLA would copy the slices into every kernel that needs them.
    fetched = lambda i: jtu.tree_map(lambda x: x[jnp.maximum(i, 0)], rows)

    def once(state: Any) -> Any:
        i, carry, row = state
        return i - 1, through(carry, row), fetched(i - 1)

    start = count - 1, carry, fetched(count - 1)
    return lax.while_loop(lambda state: state[0] >= 0, once, start)[1]


def recording(record: Record, of: Callable[[Any], Any], run: Callable) -> tuple[Any, Record]:
    """`run(while_loop)` with `while_loop` as the outer loop of Diffrax, which also makes a record of
    the states `of(loop state)`."""
    written = record

    def loop(cond_fun, body_fun, init_val, *, max_steps, buffers):
        nonlocal written

        def step(carry):
            state, record = carry
            new, now = body_fun(state), Progress.of(state)
            end = Progress.of(new)
            accepted = end.num_accepted_steps > now.num_accepted_steps
            row = [now.tprev, jnp.where(accepted, now.tnext, -jnp.inf)]
            if record.jumps:
                row.append(jnp.asarray(now.made_jump, now.tprev.dtype))
            if record.resets:
                before, after = (record_of_resets(p.controller_state) for p in (now, end))
                which = after.indices[before.number]
                which = jnp.where(after.number > before.number, which, -1)
                begins = now.solver_state.history.after_reset & (before.number > 0)
                row.append((2 * which + begins.astype(which.dtype)).astype(now.tprev.dtype))
            x = record.packing.pack(of(state))
            return new, record.including(unvmap_max(now.num_steps), jnp.stack(row), x)

        final, written = while_loop(
            lambda carry: cond_fun(carry[0]),
            step,
            (init_val, record),
            max_steps=max_steps,
            buffers=lambda carry: buffers(carry[0]) + jtu.tree_leaves(carry[1]),
            kind="lax",
        )
        return final

    out = run(loop)
    return out, written
