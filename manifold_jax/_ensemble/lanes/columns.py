"""Columns, one number of each lane or each trajectory, stacked and in tables."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._jaxpr.lane_value import Columns, Layout


def taken(tree: Any, index: jax.Array) -> Any:
    return jtu.tree_map(lambda x: x[index], tree)


def added(totals: Any, more: Any, active: jax.Array) -> Any:
    return jtu.tree_map(lambda a, b: a + jnp.where(active, b, 0), totals, more)


class Stacked(eqx.Module):
    """Columns as one array for each type of number; with further leading axes many of them."""

    arrays: dict[str, jax.Array]
    layout: Layout = eqx.field(static=True)

    @staticmethod
    def of(columns: Columns) -> "Stacked":
        groups: dict[str, list[jax.Array]] = {}
        for column in columns.columns:
            groups.setdefault(str(column.dtype), []).append(column)
        arrays = {dtype: jnp.stack(group) for dtype, group in groups.items()}
        return Stacked(arrays, columns.layout)

    def columns(self) -> Columns:
        rows = {dtype: iter(stack) for dtype, stack in self.arrays.items()}
        dtypes = self.layout.dtypes_of_columns()
        return Columns([next(rows[str(dtype)]) for dtype in dtypes], self.layout)


def unknown(dtype: Any) -> Any:
    """Return what stands where nothing was computed: infinity, where numbers can be infinite."""
    return np.inf if jnp.issubdtype(dtype, jnp.floating) else 0


def empty_table(layout: Layout, rows: int) -> Stacked:
    """A table of `rows` trees, each a row of the array of each type of number."""
    dtypes = [str(dtype) for dtype in layout.dtypes_of_columns()]
    full = lambda dtype: jnp.full((rows, dtypes.count(dtype)), unknown(dtype), dtype)
    return Stacked({dtype: full(dtype) for dtype in dict.fromkeys(dtypes)}, layout)


def written(table: Stacked, place: jax.Array, columns: Columns) -> Stacked:
    """Numbers of each lane in a row of their own; none where `place` is behind the last one."""
    write = lambda x, new: x.at[place].set(new.T, mode="drop")
    return Stacked(jtu.tree_map(write, table.arrays, Stacked.of(columns).arrays), table.layout)


def read(table: Stacked, place: jax.Array) -> Columns:
    return jtu.tree_map(lambda x: x[place].T, table).columns()
