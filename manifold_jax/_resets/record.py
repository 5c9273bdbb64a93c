"""The resets of a solve: when each happened, which one, and the states before and after it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from .._base.types import BoolScalar, IntScalar, Y


class Resets(eqx.Module):
    """The resets of a solution, `sol.resets`, in their order. Rows that were not used hold `inf`, and -1
    as index.

    **Attributes:**

    - `number`: how many there were.
    - `times`: of the events, shape `(max_resets,)`.
    - `indices`: which of the `resets` happened, shape `(max_resets,)`.
    - `before`, `after`: the states before and after, with a leading axis of length `max_resets`. Both are
        on the manifold.
    """

    number: IntScalar
    times: Float[Array, " max_resets"]
    indices: Int[Array, " max_resets"]
    before: Y
    after: Y


class ResetRecord(eqx.Module):
    """The resets so far, in the time of Diffrax."""

    number: IntScalar
    indices: Int[Array, " max_resets"]
    rows: Any  # times, states before and states after

    @staticmethod
    def empty(count: int, t: Any, y: Y) -> "ResetRecord":
        room = lambda x: jnp.full((count, *jnp.shape(x)), jnp.inf, jnp.result_type(x))
        rows = jtu.tree_map(room, (t, y, y))
        return ResetRecord(jnp.zeros((), jnp.int32), jnp.full(count, -1, jnp.int32), rows)

    def including(self, happened: BoolScalar, report: Any) -> "ResetRecord":
        row = jnp.where(happened, self.number, self.indices.size)  # beyond the end: dropped
        put = lambda xs, x: xs.at[row].set(x.astype(xs.dtype), mode="drop")
        new = report.time, report.before, report.after
        return ResetRecord(
            self.number + happened.astype(jnp.int32),
            self.indices.at[row].set(report.number.astype(jnp.int32), mode="drop"),
            jtu.tree_map(put, self.rows, new),
        )

    def read(self, direction: Any) -> Resets:
        times, before, after = self.rows
        number = jnp.minimum(self.number, self.indices.size)
        used = jnp.arange(self.indices.size, dtype=number.dtype) < number
        times = jnp.where(used, jnp.where(used, times, 0) * direction, jnp.inf)
        return Resets(number, times, self.indices, before, after)
