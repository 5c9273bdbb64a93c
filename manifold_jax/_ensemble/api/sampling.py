"""Trajectories generated from their indices, in batches."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array


def drawn(sample: Callable, t0: Any, t1: Any, key: Array, index: Array) -> dict[str, Any]:
    """Return the arguments of `solve_ensemble` for the trajectories with these indices. Arrays in
    `args` that depend neither on the index nor on the key stay common to all."""
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, index)
    own, common = _common(sample, index[0], keys[0])

    def each(index: Array, key: Array) -> Any:
        y0, args = _pair(sample(index, key))
        y0 = jtu.tree_map(jnp.asarray, y0)
        times = [t(index, key) if callable(t) else None for t in (t0, t1)]
        return times, y0, eqx.filter(args, own)

    (t0s, t1s), y0s, args = jax.vmap(each)(index, keys)
    return {
        "t0": t0 if t0s is None else t0s,
        "t1": t1 if t1s is None else t1s,
        "y0s": y0s,
        "args": eqx.combine(args, common),
        "args_axes": jtu.tree_map(lambda own: 0 if own else None, own),
    }


def _common(sample: Callable, index: Array, key: Array) -> tuple[Any, Any]:
    """Return which leaves of `args` are computed, and the others, which do not depend on anything."""
    args = None

    def look(index: Array, key: Array) -> None:
        nonlocal args
        args = _pair(sample(index, key))[1]

    jax.eval_shape(look, index, key)
    own = jtu.tree_map(lambda leaf: isinstance(leaf, jax.core.Tracer), args)
    return own, eqx.filter(args, own, inverse=True)


def _pair(result: Any) -> tuple[Any, Any]:
    if not isinstance(result, tuple) or len(result) != 2:
        raise ValueError(
            "`sample(index, key)` must return the pair `(y0, args)` of one trajectory, with `None` for `args` if "
            f"there are none; got {type(result).__name__}"
            f"{f' of length {len(result)}' if isinstance(result, tuple) else ''}."
        )
    return result
