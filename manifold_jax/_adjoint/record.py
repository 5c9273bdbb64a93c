"""What a solve leaves behind for its way back: when each step was made, and from which state."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._compat import buffer_at_set, MaybeBuffer, unvmap_max, while_loop
from .._custom_types import IntScalar
from .sizes import Sizes


Vectors = dict[str, Any]  # of each type of number one, also buffers of such


class Packing(eqx.Module):
    """A pytree of arrays as one vector for each type of number, and back."""

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


class Block(eqx.Module):
    """Steps one after the other. Small ones are recorded in a loop of their own: XLA for CPUs runs
    the operations of a loop one after the other if all its arrays are small, and hands them to
    threads if not, which may take longer than a step."""

    # Columns: start, end, and 1 behind a jump if there may be jumps. The end of a rejected step
    # and of an unused row is minus infinity.
    times: MaybeBuffer[Float[Array, "block columns"]]
    states: Vectors  # from which they were made; none if they are not kept

    @staticmethod
    def empty(x: Vectors, time_dtype: Any, length: int, jumps: bool, kept: bool) -> "Block":
        times = jnp.full((length, 3 if jumps else 2), -jnp.inf, time_dtype)
        room = lambda x: jnp.zeros((length, x.size), x.dtype)
        return Block(times, {k: room(v) for k, v in x.items()} if kept else {})

    def including(self, i: IntScalar, row: Float[Array, " columns"], x: Vectors) -> "Block":
        states = {k: buffer_at_set(b, i, x[k]) for k, b in self.states.items()}
        return Block(buffer_at_set(self.times, i, row), states)


class Record(eqx.Module):
    """The steps of a solve, rejected ones included, in blocks: when each was made, and the states
    from which they were made: all of the first few, of later ones the first of each segment,
    which has several blocks.

    Rejected steps take rows so that the trajectories of a batch, which have the same number of
    steps until they end, write to the same row: an index of its own for each would make a
    slice a scatter, which takes longer than the step.
    """

    times: MaybeBuffer[Float[Array, "blocks block columns"]]
    states: Vectors  # (kept blocks, block, n)
    firsts: Vectors  # (segments, n); none if all states are kept
    packing: Packing = eqx.field(static=True)
    sizes: Sizes = eqx.field(static=True)

    @staticmethod
    def empty(
        state: Any, time_dtype: Any, max_steps: int, checkpoints: int | None, jumps: bool
    ) -> "Record":
        packing = Packing.of(state)
        sizes = Sizes.of(packing.nbytes, max_steps, checkpoints)
        x = {k: jnp.zeros_like(v) for k, v in packing.pack(state).items()}
        one = Block.empty(x, time_dtype, sizes.block, jumps, sizes.kept > 0)
        repeat = lambda rows, x: jnp.broadcast_to(x, (rows, *x.shape))
        segments = 0 if sizes.kept == sizes.blocks else sizes.blocks // sizes.segment
        return Record(
            repeat(sizes.blocks, one.times),
            {k: repeat(sizes.kept, v) for k, v in one.states.items()},
            {k: repeat(segments, v) for k, v in x.items() if segments},
            packing,
            sizes,
        )

    @property
    def jumps(self) -> bool:
        return self.times.shape[2] == 3

    def new_block(self, x: Vectors) -> Block:
        kept = self.sizes.kept > 0
        return Block.empty(x, self.times.dtype, self.sizes.block, self.jumps, kept)

    def including(self, i: IntScalar, block: Block, first: Vectors) -> "Record":
        """With the block number `i`, whose first step was made from `first`."""
        sizes, last = self.sizes, self.sizes.kept - 1
        segment, begins = i // sizes.segment, i % sizes.segment == 0
        firsts = {
            k: buffer_at_set(b, segment, first[k], pred=begins) for k, b in self.firsts.items()
        }
        keep = lambda b, x: buffer_at_set(b, jnp.minimum(i, last), x, pred=i <= last)
        states = {k: keep(b, block.states[k]) for k, b in self.states.items()}
        times = buffer_at_set(self.times, i, block.times)
        return Record(times, states, firsts, self.packing, sizes)


def recording(record: Record, of: Callable[[Any], Any], run: Callable) -> tuple[Any, Record]:
    """`run(while_loop)` with `while_loop` as Diffrax's outer loop, and what it recorded of
    the states `of(loop state)`."""
    written, block = record, record.sizes.block
    flat = lambda state: record.packing.pack(of(state))

    def loop(cond_fun, body_fun, init_val, *, max_steps, buffers):
        nonlocal written

        def step(carry):
            state, recent = carry
            new = body_fun(state)
            accepted = new.num_accepted_steps > state.num_accepted_steps
            row = [state.tprev, jnp.where(accepted, state.tnext, -jnp.inf)]
            if record.jumps:
                row.append(jnp.asarray(state.made_jump, state.tprev.dtype))
            i = unvmap_max(state.num_steps) % block
            return new, recent.including(i, jnp.stack(row), flat(state))

        def through_block(carry):
            state, record = carry
            i, first = unvmap_max(state.num_steps) // block, flat(state)
            state, recent = nested(step, (state, record.new_block(first)), block)
            return state, record.including(i, recent, first)

        def nested(body, carry, most):
            both = lambda carry: buffers(carry[0]) + jtu.tree_leaves(carry[1])
            goes_on = lambda carry: cond_fun(carry[0]) & (carry[0].num_steps < max_steps)
            return while_loop(goes_on, body, carry, max_steps=most, buffers=both, kind="lax")

        final, written = nested(through_block, (init_val, record), record.sizes.blocks)
        return final

    out = run(loop)
    return out, written
