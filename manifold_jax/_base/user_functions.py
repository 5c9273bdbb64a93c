"""Functions given by users: checked, and evaluated once where they depend on `args` alone."""

import abc
import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.tree_util as jtu

from .types import Args


class AbstractOfArgs(eqx.Module):
    """A function of `args` alone, called by vector fields and constraints in every evaluation."""

    function: eqx.AbstractVar[Callable]

    @abc.abstractmethod
    def __call__(self, args: Args) -> Any:
        """Return the value, which depends on nothing else."""


@eqx.filter_jit
def call_traced_once(function: Callable, *args: Any) -> Any:
    """Return `function(*args)`. It is traced once, although a solve and its derivatives evaluate it in many
    places; XLA sees its operations in each."""
    return function(*args)


def evaluated(tree: Any, args: Args) -> Any:
    """Return `tree` with every [`AbstractOfArgs`][] in it replaced by its value at these `args`.
    Inside a loop it would be evaluated in every stage, correction and derivative.

    The value is closed over, and so is one input, however often the function occurs.
    """
    found: dict[Any, Callable] = {}

    def replaced(leaf: Any) -> Any:
        if not isinstance(leaf, AbstractOfArgs):
            return leaf
        key = type(leaf), id(leaf.function)
        if key not in found:
            value = dataclasses.replace(leaf, function=replaced(leaf.function))(args)
            found[key] = lambda args: value
        return found[key]

    return jtu.tree_map(replaced, tree, is_leaf=lambda leaf: isinstance(leaf, AbstractOfArgs))


def check_function(name: str, function: Any, call: str, *keywords: str, advice: str = "") -> None:
    """Refuse arguments that cannot be called like `call`, for example `g(t, y, args)`: with that many
    arguments, and `keywords` for a trailing `**kwargs`."""
    if not callable(function):
        advice = f" {advice}" if advice else ""
        raise TypeError(
            f"`{name}` must be a callable `{call}`, got {type(function).__name__}.{advice}"
        )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some that are not written in Python have no signature
        return
    arguments = call[call.index("(") + 1 : -1].removesuffix(", **kwargs").split(", ")
    try:
        signature.bind(*arguments, **dict.fromkeys(keywords))
    except TypeError as error:
        raise TypeError(
            f"`{name}` must be a callable `{call}`, got one with the arguments `{signature}`: {error}."
        ) from None
