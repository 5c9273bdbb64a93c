"""The equations `F(t, x, x', ..., args) = 0` as a function of vectors."""

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._base.user_functions import check_function
from .._constraint.checks import check_state


def number_names(tree: Any, alone: str) -> list[str]:
    """Return a name for each number in the order of `ravel_pytree`; `alone` names a single array."""
    return [name for leaf in leaf_names(tree, alone) for name in leaf[1]]


def leaf_names(tree: Any, alone: str) -> list[tuple[str, list[str]]]:
    """Return the names of each leaf, and of the numbers in it."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or alone
        if name[0].isdigit():
            name = f"{alone}.{name}"
        entries = [",".join(map(str, index)) for index in np.ndindex(np.shape(leaf))]
        found.append((name, [f"{name}[{entry}]" if entry else name for entry in entries]))
    return found


class EquationCombination(NamedTuple):
    """Replaces equation `row` by the sum of `weight * equation` over `parts`."""

    row: int
    parts: tuple[tuple[int, float], ...]


class ResidualEquations(eqx.Module):
    """`n` equations in `n` unknowns and their derivatives up to `order`."""

    function: Callable
    order: int = eqx.field(static=True)
    shapes: Any = eqx.field(static=True)  # of `x`, a hashable pytree of jax.ShapeDtypeStruct
    names: "Names" = eqx.field(static=True)
    combinations: tuple[EquationCombination, ...] = eqx.field(static=True, default=())

    @property
    def n(self) -> int:
        return len(self.names.unknowns)

    def unravel(self, x: Float[Array, " n"]) -> Any:
        leaves, structure = self.shapes
        sizes = [int(np.prod(leaf.shape)) for leaf in leaves]
        parts = [
            x[end - size : end].reshape(leaf.shape).astype(jnp.promote_types(leaf.dtype, x.dtype))
            for size, end, leaf in zip(sizes, itertools.accumulate(sizes), leaves, strict=True)
        ]
        return jtu.tree_unflatten(structure, parts)

    def __call__(self, t: Array, jets: tuple[Array, ...], args: Args) -> Float[Array, " n"]:
        """Evaluate the equations at the vectors `(x, x', ...)`."""
        residual = self.function(t, *(self.unravel(x) for x in jets[: self.order + 1]), args)
        values = jfu.ravel_pytree(residual)[0].astype(jets[0].dtype)
        for row, parts in self.combinations:
            total = functools.reduce(operator.add, [w * values[i : i + 1] for i, w in parts])
            values = jnp.concatenate([values[:row], total, values[row + 1 :]])
        return values

    def combined(self, combination: EquationCombination) -> "ResidualEquations":
        every = (*self.combinations, combination)
        names = self.names.combined(combination)
        return dataclasses.replace(self, names=names, combinations=every)

    @staticmethod
    def of(function: Callable, x: Any, args: Args, order: int) -> "ResidualEquations":
        _check_order(order)
        _check_function(function, order)
        check_state(x, "x_example")
        x = jtu.tree_map(jnp.asarray, x)
        leaves, structure = jtu.tree_flatten(x)
        if sum(leaf.size for leaf in leaves) == 0:
            raise ValueError("`x_example` has no numbers: there is nothing to solve for.")
        shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves), structure
        t = jnp.zeros((), jnp.result_type(*leaves))
        residual = eqx.filter_eval_shape(function, t, *[x] * (order + 1), args)
        _check_residual(residual, x)
        names = Names(tuple(number_names(residual, "F")), tuple(number_names(x, "x")))
        return ResidualEquations(function, order, shapes, names)


class Names(NamedTuple):
    """The names of the numbers that `F` returns and of those of `x`."""

    equations: tuple[str, ...]
    unknowns: tuple[str, ...]

    def derivative(self, unknown: int, order: int) -> str:
        return self.unknowns[unknown] + "'" * order

    def combined(self, combination: EquationCombination) -> "Names":
        text = ""
        for i, weight in combination.parts:
            size = "" if abs(weight) == 1 else f"{abs(weight):.3g} "
            sign = " - " if weight < 0 else " + " if text else ""
            text += (sign if text else sign.strip()) + size + self.equations[i]
        equations = [*self.equations]
        equations[combination.row] = text
        return Names(tuple(equations), self.unknowns)


def _check_order(order: Any) -> None:
    if not isinstance(order, int) or isinstance(order, bool) or not 1 <= order <= 3:
        raise ValueError(
            f"`order` must be 1, 2 or 3, the highest derivative of x among the arguments of `F`, got {order!r}. Write "
            "equations with higher ones for more unknowns: `x' - v = 0`."
        )


def _check_function(function: Any, order: int) -> None:
    derivatives = ", ".join(["x'", "x''", "x'''"][:order])
    call = f"F(t, x, {derivatives}, args)"
    advice = "Return what has to be zero, e.g. `lambda t, x, xdot, args: xdot - f(t, x, args)`."
    try:
        check_function("F", function, call, advice=advice)
    except TypeError as error:
        error.add_note(f"`order={order}`: F takes x and that many derivatives.")
        raise


def _check_residual(residual: Any, x: Any) -> None:
    for leaf in jtu.tree_leaves(residual):
        if not isinstance(leaf, jax.ShapeDtypeStruct) or not jnp.issubdtype(
            leaf.dtype, jnp.floating
        ):
            kind = getattr(leaf, "dtype", type(leaf).__name__)
            raise TypeError(
                f"`F` must return a pytree of real floating-point arrays, but has a leaf of type {kind}. Return "
                "e.g. `jnp.stack([F1, F2])`."
            )
    m, n = (sum(int(np.prod(leaf.shape)) for leaf in jtu.tree_leaves(x)) for x in (residual, x))
    if m != n:
        what = "Some unknowns are left undetermined" if m < n else "They cannot all hold"
        raise ValueError(
            f"`F` returned {m} equations for the {n} unknowns of `x_example`, which must be as many. {what}: add or "
            "remove equations, or give parameters through `args`."
        )
