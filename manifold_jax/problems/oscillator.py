"""The harmonic oscillator, on the circle of its energy."""

import math
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._constraint.constraint import Constraint
from ._problem import Problem


class OscillatorArgs(NamedTuple):
    """Parameters of `harmonic_oscillator`: the radius of the circle."""

    radius: Any = 1.0


def _field(t: RealScalarLike, y: Float[Array, "2"], args: OscillatorArgs) -> Float[Array, "2"]:
    return jnp.stack([y[1], -y[0]])


def _residual(t: RealScalarLike, y: Float[Array, "2"], args: OscillatorArgs) -> Float[Array, ""]:
    return jnp.sum(y * y) - args.radius**2


def _initial_state(args: OscillatorArgs, start: Float[Array, "2"] | None) -> Float[Array, "2"]:
    if start is not None:
        return start * (args.radius / jnp.sqrt(jnp.sum(start * start)))
    return jnp.stack([args.radius, jnp.zeros_like(args.radius)])


def _exact(t: np.ndarray, args: OscillatorArgs, y0: np.ndarray) -> np.ndarray:
    c, s = np.cos(t), np.sin(t)
    return np.stack([y0[0] * c + y0[1] * s, y0[1] * c - y0[0] * s], axis=-1)


def harmonic_oscillator(*, radius: Any = 1.0, t1: float = 2 * math.pi) -> Problem:
    r"""One period of the harmonic oscillator, whose energy confines it to a circle:

    $$x_1' = x_2, \quad x_2' = -x_1, \quad |x|^2 = r^2, \quad x(0) = (r, 0).$$

    The state is `x`, shape `(2,)`; one constraint. Exact solution
    `r (cos t, -sin t)`, clockwise; known from every initial state.

    !!! warning

        Not a problem for measuring orders. By symmetry the local error of many methods is
        normal to the circle to leading order, so projection raises their order (Euler:
        from 1 to 2).

    **Arguments:**

    - `radius`: of the circle, `args.radius`. `with_args` scales an initial state of
        yours along its ray to the new radius.
    - `t1`: the end of the time span, one period by default.

    Source: Example 2.1 of Sudarsan & Keerthi, Numerical approaches for solution of
    differential equations on manifolds, Appl. Math. Comput. 92 (1998) 153-193 (`r = 1`).
    """
    return Problem(
        "harmonic-oscillator",
        diffrax.ODETerm(_field),
        constraint=Constraint(_residual),
        t1=t1,
        args=OscillatorArgs(radius),
        initial_state=_initial_state,
        exact=_exact,
    )
