"""A loop that records its steps while it runs."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.flatten_util as jfu
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
    """The steps of a solve in blocks, rejected ones included: where each began and ended, whether
    it was accepted, and the states from which they were made, all of them or the first of each
    block.

    Rejected steps take rows so that the trajectories of a batch, which have the same number of
    steps until they end, write to the same row: an index of its own for each would make a
    slice a scatter, which takes longer than the step. Two arrays with long rows, whatever the
    leaves of a state, as each one that is written to costs a batch several kernels.
    """

    # Columns: start, end, 1 if accepted or else 0; infinity, infinity, 0 in unused rows.
    steps: MaybeBuffer[Float[Array, "blocks block 3"]]
    states: MaybeBuffer[Float[Array, "blocks *block n"]]
    every_state: bool = eqx.field(static=True)

    @staticmethod
    def empty(y: Y, time_dtype: Any, max_steps: int, stride: int) -> "Record":
        block = min(_block_length(y), max_steps) if stride == 1 else stride
        x, _ = jfu.ravel_pytree(y)
        one = _Recent.empty(x, time_dtype, block, stride == 1)
        repeat = lambda x: jnp.broadcast_to(x, (-(-max_steps // block), *x.shape))
        states = jnp.zeros_like(x) if one.states is None else one.states
        return Record(repeat(one.steps), repeat(states), stride == 1)

    @property
    def block(self) -> int:
        return self.steps.shape[1]

    def steps_at(self, times: Float[Array, " rows"]) -> Int[Array, " rows"]:
        """The accepted steps in which times lie; beyond all steps where there is none."""
        # Rejected steps end where the last accepted one did: a time at a jump lies between that
        # one and the start of the next.
        _, ends, accepted = jnp.moveaxis(self.steps.reshape(-1, 3), 1, 0)
        reached = lax.cummax(jnp.where(accepted > 0, ends, -jnp.inf))
        reached = jnp.where(jnp.isfinite(ends), reached, jnp.inf)
        return jnp.searchsorted(reached, times).astype(int)

    def including(self, i: IntScalar, block: "_Recent", start: Float[Array, " n"]) -> "Record":
        states = block.states if self.every_state else start
        return Record(
            buffer_at_set(self.steps, i, block.steps),
            buffer_at_set(self.states, i, states),
            self.every_state,
        )


class _Recent(eqx.Module):
    """The block that is being recorded."""

    steps: MaybeBuffer[Float[Array, "block 3"]]
    states: MaybeBuffer[Float[Array, "block n"]] | None

    @staticmethod
    def empty(x: Float[Array, " n"], time_dtype: Any, length: int, every_state: bool) -> "_Recent":
        unused = jnp.asarray([jnp.inf, jnp.inf, 0], time_dtype)
        steps = jnp.broadcast_to(unused, (length, 3))
        return _Recent(steps, jnp.zeros((length, x.size), x.dtype) if every_state else None)

    def including(self, i: IntScalar, step: Float[Array, "3"], x: Float[Array, " n"]) -> "_Recent":
        states = None if self.states is None else buffer_at_set(self.states, i, x)
        return _Recent(buffer_at_set(self.steps, i, step), states)


def default_stride(y: Y, max_steps: int) -> int:
    """Steps between two recorded states: one if a state is hardly larger than what is recorded
    with it; else such that memory is least."""
    return 1 if _size(y) <= _SMALL_STATE else math.isqrt(max_steps)


def _block_length(y: Y) -> int:
    return max(_FEWEST, min(_MOST, _SMALL // max(_size(y), 24)))


def _size(y: Y) -> int:
    return sum(leaf.nbytes for leaf in jtu.tree_leaves(y))


def recording(record: Record, run: Callable) -> tuple[Any, Record]:
    """`run(while_loop)` with `while_loop` as Diffrax's outer loop, and what it recorded."""
    written = record
    flat = lambda state: jfu.ravel_pytree(state.y)[0]

    def loop(cond_fun, body_fun, init_val, *, max_steps, buffers):
        nonlocal written

        def goes_on(carry):
            state, _ = carry
            return cond_fun(state) & (state.num_steps < max_steps)

        def step(carry):
            state, block = carry
            new = body_fun(state)
            accepted = new.num_accepted_steps > state.num_accepted_steps
            row = jnp.stack([state.tprev, state.tnext, accepted.astype(state.tprev.dtype)])
            i = unvmap_max(state.num_steps) % record.block
            return new, block.including(i, row, flat(state))

        def through_block(carry):
            state, record = carry
            i, start = unvmap_max(state.num_steps) // record.block, flat(state)
            empty = _Recent.empty(start, state.tprev.dtype, record.block, record.every_state)
            state, block = nested(step, (state, empty), record.block)
            return state, record.including(i, block, start)

        def nested(body, carry, most):
            both = lambda carry: buffers(carry[0]) + jtu.tree_leaves(carry[1])
            return while_loop(goes_on, body, carry, max_steps=most, buffers=both, kind="lax")

        final, written = nested(through_block, (init_val, record), record.steps.shape[0])
        return final

    out = run(loop)
    return out, written
