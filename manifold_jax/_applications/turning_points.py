"""Turning points of a curve in one coordinate: found between the steps, then located."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.closure import convert_closure
from .._base.types import FloatScalar, IntScalar
from .._linalg.newton import root_of_step, without_derivative
from .following import Curve, Nodes


class Turns(NamedTuple):
    """Turning points. Those that do not fit into the arrays are only counted."""

    count: IntScalar
    found: Bool[Array, " turns"]
    s: Float[Array, " turns"]
    x: Float[Array, "turns k"]


def find_turns(
    curve: Curve,
    path: dfx.AbstractPath,
    nodes: Nodes,
    used: IntScalar,
    component: int,
    size: int,
) -> Turns:
    """Find the sign changes of one tangent component along `path`, between the first `used` nodes.

    All of `path` is on the curve to round-off, so the point at which the component vanishes is the
    turning point to round-off, whatever the error of its arclength. The derivative is that of one step
    of Newton's method there.
    """
    slopes = nodes.tangent[:, component]
    # The last sign beyond rounding errors, e.g. where the trace starts at a fold.
    clear = jnp.abs(slopes) > 100 * jnp.finfo(slopes.dtype).eps
    signs = jax.lax.associative_scan(
        lambda last, new: jnp.where(new == 0, last, new), jnp.where(clear, jnp.sign(slopes), 0)
    )
    turned = (signs[:-1] * signs[1:] < 0) & (jnp.arange(1, slopes.size) < used)
    (before,) = jnp.nonzero(turned, size=size, fill_value=0)
    count = jnp.sum(turned)
    found = jnp.arange(size) < count

    def slope(curve: Curve, path: dfx.AbstractPath, s: FloatScalar) -> FloatScalar:
        return curve.tangent(path.evaluate(s))[component]

    def locate(step, found):
        ends = tuple(jnp.where(found, nodes.s[step + i], 0) for i in range(2))
        fixed = without_derivative((curve, path))
        root = _bracketed_root(lambda s: slope(*fixed, s), ends, (slopes[step], slopes[step + 1]))  # pyright: ignore[reportArgumentType, reportCallIssue]

        def newton(s):
            at = lambda s: slope(curve, path, s)
            value, rate = jax.jvp(at, (s,), (jnp.ones_like(s),))
            return -jnp.where(found, value / jnp.where(found, rate, 1), 0)

        root = jax.lax.stop_gradient(root)
        s = root_of_step(convert_closure(newton, root), root)
        return s, path.evaluate(s)

    return Turns(count, found, *jax.vmap(locate)(before, found))


def _bracketed_root(
    function: Callable[[FloatScalar], FloatScalar],
    ends: tuple[FloatScalar, FloatScalar],
    values: tuple[FloatScalar, FloatScalar],
) -> FloatScalar:
    """Find a root between two ends at which the signs differ, by a regula falsi of order 1.7.

    Source: Anderson & Bjorck, BIT 13 (1973) 253-264.
    """

    def advance(_, state):
        (a, b), (fa, fb) = state
        c = b - fb * (b - a) / jnp.where(fb == fa, 1, fb - fa)
        fc = function(c)
        crossed = fc * fb < 0
        weight = 1 - fc / jnp.where(fb == 0, 1, fb)
        kept = fa * jnp.where(weight > 0, weight, 0.5)
        return (jnp.where(crossed, b, a), c), (jnp.where(crossed, fb, kept), fc)

    return jax.lax.fori_loop(0, 12, advance, (ends, values))[0][1]
