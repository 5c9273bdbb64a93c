"""Total derivatives of a function, and gathers from vectors."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args


# Largest number of runs of consecutive indices for which slices are taken; more are gathered.
_MOST_STRETCHES = 16


def pick(source: Float[Array, " a"], index: np.ndarray) -> Float[Array, " n"]:
    """Return `source[index]`, zero where the index is negative. Runs of consecutive indices are sliced:
    the compiler can see through slices, and their derivative is not a slow scatter."""
    if len(index) == 0:
        return jnp.zeros((0,), source.dtype)
    steps = np.diff(index)
    joined = np.where(index[1:] < 0, index[:-1] < 0, (steps == 1) & (index[:-1] >= 0))
    starts = np.concatenate([[0], np.nonzero(~joined)[0] + 1, [len(index)]])
    if len(starts) - 1 > _MOST_STRETCHES:
        return jnp.concatenate([source, jnp.zeros((1,), source.dtype)])[index]
    parts = [
        source[index[a] : index[a] + b - a] if index[a] >= 0 else jnp.zeros(b - a, source.dtype)
        for a, b in itertools.pairwise(starts)
    ]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def total_derivatives(
    function: Any, t: Array, jets: tuple[Array, ...], args: Args, order: int
) -> list[Float[Array, " n"]]:
    """Return `F, dF/dt, ..., d^order F/dt^order` of `F(t, (x, x', ...), args)`, given the derivatives
    of `x`, `jets`, as many as that takes.

    By nested forward mode: one level more costs two to three times as much to trace, which for the few
    levels met here is less than Taylor mode takes, and works for every primitive.
    """

    def level(order: int, t: Array, jets: tuple[Array, ...]) -> list[Array]:
        if order == 0:
            return [function(t, jets, args)]
        below, rates = jax.jvp(
            lambda t, jets: level(order - 1, t, jets),
            (t, jets[:-1]),
            (jnp.ones_like(t), jets[1:]),
        )
        return [*below, rates[-1]]

    return level(order, t, jets)
