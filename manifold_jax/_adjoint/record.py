"""A loop that records its steps while it runs."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from .._compat import buffer_at_set, MaybeBuffer, unvmap_max, while_loop
from .._custom_types import IntScalar, Y


# Bytes up to which XLA for CPUs takes an array to be small. It runs the operations of a loop one
# after the other if all their arrays are, and hands them to threads if not, which takes longer
# than a step of a small system.
_SMALL = 512
_FEWEST, _MOST = 8, 64  # steps of a block
_SMALL_STATE = 64  # bytes


class Record(eqx.Module):
    """The steps of a solve in blocks, rejected ones included: where each began and ended, its
    number among the accepted ones, and the states from which they were made, all of them or
    the first of each block.

    Rejected steps take rows so that the trajectories of a batch, which have the same number of
    steps until they end, write to the same row: an index of its own for each would make a
    slice a scatter, which takes longer than the step. Unused rows of the times hold infinity.
    """

    starts: MaybeBuffer[Float[Array, "blocks block"]]
    ends: MaybeBuffer[Float[Array, "blocks block"]]
    numbers: MaybeBuffer[Int[Array, "blocks block"]]  # from 1; 0 if rejected or unused
    states: Y  # leading axes: blocks, and block if there are all of them
    every_state: bool = eqx.field(static=True)

    @staticmethod
    def empty(y: Y, time_dtype: Any, max_steps: int, stride: int) -> "Record":
        block = min(_block_length(y), max_steps) if stride == 1 else stride
        one = _Recent.empty(y, time_dtype, block, stride == 1)
        states = jtu.tree_map(jnp.zeros_like, y) if one.states is None else one.states
        repeat = lambda x: jnp.broadcast_to(x, (-(-max_steps // block), *x.shape))
        columns = one.starts, one.ends, one.numbers, states
        return Record(*jtu.tree_map(repeat, columns), stride == 1)

    @property
    def block(self) -> int:
        return self.starts.shape[1]

    def steps_at(self, times: Float[Array, " rows"]) -> Int[Array, " rows"]:
        """The accepted steps in which times lie; beyond all steps where there is none."""
        # Rejected steps end where the last accepted one did: a time at a jump lies between that
        # one and the start of the next.
        ends = jnp.where(self.numbers > 0, self.ends, -jnp.inf).reshape(-1)
        used = jnp.isfinite(self.ends).reshape(-1)
        ends = jnp.where(used, lax.cummax(ends), jnp.inf)
        return jnp.searchsorted(ends, times).astype(int)

    def including(self, i: IntScalar, block: "_Recent", start: Y) -> "Record":
        put = lambda buffer, x: buffer_at_set(buffer, i, x)
        states = block.states if self.every_state else start
        return Record(
            put(self.starts, block.starts),
            put(self.ends, block.ends),
            put(self.numbers, block.numbers),
            jtu.tree_map(lambda x, b: put(b, x), states, self.states),
            self.every_state,
        )


class _Recent(eqx.Module):
    """The block that is being recorded."""

    starts: MaybeBuffer[Float[Array, " block"]]
    ends: MaybeBuffer[Float[Array, " block"]]
    numbers: MaybeBuffer[Int[Array, " block"]]
    states: Y | None

    @staticmethod
    def empty(y: Y, time_dtype: Any, length: int, every_state: bool) -> "_Recent":
        times = jnp.full((length,), jnp.inf, time_dtype)
        rows = jtu.tree_map(lambda leaf: jnp.zeros((length, *leaf.shape), leaf.dtype), y)
        numbers = jnp.zeros((length,), jnp.int32)
        return _Recent(times, times, numbers, rows if every_state else None)

    def including(self, i: IntScalar, start: Any, end: Any, number: Any, y: Y) -> "_Recent":
        put = lambda x, buffer: buffer_at_set(buffer, i, x)
        return _Recent(
            put(start, self.starts),
            put(end, self.ends),
            put(number, self.numbers),
            None if self.states is None else jtu.tree_map(put, y, self.states),
        )


def default_stride(y: Y, max_steps: int) -> int:
    """Steps between two recorded states: one if a state is hardly larger than what is recorded
    with it; else such that memory is least."""
    size = sum(leaf.nbytes for leaf in jtu.tree_leaves(y))
    return 1 if size <= _SMALL_STATE else math.isqrt(max_steps)


def _block_length(y: Y) -> int:
    largest = max(leaf.nbytes for leaf in jtu.tree_leaves(y))
    return max(_FEWEST, min(_MOST, _SMALL // max(largest, 1)))


def recording(record: Record, run: Callable) -> tuple[Any, Record]:
    """`run(while_loop)` with `while_loop` as Diffrax's outer loop, and what it recorded."""
    written = record

    def loop(cond_fun, body_fun, init_val, *, max_steps, buffers):
        nonlocal written

        def goes_on(carry):
            state, _ = carry
            return cond_fun(state) & (state.num_steps < max_steps)

        def step(carry):
            state, block = carry
            new = body_fun(state)
            accepted = new.num_accepted_steps > state.num_accepted_steps
            number = jnp.where(accepted, new.num_accepted_steps, 0).astype(jnp.int32)
            i = unvmap_max(state.num_steps) % record.block
            return new, block.including(i, state.tprev, state.tnext, number, state.y)

        def through_block(carry):
            state, record = carry
            i, start = unvmap_max(state.num_steps) // record.block, state.y
            empty = _Recent.empty(start, state.tprev.dtype, record.block, record.every_state)
            state, block = nested(step, (state, empty), record.block)
            return state, record.including(i, block, start)

        def nested(body, carry, most):
            both = lambda carry: buffers(carry[0]) + jtu.tree_leaves(carry[1])
            return while_loop(goes_on, body, carry, max_steps=most, buffers=both, kind="lax")

        final, written = nested(through_block, (init_val, record), record.starts.shape[0])
        return final

    out = run(loop)
    return out, written
