"""The rows of `diffrax.SaveAt`, in its order: the start, given times, the end."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from ..._base.types import Y
from .arguments import Batch
from .parts import Parts


def saved_rows(
    sub: dfx.SubSaveAt, batch: Batch, rows: Array, t1: Array, first: Y, last: Y, values: Any
) -> tuple[Array, Any]:
    """Return times and values, with the trajectories in front: at the start, where states are `first`;
    at given times, of which each has reached the first `rows`; at the end `t1`, where they are `last`."""
    saved = lambda t, y, each: sub.fn(t, y, batch.complete(each).args)
    at = lambda t, y: jax.vmap(saved)(t, y, batch.each)
    t0 = jax.vmap(lambda each: batch.complete(each).t0)(batch.each)
    as_row = lambda tree: jtu.tree_map(lambda x: x[:, None], tree)
    parts = []
    if sub.t0:
        parts.append((t0[:, None], as_row(at(t0, first))))
    if sub.ts is not None:
        ts = jnp.broadcast_to(sub.ts.astype(t0.dtype)[None], (batch.size, sub.ts.size))
        # The start itself is reached without a step.
        is_first = ts == t0[:, None]
        reached = (jnp.arange(sub.ts.size)[None] < rows[:, None]) | is_first
        values = jtu.tree_map(
            lambda y, y0: jnp.where(like(is_first, y), y0[:, None], y), values, at(t0, first)
        )
        parts.append((jnp.where(reached, ts, jnp.inf), values))
    if sub.t1:
        parts.append((t1[:, None], as_row(at(t1, last))))
    joined = lambda *leaves: jnp.concatenate(leaves, axis=1)
    times, values = zip(*parts, strict=True)
    return joined(*times), jtu.tree_map(joined, *values)


def smooth_rows(parts: Parts, rows: Array, t1: Array, values: Any) -> tuple[Callable, Any]:
    """Return the real numbers of [`saved_rows`][] as a function of `each`, `common`, the first and the
    last states and the real numbers in `values`; and the latter."""
    smooth, others = eqx.partition(values, eqx.is_inexact_array)

    def saved(each: Any, common: Any, first: Y, last: Y, smooth: Any) -> Any:
        equations, batch = parts.inputs(each, common)
        of = rows, t1, first, last, eqx.combine(smooth, others)
        return eqx.filter(saved_rows(equations.saveat.subs, batch, *of), eqx.is_inexact_array)

    return saved, smooth


def like(mask: Array, x: Array) -> Array:
    return mask.reshape(*mask.shape, *(1,) * (x.ndim - mask.ndim))
