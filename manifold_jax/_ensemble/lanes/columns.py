"""Columns, one number of each lane or each trajectory, stacked into arrays and tables."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._jaxpr.lane_value import ColumnLayout, Columns


def taken(tree: Any, index: jax.Array) -> Any:
    return jtu.tree_map(lambda x: x[index], tree)


def added(totals: Any, more: Any, active: jax.Array) -> Any:
    return jtu.tree_map(lambda a, b: a + jnp.where(active, b, 0), totals, more)


class Stacked(eqx.Module):
    """Columns stacked into one array for each dtype; further leading axes hold many of them."""

    arrays: dict[str, jax.Array]
    layout: ColumnLayout = eqx.field(static=True)

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
    """Return the value of numbers that were not computed: infinity, or 0 if the dtype has none."""
    return np.inf if jnp.issubdtype(dtype, jnp.floating) else 0


def empty_table(layout: ColumnLayout, rows: int) -> Stacked:
    """Return a table of `rows` trees, one row of each array per tree."""
    dtypes = [str(dtype) for dtype in layout.dtypes_of_columns()]
    full = lambda dtype: jnp.full((rows, dtypes.count(dtype)), unknown(dtype), dtype)
    return Stacked({dtype: full(dtype) for dtype in dict.fromkeys(dtypes)}, layout)


def written(table: Stacked, place: jax.Array, columns: Columns) -> Stacked:
    """Write the numbers of each lane to the row `place`; none if that is beyond the last row."""
    write = lambda x, new: x.at[place].set(new.T, mode="drop")
    return Stacked(jtu.tree_map(write, table.arrays, Stacked.of(columns).arrays), table.layout)


def read(table: Stacked, place: jax.Array) -> Columns:
    return jtu.tree_map(lambda x: x[place].T, table).columns()
