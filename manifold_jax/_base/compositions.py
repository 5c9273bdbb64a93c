"""Compositions of a symmetric step of order 2 to symmetric steps of higher order."""

from collections.abc import Callable
from typing import Any, Literal, TypeAlias, TypeVar

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp


State = TypeVar("State")
Order: TypeAlias = Literal[2, 4, 6]

_SUZUKI = 1 / (4 - 4 ** (1 / 3))
# The lengths of the steps that make one. Sources: Suzuki, Phys. Lett. A 146 (1990) 319-323, and Kahan & Li,
# Math. Comp. 66 (1997) 1089-1099 (nine stages), as in Hairer, Lubich & Wanner (2006), section V.3.
_HALF = (0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.082213596293550800230)  # fmt: skip
COMPOSITIONS: dict[int, tuple[float, ...]] = {
    2: (1.0,),
    4: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI, _SUZUKI, _SUZUKI),
    6: (*_HALF, 1 - 2 * sum(_HALF), *_HALF[::-1]),
}


def check_order(order: Any) -> None:
    if order not in COMPOSITIONS:
        raise ValueError(f"`order` must be 2, 4 or 6, got {order!r}.")


def composed(
    advance: Callable[[State, Any], State], start: State, order: Order, dtype: Any
) -> State:
    """Make the steps of one step; `advance(state, fraction)` makes one of that fraction of its length."""
    fractions = jnp.asarray(COMPOSITIONS[order], dtype)
    if fractions.size == 1:
        return advance(start, fractions[0])
    # What is not an array, such as the structure of sparse constraints, is the same after each step.
    arrays, rest = eqx.partition(start, eqx.is_array)

    def body(arrays: Any, fraction: Any) -> tuple[Any, None]:
        end = advance(eqx.combine(arrays, rest), fraction)
        return eqx.filter(end, eqx.is_array), None

    return eqx.combine(lax.scan(body, arrays, fractions)[0], rest)
