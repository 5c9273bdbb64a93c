"""Arrays that every lane has its own values of, as separate numbers or as a whole."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .trace import example


class Node:
    """An operation on numbers that has not been given to XLA yet; `array` is its result once it
    has. `uses` counts how often it is used, `copied` the operations that a copy of it would repeat."""

    __slots__ = ("array", "copied", "dtype", "operands", "params", "primitive", "uses")

    def __init__(self, primitive: Any, params: dict[str, Any], dtype: Any, operands: tuple):
        self.primitive, self.params, self.dtype = primitive, params, np.dtype(dtype)
        self.operands, self.array, self.uses, self.copied = operands, None, 0, 0
        for x in operands:
            if isinstance(x, Node):
                x.uses += 1


# One number in every lane: a constant that is known while tracing (`np.generic`), a number that is
# the same in every lane (an array of shape ()), one for each lane (an array of shape (lanes,)), or
# one still to be computed (`Node`).
Number = Any


class LaneValue:
    """An array of shape `shape` in each lane, in two forms. `numbers()` is an object array of that
    shape of [`Number`][]s; `whole(lanes)` an array of shape `(*shape, count)`: the lanes are
    contiguous in memory.

    The missing form is computed lazily.
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any, make: Callable[[], np.ndarray]):
        self.shape, self.dtype = tuple(shape), dtype
        self._make, self._numbers, self._whole = make, None, None

    @staticmethod
    def of_numbers(numbers: np.ndarray, dtype: Any) -> "LaneValue":
        return LaneValue(numbers.shape, dtype, lambda: numbers)

    @staticmethod
    def of_constant(x: Any) -> "LaneValue":
        """Make a value that is the same in every lane from an array, which may be traced."""
        x = x if isinstance(x, jax.core.Tracer) else np.asarray(x)
        return LaneValue(x.shape, x.dtype, lambda: _split(x, x.shape))

    @staticmethod
    def of_column(x: jax.Array) -> "LaneValue":
        """Make a value from one number of each lane."""
        return LaneValue.of_numbers(object_array([x], ()), x.dtype)

    @staticmethod
    def of_whole(x: jax.Array) -> "LaneValue":
        """Make a value from one array whose last axis is that of the lanes."""
        value = LaneValue(x.shape[:-1], x.dtype, lambda: _split(x, x.shape[:-1]))
        value._whole = x
        return value

    def numbers(self) -> np.ndarray:
        if self._numbers is None:
            self._numbers = self._make()
        return self._numbers

    def whole(self, lanes: Any) -> jax.Array:
        if self._whole is None:
            columns = self.columns(lanes)
            if not columns:
                return jnp.zeros((*self.shape, lanes.count), self.dtype)
            self._whole = jnp.stack(columns).reshape(*self.shape, lanes.count)
        return self._whole

    def columns(self, lanes: Any) -> list[jax.Array]:
        """Return one array of shape `(count,)` for each number."""
        return [lanes.array(x, self.dtype) for x in self.numbers().ravel()]

    def entering(self, lanes: Any) -> "LaneValue":
        """Return the value for the body of a loop. All operations on it are done before: results
        made inside are not known outside."""
        numbers = [lanes.emitted(x) for x in self.numbers().ravel()]
        value = LaneValue.of_numbers(object_array(numbers, self.shape), self.dtype)
        value._whole = self._whole
        return value

    @property
    def is_known(self) -> bool:
        """Whether all its numbers are constants known while tracing."""
        return all(isinstance(x, np.generic) for x in self.numbers().flat)

    def known(self) -> np.ndarray:
        return np.array(list(self.numbers().flat), self.dtype).reshape(self.shape)


def object_array(items: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Return an object array of arrays, which NumPy would otherwise convert."""
    out = np.empty(len(items), object)
    for i, item in enumerate(items):
        out[i] = item
    return out.reshape(shape)


def _split(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    return object_array([x[index] for index in np.ndindex(*shape)], shape)


class ColumnLayout(NamedTuple):
    """The structure of a tree that is stored as columns."""

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[np.dtype, ...]

    @staticmethod
    def of(tree: Any) -> "ColumnLayout":
        """Return the layout of a tree of [`LaneValue`][]s, or of arrays of one trajectory."""
        leaves, treedef = jtu.tree_flatten(tree)
        dtypes = (np.dtype(x.dtype) for x in leaves)
        return ColumnLayout(treedef, tuple(x.shape for x in leaves), tuple(dtypes))

    @staticmethod
    def of_one(tree: Any) -> "ColumnLayout":
        """Return the layout of one trajectory of arrays with the trajectories in front."""
        return ColumnLayout.of(jtu.tree_map(lambda x: example(x.shape[1:], x.dtype), tree))

    def dtypes_of_columns(self) -> list[np.dtype]:
        each = zip(self.shapes, self.dtypes, strict=True)
        return [dtype for shape, dtype in each for _ in range(math.prod(shape))]

    def example(self) -> Any:
        """Return an example with which functions of one trajectory are traced."""
        return jtu.tree_unflatten(self.treedef, list(map(example, self.shapes, self.dtypes)))


class Columns(eqx.Module):
    """A tree as a list of columns: one array for each number, over all lanes or all trajectories."""

    columns: list[jax.Array]
    layout: ColumnLayout = eqx.field(static=True)

    @staticmethod
    def zeros(layout: ColumnLayout, count: int) -> "Columns":
        return Columns([jnp.zeros(count, dtype) for dtype in layout.dtypes_of_columns()], layout)

    @staticmethod
    def of_values(tree: Any, lanes: Any) -> "Columns":
        columns = [column for value in jtu.tree_leaves(tree) for column in value.columns(lanes)]
        return Columns(columns, ColumnLayout.of(tree))

    @staticmethod
    def of_arrays(tree: Any) -> "Columns":
        """Return the columns of arrays with the trajectories in front."""
        flat = lambda leaf: leaf.reshape(leaf.shape[0], math.prod(leaf.shape[1:]))
        columns = [column for leaf in jtu.tree_leaves(tree) for column in flat(leaf).T]
        return Columns(columns, ColumnLayout.of_one(tree))

    def values(self) -> Any:
        out, k = [], 0
        for shape, dtype in zip(self.layout.shapes, self.layout.dtypes, strict=True):
            numbers = object_array(self.columns[k : k + math.prod(shape)], shape)
            out.append(LaneValue.of_numbers(numbers, dtype))
            k += numbers.size
        return jtu.tree_unflatten(self.layout.treedef, out)

    def arrays(self) -> Any:
        """Return arrays with the trajectories in front."""
        rows = self.columns[0].shape[0] if self.columns else 0

        def array(value: LaneValue) -> jax.Array:
            numbers = list(value.numbers().flat)
            found = jnp.stack(numbers, axis=1) if numbers else jnp.zeros(0, value.dtype)
            return found.reshape(rows, *value.shape)

        return jtu.tree_map(array, self.values())


def where(chosen: jax.Array, a: Any, b: Any) -> Any:
    """Return the columns of trees `a` or `b`, lane by lane."""
    return jtu.tree_map(lambda x, y: jax.lax.select(chosen, x, y), a, b)
