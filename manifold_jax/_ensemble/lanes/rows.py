"""What was asked for, in the order in which `diffrax.SaveAt` has it."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .arguments import Batch
from .schedule import Run


def saved_rows(sub: dfx.SubSaveAt, batch: Batch, run: Run) -> tuple[Array, Any]:
    """Times and values, the trajectories in front: at the start, at given times, at the end."""
    saved = lambda t, y, each: sub.fn(t, y, batch.complete(each).args)
    at = lambda t, y: jax.vmap(saved)(t, y, batch.each)
    t0 = jax.vmap(lambda each: batch.complete(each).t0)(batch.each)
    start = run.start.trajectory.y
    parts = []
    if sub.t0:
        parts.append((t0[:, None], _as_row(at(t0, start))))
    if sub.ts is not None:
        ts = jnp.broadcast_to(sub.ts.astype(t0.dtype)[None], (batch.size, sub.ts.size))
        # Also where the solve is of no length, and makes no step.
        first = ts == t0[:, None]
        reached = (jnp.arange(sub.ts.size)[None] < run.rows[:, None]) | first
        values = jtu.tree_map(
            lambda y, y0: jnp.where(_like(first, y), y0[:, None], y), run.values, at(t0, start)
        )
        parts.append((jnp.where(reached, ts, jnp.inf), values))
    if sub.t1:
        t1 = run.outcome.t
        parts.append((t1[:, None], _as_row(at(t1, run.outcome.y))))
    joined = lambda *leaves: jnp.concatenate(leaves, axis=1)
    times, values = zip(*parts, strict=True)
    return joined(*times), jtu.tree_map(joined, *values)


def _as_row(tree: Any) -> Any:
    return jtu.tree_map(lambda x: x[:, None], tree)


def _like(mask: Array, y: Array) -> Array:
    return mask.reshape(*mask.shape, *(1,) * (y.ndim - mask.ndim))
