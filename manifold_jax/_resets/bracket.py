"""Roots of several functions of time at once, each in its own bracket."""

from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


_PROPORTION = 0.1  # kappa_1 (of the width of the first bracket), with kappa_2 = 2 and n_0 = 1
_MOST = 200


def root_in_bracket(
    function: Callable[[Float[Array, " m"]], Float[Array, " m"]],
    left: tuple[Float[Array, " m"], Float[Array, " m"]],
    right: tuple[Float[Array, " m"], Float[Array, " m"]],
    active: Bool[Array, " m"],
) -> Float[Array, " m"]:
    """Return where each component changes its sign, on the side of the right end, up to a few units of
    rounding. `left` and `right` are times and values, of opposite signs where `active`.

    The ITP method: never more than one evaluation more than bisection, which it is for functions
    with two values, and superlinear for smooth ones.

    Source: Oliveira & Takahashi, ACM Trans. Math. Softw. 47 (2021) 5.
    """
    (a, ya), (b, yb) = left, right
    flip = jnp.where(ya > 0, -1, 1).astype(ya.dtype)
    eps = 2 * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(a), jnp.abs(b))
    eps = jnp.maximum(eps, jnp.finfo(a.dtype).tiny)
    width = jnp.where(active, b - a, 2 * eps)
    most = jnp.ceil(jnp.log2(jnp.maximum(width / (2 * eps), 1))) + 1
    proportion = _PROPORTION / jnp.maximum(width, eps)

    def is_wide(state: tuple) -> Bool[Array, ""]:
        count, a, b, *_ = state
        return jnp.any(active & (b - a > 2 * eps)) & (count < _MOST)

    def narrowed(state: tuple) -> tuple:
        count, a, b, ya, yb = state
        middle = a + (b - a) / 2
        radius = eps * 2.0 ** (most - count.astype(a.dtype)) - (b - a) / 2
        radius = jnp.maximum(radius, 0)
        slope = jnp.where(yb == ya, 1, yb - ya)
        secant = (yb * a - ya * b) / slope
        secant = jnp.where((yb == ya) | ~jnp.isfinite(secant), middle, secant)
        side = jnp.sign(middle - secant)
        moved = jnp.minimum(proportion * (b - a) ** 2, jnp.abs(middle - secant))
        moved = jnp.maximum(moved, jnp.minimum(eps, jnp.abs(middle - secant)))
        truncated = secant + side * moved
        is_close = jnp.abs(truncated - middle) <= radius
        x = jnp.where(is_close, truncated, middle - side * radius)
        x = jnp.clip(x, a, b)
        y = flip * function(x)
        keep = active & (b - a > 2 * eps)
        is_right = y >= 0
        new_a, new_ya = jnp.where(is_right, a, x), jnp.where(is_right, ya, y)
        new_b, new_yb = jnp.where(is_right, x, b), jnp.where(is_right, y, yb)
        kept = lambda new, old: jnp.where(keep, new, old)
        return count + 1, kept(new_a, a), kept(new_b, b), kept(new_ya, ya), kept(new_yb, yb)

    start: Any = (jnp.zeros((), jnp.int32), a, b, flip * ya, flip * yb)
    return lax.while_loop(is_wide, narrowed, start)[2]
