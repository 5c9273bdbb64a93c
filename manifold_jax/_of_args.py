"""What functions need of the `args` of a solve alone, and what is therefore evaluated once in it."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.tree_util as jtu

from ._custom_types import Args


class AbstractOfArgs(eqx.Module):
    """A function of the args alone, called by vector fields and constraints in every evaluation."""

    function: eqx.AbstractVar[Callable]

    @abc.abstractmethod
    def __call__(self, args: Args) -> Any:
        """The same for the same args."""


def evaluated(tree: Any, args: Args) -> Any:
    """`tree` with every [`AbstractOfArgs`][] in it replaced by its value at these args. Inside a loop
    it would be part of every program that needs it: of stages, corrections and their derivatives.

    The value is closed over, and so is one input, however often the function is there.
    """
    found: dict[int, Callable] = {}

    def replaced(leaf: Any) -> Any:
        if not isinstance(leaf, AbstractOfArgs):
            return leaf
        if id(leaf.function) not in found:
            value = leaf(args)
            found[id(leaf.function)] = lambda args: value
        return found[id(leaf.function)]

    return jtu.tree_map(replaced, tree, is_leaf=lambda leaf: isinstance(leaf, AbstractOfArgs))
