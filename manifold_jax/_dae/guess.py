"""A guess of a state, from what is known of the unknowns and their derivatives."""

from typing import Any, NamedTuple

import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.errors import listed
from .._base.types import Y
from .equations import leaf_names
from .layout import Gather, StateLayout
from .reduced import Reduced


class Guess(NamedTuple):
    """A guess of a state, part of which may be fixed. `zero` says for each number of `z` and of `w` whether
    no guess is given."""

    z: Float[Array, " states"]
    w: Float[Array, " n"]  # the leading derivatives
    fixed: tuple[bool, ...]  # for each number of `z`
    names: tuple[str, ...]  # of the unknowns that are fixed, as given
    zero: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(system: Reduced, x: Y, derivatives: Any, fixed: Any) -> "Guess":
        given = [_flat(system, x, "x_guess")]
        given += [_flat(system, dx, f"derivatives[{k}]") for k, dx in enumerate(derivatives)]
        layout, every = system.analysis.layout, jnp.concatenate(given)
        z, w = (
            _places_in_guess(layout, names, len(given))
            for names in (layout.names, layout.leading_names())
        )
        numbers, zero = (z(every, None), w(every, None)), (z.index < 0, w.index < 0)
        return Guess(*numbers, _fixed(system, x, fixed), tuple(fixed), zero)


def _places_in_guess(layout: StateLayout, names: np.ndarray, number: int) -> Gather:
    """Return where each of these numbers is in the `number` guesses of `x, x', ...`: under its own
    name, or as a derivative of another unknown of which it is an alias."""
    aliases, n = layout.aliases, len(layout.aliases.root)
    index, scale = [], []
    for k, unknown in names.tolist():
        level = k + aliases.shift[unknown] - aliases.shift
        (others,) = np.nonzero(
            (aliases.root == aliases.root[unknown]) & (level >= 0) & (level < number)
        )
        other = unknown if unknown in others else next(iter(others), unknown)
        index.append(level[other] * n + other if other in others else -1)
        scale.append(aliases.factor[unknown] / aliases.factor[other])
    return Gather(np.array(index, int), np.array(scale, float))


def _flat(system: Reduced, x: Y, name: str) -> Array:
    leaves, structure = system.equations.shapes
    x = jtu.tree_map(jnp.asarray, x)
    shapes = [leaf.shape for leaf in jtu.tree_leaves(x)]
    if jtu.tree_structure(x) != structure or shapes != [leaf.shape for leaf in leaves]:
        raise ValueError(
            f"`{name}` must be like `x_example`, {structure} of shapes {[leaf.shape for leaf in leaves]}; got "
            f"{jtu.tree_structure(x)} of shapes {shapes}."
        )
    floating = jtu.tree_map(
        lambda leaf, like: leaf.astype(like.dtype), jtu.tree_leaves(x), [*leaves]
    )
    return jfu.ravel_pytree(floating)[0]


def _fixed(system: Reduced, x: Y, fixed: Any) -> tuple[bool, ...]:
    if isinstance(fixed, str) or not all(isinstance(name, str) for name in fixed):
        raise TypeError(
            f"`fixed` must be a tuple of names, such as ('{system.equations.names.unknowns[0]}',), got {fixed!r}."
        )
    names = system.analysis.layout.names.tolist()
    states = [system.equations.names.derivative(unknown, k) for k, unknown in names]
    groups = dict(leaf_names(x, "x"))
    held = np.zeros(len(states), bool)
    for name in fixed:
        whole, primes = name.rstrip("'"), len(name) - len(name.rstrip("'"))
        numbers = [entry + "'" * primes for entry in groups.get(whole, [whole])]
        missing = [number for number in numbers if number not in states]
        if missing:
            raise ValueError(
                f"`fixed` names {listed(missing)}, not of the state, whose numbers are {listed(states, 20)}. What "
                "is not in the state follows from it."
            )
        held |= np.isin(states, numbers)
    return tuple(held.tolist())
