"""Derivatives of the equations with respect to time along a solution."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args


def total_derivatives(
    function: Any, t: Array, jets: tuple[Array, ...], args: Args, order: int
) -> list[Float[Array, " n"]]:
    """`F, dF/dt, ..., d^order F/dt^order` of `F(t, (x, x', ...), args)` where the derivatives of
    `x` are `jets`, as many of them as that takes.

    By nested forward mode: one level more costs two to three times as much to trace, which for the
    few levels met here is less than Taylor mode takes, and works for every primitive.
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
