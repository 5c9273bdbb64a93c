"""The resets of a solve: when each happened, which one, and the states before and after it."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from .._base.types import BoolScalar, IntScalar, Y


class Resets(eqx.Module):
    """The resets of a solution, `sol.resets`, in their order. Rows that were not used hold `inf`, and -1
    as index.

    **Attributes:**

    - `number`: how many there were.
    - `times`: of the events, shape `(rows,)`: `max_resets` rows, and one for each time of [`ResetAt`][].
    - `indices`: which of the `resets` happened, shape `(rows,)`.
    - `before`, `after`: the states before and after, with a leading axis of length `rows`. Both are
        on the manifold.
    """

    number: IntScalar
    times: Float[Array, " rows"]
    indices: Int[Array, " rows"]
    before: Y
    after: Y


class ResetRecord(eqx.Module):
    """The resets so far, in the time of Diffrax."""

    number: IntScalar
    indices: Int[Array, " rows"]
    rows: Any  # times, states before and states after

    @staticmethod
    def empty(count: int, t: Any, y: Y) -> "ResetRecord":
        """Return a record with room for `count` resets. There is one more row, for what is not one."""
        room = lambda x: jnp.full((count + 1, *jnp.shape(x)), jnp.inf, jnp.result_type(x))
        rows = jtu.tree_map(room, (t, y, y))
        return ResetRecord(jnp.zeros((), jnp.int32), jnp.full(count + 1, -1, jnp.int32), rows)

    def including(self, happened: BoolScalar, met: Any) -> "ResetRecord":
        # The next row is always written, which is cheaper than doing it on a condition.
        put = lambda xs, x: lax.dynamic_update_index_in_dim(xs, x.astype(xs.dtype), self.number, 0)
        rows = jtu.tree_map(put, self.rows, (met.time, met.before, met.after))
        indices = put(self.indices, met.number)
        return ResetRecord(self.number + happened.astype(jnp.int32), indices, rows)

    def read(self, direction: Any) -> Resets:
        count = self.indices.size - 1
        number = jnp.minimum(self.number, count)
        used = jnp.arange(count, dtype=number.dtype) < number

        def only_used(x: Array, empty: Any) -> Array:
            where = used.reshape(-1, *[1] * (x.ndim - 1))
            return jnp.where(where, x[:count], jnp.asarray(empty, x.dtype))

        times, before, after = jtu.tree_map(lambda x: only_used(x, jnp.inf), self.rows)
        times = jnp.where(used, only_used(self.rows[0], 0) * direction, times)
        indices = jnp.where(used, self.indices[:count], -1)
        return Resets(number, times, indices, before, after)
