"""Names of numbers in pytrees, as users write them: `p[0,1]`, `arm.q[2]`, `x[3]'`."""

from typing import Any

import jax
import numpy as np


def number_names(tree: Any, alone: str) -> list[str]:
    """One for each number, in the order of `ravel_pytree`; `alone` is that of a tree that is just
    one array."""
    return [name for leaf in leaf_names(tree, alone) for name in leaf[1]]


def leaf_names(tree: Any, alone: str) -> list[tuple[str, list[str]]]:
    """Of each leaf, and of the numbers in it."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or alone
        if name[0].isdigit():
            name = f"{alone}.{name}"
        entries = [",".join(map(str, index)) for index in np.ndindex(np.shape(leaf))]
        found.append((name, [f"{name}[{entry}]" if entry else name for entry in entries]))
    return found


def listed(names: list[str], most: int = 8) -> str:
    """For messages."""
    text = ", ".join(f"`{name}`" for name in names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"
