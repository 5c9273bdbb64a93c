"""Shapes of pytrees, in checks and in messages."""

from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu


def shapes(tree: Any) -> Any:
    return jtu.tree_map(jnp.shape, tree)


def are_alike(a: Any, b: Any) -> bool:
    """Whether two pytrees have the same structure and the same shapes."""
    (leaves, structure), (others, other) = map(jtu.tree_flatten, (a, b))
    return structure == other and list(map(jnp.shape, leaves)) == list(map(jnp.shape, others))
