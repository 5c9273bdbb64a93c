"""An array that every lane has one of, as separate numbers or as a whole."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


class Node:
    """An operation on numbers that is not yet given to XLA: once it is, `array` is its result. How
    often it is used, and how many operations a copy of it would repeat."""

    __slots__ = ("array", "copied", "dtype", "operands", "params", "primitive", "uses")

    def __init__(self, primitive: Any, params: dict[str, Any], dtype: Any, operands: tuple):
        self.primitive, self.params, self.dtype = primitive, params, np.dtype(dtype)
        self.operands, self.array, self.uses, self.copied = operands, None, 0, 0
        for x in operands:
            if isinstance(x, Node):
                x.uses += 1


# A constant that is the same in every lane and known while tracing (`np.generic`), a number that is
# the same in every lane (an array of shape ()), one for each lane (an array of shape (lanes,)), or
# one that is still to be computed.
Number = Any


class Value:
    """An array of shape `shape` in each lane. `numbers()` is an object array of that shape of
    [`Number`][]s;
    `whole(lanes)` an array of shape `(*shape, count)`: the lanes are contiguous in memory.

    Whichever is not there is made when it is asked for.
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any, make: Callable[[], np.ndarray]):
        self.shape, self.dtype = tuple(shape), dtype
        self._make, self._numbers, self._whole = make, None, None

    @staticmethod
    def of_numbers(numbers: np.ndarray, dtype: Any) -> "Value":
        return Value(numbers.shape, dtype, lambda: numbers)

    @staticmethod
    def of_constant(x: Any) -> "Value":
        """The same in every lane: an array, also one that is being traced."""
        if isinstance(x, jax.core.Tracer | jax.Array) and not _is_known(x):
            return Value(x.shape, x.dtype, lambda: _split(x, x.shape))
        x = np.asarray(x)
        return Value(x.shape, x.dtype, lambda: _known_numbers(x))

    @staticmethod
    def of_whole(x: jax.Array) -> "Value":
        """Make a value from one array whose last axis is that of the lanes."""
        value = Value(x.shape[:-1], x.dtype, lambda: _split(x, x.shape[:-1]))
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
        """One array of all lanes for each number."""
        return [lanes.array(x, self.dtype) for x in self.numbers().ravel()]

    def entering(self, lanes: Any) -> "Value":
        """Return the value for the body of a loop, in which nothing may be made that is kept
        outside."""
        numbers = [lanes.emitted(x) for x in self.numbers().ravel()]
        value = Value.of_numbers(object_array(numbers, self.shape), self.dtype)
        value._whole = self._whole
        return value

    @property
    def is_known(self) -> bool:
        """Whether it is a constant, of which all can be computed while tracing."""
        return all(isinstance(x, np.generic) for x in self.numbers().flat)

    def known(self) -> np.ndarray:
        return np.array([x for x in self.numbers().flat], self.dtype).reshape(self.shape)


def object_array(items: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Return an object array of objects that are arrays themselves, which NumPy would look into."""
    out = np.empty(len(items), object)
    for i, item in enumerate(items):
        out[i] = item
    return out.reshape(shape)


def _split(x: jax.Array, shape: tuple[int, ...]) -> np.ndarray:
    return object_array([x[index] for index in np.ndindex(*shape)], shape)


def _known_numbers(x: np.ndarray) -> np.ndarray:
    return object_array([x[index] for index in np.ndindex(*x.shape)], x.shape)


def _is_known(x: Any) -> bool:
    return isinstance(x, jax.Array) and not isinstance(x, jax.core.Tracer)
