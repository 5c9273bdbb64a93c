"""Checks of the numbers, vectors and names that users give."""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.types import Args, RealScalarLike
from .._base.user_functions import check_function


class AbstractBounded(eqx.Module):
    """A function `f(t, args)` whose values are known to lie within `bounds`."""

    @property
    @abc.abstractmethod
    def bounds(self) -> tuple[float, float]: ...

    @abc.abstractmethod
    def __call__(self, t: RealScalarLike, args: Args) -> Any: ...


class Values(eqx.Module):
    """The argument `word` of several joints or forces: numbers or arrays of one shape, or functions
    `f(t, args)` that return them."""

    word: str = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    given: tuple

    def __init__(
        self, word: str, names: tuple[str, ...], shape: tuple[int, ...], given: Sequence[Any]
    ):
        self.word, self.names, self.shape = word, names, shape
        for value, name in zip(given, names, strict=True):
            if callable(value):
                check_function(f"{word}` of `{name}", value, "f(t, args)")
        pairs = zip(given, names, strict=True)
        self.given = tuple(v if callable(v) else self._checked(v, name) for v, name in pairs)

    def at(self, t: RealScalarLike, args: Args) -> Array:
        """Return all values in one array `(k, *shape)`."""
        found = (value(t, args) if callable(value) else value for value in self.given)
        return stack(list(map(self._checked, found, self.names)))

    @property
    def bounds(self) -> np.ndarray:
        """The least and the largest of each of several numbers, `(2, k)`; NaN where they are not known."""
        return np.array([_bounds_of(value) for value in self.given]).T

    def _checked(self, value: Any, name: str) -> Array:
        return check_shape(f"{name}: `{self.word}`", value, self.shape)


def _bounds_of(value: Any) -> tuple[float, float]:
    if isinstance(value, AbstractBounded):
        return value.bounds
    if callable(value) or not is_concrete(value):
        return np.nan, np.nan
    return float(value), float(value)


def floating(value: Any) -> Array:
    """Return a floating-point array; concrete numbers are converted by NumPy, without a program."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return jnp.asarray(value, float)


def is_concrete(value: Any) -> bool:
    return not isinstance(value, jax.core.Tracer)


def on_host(value: Any) -> Any:
    """Return concrete arrays as NumPy arrays, which can be indexed without a program."""
    return np.asarray(value) if is_concrete(value) else value


def check_shape(what: str, value: Any, *shapes: tuple[int, ...], advice: str = "") -> Array:
    """Check for finite numbers of one of the shapes."""
    expected = " or ".join(f"of shape {shape}" if shape else "a number" for shape in shapes)
    try:
        array = floating(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be {expected}{advice}, got {value!r}.") from None
    if array.shape not in shapes:
        raise ValueError(f"{what} must be {expected}{advice}, got shape {array.shape}.")
    if is_concrete(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{what} must be finite, got {np.asarray(array)}.")
    return array


def stack(values: Sequence[Any], axis: int = 0) -> Array:
    """Stack into one array; concrete values without a program for each."""
    if all(is_concrete(value) for value in values):
        return jnp.asarray(np.stack([np.asarray(value) for value in values], axis))
    return jnp.stack([jnp.asarray(value) for value in values], axis)


def check_axis(what: str, value: Any) -> Array:
    axis = check_shape(what, value, (3,))
    if is_concrete(axis) and not np.linalg.norm(axis) > 0:
        raise ValueError(f"{what} is zero: an axis needs a direction.")
    return axis


def as_pair(what: str, value: Any) -> tuple[Any, Any]:
    """Return a pair of points or axes; also the two rows of an array."""
    is_array = isinstance(value, jax.Array | np.ndarray) and value.ndim == 2
    if not (isinstance(value, tuple | list) or is_array) or len(value) != 2:
        raise ValueError(f"{what}, got {value!r}.")
    return value[0], value[1]


def check_sequence(what: str, value: Any, kind: type, of: str) -> list[Any]:
    """Return a sequence of things of one kind, as a list."""
    try:
        things = list(value)
    except TypeError:
        raise TypeError(f"`{what}` must be a sequence of {of}, got {value!r}.") from None
    for thing in things:
        if not isinstance(thing, kind):
            raise TypeError(f"`{what}` must be a sequence of {of}, one is {thing!r}.")
    return things


def unique_names(what: str, names: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if not isinstance(name, str) or not name:
            raise ValueError(f"`name` of a {what} must be a string, got {name!r}.")
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"Every {what} needs its own name; there are several called {twice}.")
    return tuple(names)
