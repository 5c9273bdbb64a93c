"""A loop that records the accepted steps while it runs."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._compat import buffer_at_set, MaybeBuffer, while_loop
from .._custom_types import IntScalar, Y


# Steps that the way back takes out of the record at once: those of the trajectories of a batch
# then lie close to each other in memory.
_BLOCK = 64


class Record(eqx.Module):
    """The accepted steps of a solve: where each began and ended, and every `stride`-th state
    from which one was made. Unused rows of the times hold infinity."""

    starts: MaybeBuffer[Float[Array, " steps"]]
    ends: MaybeBuffer[Float[Array, " steps"]]
    states: Y  # leading axis: steps / stride
    stride: int = eqx.field(static=True)
    block: int = eqx.field(static=True)  # steps between two states, or that are handled together

    @staticmethod
    def empty(y: Y, time_dtype: Any, max_steps: int, stride: int) -> "Record":
        block = min(_BLOCK, max_steps) if stride == 1 else stride
        size = -(-max_steps // block) * block
        rows = size // stride
        times = jnp.full((size,), jnp.inf, time_dtype)
        states = jtu.tree_map(lambda leaf: jnp.zeros((rows, *leaf.shape), leaf.dtype), y)
        return Record(times, times, states, stride, block)

    def including(self, i: IntScalar, start: Any, end: Any, y: Y, accepted: Any) -> "Record":
        put = lambda buffer, i, x, pred: buffer_at_set(buffer, i, x, pred=pred)
        kept = accepted & (i % self.stride == 0)
        return Record(
            put(self.starts, i, start, accepted),
            put(self.ends, i, end, accepted),
            jtu.tree_map(lambda x, b: put(b, i // self.stride, x, kept), y, self.states),
            self.stride,
            self.block,
        )


def recording(record: Record, run: Callable) -> tuple[Any, Record]:
    """`run(while_loop)` with `while_loop` as Diffrax's outer loop, and what it recorded."""
    written = record

    def loop(cond_fun, body_fun, init_val, *, max_steps, buffers):
        nonlocal written

        def body(carry):
            state, record = carry
            new = body_fun(state)
            accepted = new.num_accepted_steps > state.num_accepted_steps
            record = record.including(
                state.num_accepted_steps, state.tprev, state.tnext, state.y, accepted
            )
            return new, record

        final, written = while_loop(
            lambda carry: cond_fun(carry[0]),
            body,
            (init_val, record),
            max_steps=max_steps,
            buffers=lambda carry: buffers(carry[0]) + jtu.tree_leaves(carry[1]),
            kind="lax",
        )
        return final

    out = run(loop)
    return out, written
