"""Numbers, and functions `f(t, args)` of the time and the `args` of the solve."""

from typing import Any

from jaxtyping import Array

from .._custom_types import Args, RealScalarLike
from .._user_function import check_function
from .checks import check_shape, stack


def check_value(word: str, value: Any, name: str, shape: tuple[int, ...]) -> Any:
    """That of the argument `word` of the thing called `name`."""
    if callable(value):
        check_function(f"{word}` of `{name}", value, "f(t, args)")
        return value
    return check_shape(f"{name}: `{word}`", value, shape)


def evaluate(
    word: str,
    values: tuple,
    t: RealScalarLike,
    args: Args,
    shape: tuple[int, ...],
    names: tuple[str, ...],
) -> Array:
    """All in one array `(k, *shape)`."""
    pairs = zip(values, names, strict=True)
    given = ((value(t, args) if callable(value) else value, name) for value, name in pairs)
    return stack([check_shape(f"{name}: `{word}`", value, shape) for value, name in given])
