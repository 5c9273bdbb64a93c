"""Trees of values as lists of columns, one number of each lane or each trajectory."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._jaxpr.lane_value import Layout


def columns_of_arrays(tree: Any) -> list[jax.Array]:
    """Return the columns of arrays with the trajectories in front."""
    flat = lambda leaf: leaf.reshape(leaf.shape[0], math.prod(leaf.shape[1:]))
    return [column for leaf in jtu.tree_leaves(tree) for column in flat(leaf).T]


def taken(columns: list[jax.Array], index: jax.Array) -> list[jax.Array]:
    return [column[index] for column in columns]


def where(chosen: jax.Array, a: list[jax.Array], b: list[jax.Array]) -> list[jax.Array]:
    return [jax.lax.select(chosen, x, y) for x, y in zip(a, b, strict=True)]


def added(totals: list[jax.Array], more: list[jax.Array], active: jax.Array) -> list[jax.Array]:
    return [a + jnp.where(active, b, 0) for a, b in zip(totals, more, strict=True)]


def stacked(columns: list[jax.Array]) -> dict[str, jax.Array]:
    """One array for each type of number."""
    groups: dict[str, list[jax.Array]] = {}
    for column in columns:
        groups.setdefault(str(column.dtype), []).append(column)
    return {dtype: jnp.stack(group) for dtype, group in groups.items()}


def unstacked(stacks: dict[str, jax.Array], dtypes: list[Any]) -> list[jax.Array]:
    rows = {dtype: iter(stack) for dtype, stack in stacks.items()}
    return [next(rows[str(dtype)]) for dtype in dtypes]


def empty_table(layout: Layout, rows: int) -> dict[str, jax.Array]:
    """One array for each type of number, `(rows, columns)`; infinite where numbers can be."""
    counts: dict[str, int] = {}
    for shape, dtype in zip(layout.shapes, layout.dtypes, strict=True):
        counts[str(dtype)] = counts.get(str(dtype), 0) + int(np.prod(shape))
    unknown = lambda dtype: np.inf if jnp.issubdtype(dtype, jnp.floating) else 0
    return {dtype: jnp.full((rows, k), unknown(dtype), dtype) for dtype, k in counts.items()}


def written(
    table: dict[str, jax.Array], place: jax.Array, columns: list[jax.Array]
) -> dict[str, jax.Array]:
    """Numbers of each lane in a row of their own; none where `place` is behind the last one."""
    new = stacked(columns)
    return {dtype: x.at[place].set(new[dtype].T, mode="drop") for dtype, x in table.items()}


def read(table: dict[str, jax.Array], place: jax.Array, dtypes: list[Any]) -> list[jax.Array]:
    return unstacked({dtype: x[place].T for dtype, x in table.items()}, dtypes)
