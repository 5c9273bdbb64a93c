"""Small differential-algebraic equations from the literature, as flows on a manifold.

Each has an elementary solution.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._constraint.constraint import Constraint
from ._problem import as_floating, Problem


Vector: TypeAlias = Float[Array, "2"]
State: TypeAlias = tuple[Vector, Vector]

AREVALO_T0 = 1.0


def _jay2_field(t: RealScalarLike, y: Vector, args: None) -> Vector:
    y1, y2 = y[0], y[1]
    # the root of 2 y2 z^2 - 3 z + y1^2 = 0 that is 1 / y2 on the manifold
    z = (3 + jnp.sqrt(9 - 8 * y2 * y1**2)) / (4 * y2)
    return jnp.stack([y1 * y2**2 * z**2, y1**2 * y2**2 - 3 * y2**2 * z])


def _jay2_residual(t: RealScalarLike, y: Vector, args: None) -> FloatScalar:
    return y[0] ** 2 * y[1] - 1


def _jay2_exact(t: np.ndarray, args: None, y0: np.ndarray) -> np.ndarray:
    return np.stack([y0[0] * np.exp(t), y0[1] * np.exp(-2 * t)], axis=-1)


def jay2() -> Problem:
    r"""A problem of index 2 with the multiplier $z$,

    $$y_1' = y_1 y_2^2 z^2, \quad y_2' = y_1^2 y_2^2 - 3 y_2^2 z, \quad y_1^2 y_2 = 1,$$

    from `(1, 1)` at `t = 0` to `t = 1`. Exact solution `(e^t, e^-2t)`, `z = e^2t`; known from every
    initial state on the manifold. The state has shape `(2,)`; one constraint; no parameters.

    Differentiating the constraint gives `2 y2 z^2 - 3 z + y1^2 = 0` for `z`.

    !!! warning

        The root that is taken is `1 / y2` on the manifold, the other one `1 / (2 y2)`.
        They meet at `y1^2 y2 = 9/8`, beyond which the vector field is NaN.

    Source: L. Jay, Convergence of a class of Runge-Kutta methods for
    differential-algebraic systems of index 2, BIT 33 (1993) 137-150.
    """
    return Problem(
        "jay2",
        diffrax.ODETerm(_jay2_field),
        constraint=Constraint(_jay2_residual),
        t1=1.0,
        start=jnp.ones(2),
        exact=_jay2_exact,
    )


def _arevalo_field(t: RealScalarLike, y: State, args: None) -> State:
    q, v = y
    # the force is perpendicular to q, so that the multiplier is centripetal only
    multiplier = jnp.sum(v * v) / jnp.sum(q * q)
    return v, jnp.stack([2 * q[1], -2 * q[0]]) - multiplier * q


def _arevalo_residual(t: RealScalarLike, y: State, args: None) -> tuple[FloatScalar, FloatScalar]:
    q, v = y
    return jnp.sum(q * q) - 1, jnp.sum(q * v)


def _arevalo_exact(t: np.ndarray, args: None, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact solution. With `q = (sin p, cos p)` the motion is `p'' = 2`."""
    (x, y), (vx, vy) = y0
    elapsed = t - AREVALO_T0
    start, rate = np.arctan2(x, y), vx * y - vy * x
    p, dp = start + rate * elapsed + elapsed**2, rate + 2 * elapsed
    s, c = np.sin(p), np.cos(p)
    return np.stack([s, c], axis=-1), np.stack([dp * c, -dp * s], axis=-1)


def arevalo() -> Problem:
    r"""A particle on the unit circle, driven along it by a force (index 3):

    $$q'' = (2 q_2, -2 q_1) - \lambda q, \quad |q|^2 = 1, \quad q \cdot q' = 0,$$

    from `t = 1` to `t = 5`. Exact solution `q = (sin t^2, cos t^2)`, ever faster; known
    from every initial state on the manifold. The state is `(q, v)`, each of shape `(2,)`;
    two constraints, position and velocity; no parameters.

    Source: C. Arevalo & P. Lotstedt, Improving the accuracy of BDF methods for index 3
    differential-algebraic equations, BIT 35 (1995) 297-308.
    """
    s, c = math.sin(AREVALO_T0**2), math.cos(AREVALO_T0**2)
    q, v = (s, c), (2 * AREVALO_T0 * c, -2 * AREVALO_T0 * s)
    return Problem(
        "arevalo",
        diffrax.ODETerm(_arevalo_field),
        constraint=Constraint(_arevalo_residual),
        t0=AREVALO_T0,
        t1=5.0,
        start=(as_floating(q), as_floating(v)),
        exact=_arevalo_exact,
    )


class SkateArgs(NamedTuple):
    """Parameters of `skate`: the angle of the inclined plane (radian)."""

    slope: Any = 0.8


def _skate_field(t: RealScalarLike, y: State, args: SkateArgs) -> State:
    _, v = y
    s, c = jnp.sin(t), jnp.cos(t)
    gravity = jnp.sin(args.slope)
    # the force across the blade; from d/dt (v2 cos t - v1 sin t) = 0
    across = -(v[0] * c + v[1] * s) - gravity * s
    return v, jnp.stack([gravity + across * s, -across * c])


def _skate_residual(t: RealScalarLike, y: State, args: SkateArgs) -> FloatScalar:
    _, v = y
    return v[1] * jnp.cos(t) - v[0] * jnp.sin(t)


def _skate_initial_state(args: SkateArgs, start: State | None) -> State:
    if start is not None:
        return start
    return jnp.zeros(2, jnp.result_type(args.slope)), jnp.zeros(2, jnp.result_type(args.slope))


def _skate_exact(t: np.ndarray, args: SkateArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """The speed along the blade is `u0 + sin(slope) sin t`."""
    gravity = np.sin(args.slope)
    q0, v0 = y0
    s, c = np.sin(t), np.cos(t)
    speed = v0[0] + gravity * s
    x = q0[0] + v0[0] * s + gravity * s**2 / 2
    y = q0[1] + v0[0] * (1 - c) + gravity * (t - s * c) / 2
    return np.stack([x, y], axis=-1), np.stack([speed * c, speed * s], axis=-1)


def skate(*, slope: Any = 0.8) -> Problem:
    r"""A skate (knife edge) on an inclined plane, turning at unit rate.

    It cannot slip sideways, a nonholonomic constraint on the velocity that depends on time:

    $$q'' = (\sin\alpha + w \sin t, -w \cos t), \quad q_2' \cos t - q_1' \sin t = 0,$$

    with $q_1$ downhill and $w$ the force across the blade (mass and gravity one). From rest at the
    origin at `t = 0` to `t = 10`. Exact solution `q = sin(alpha)/2 (sin^2 t, t - sin(2t)/2)`: it drifts
    sideways, not downhill; known from every initial state with its velocity along the blade.

    The state is `(q, v)`, each of shape `(2,)`; one constraint.

    **Arguments:**

    - `slope`: the angle $\alpha$ of the plane (radian), `args.slope`. Neither the initial
        state nor the constraint depends on it.

    Source: Neimark & Fufaev, Dynamics of Nonholonomic Systems, 1972.
    """
    return Problem(
        "skate",
        diffrax.ODETerm(_skate_field),
        constraint=Constraint(_skate_residual),
        t1=10.0,
        args=SkateArgs(slope),
        initial_state=_skate_initial_state,
        exact=_skate_exact,
    )
