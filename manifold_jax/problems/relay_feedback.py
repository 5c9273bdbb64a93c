"""Relay feedback: the attitude of a satellite with thrusters that are on in one direction or the other."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import MechanicalSystem
from .._resets.reset import Reset
from ._problem import as_floating, Problem


Vector: TypeAlias = Float[Array, "2"]
State: TypeAlias = tuple[Vector, Vector, FloatScalar]


class RelayFeedbackArgs(NamedTuple):
    """Parameters of `relay_feedback`: moment of inertia (kg m^2), torque of the thrusters (N m), weight of the rate
    in the signal (s), and half of the width of the hysteresis (rad)."""

    inertia: Any = 100.0
    torque: Any = 5.0
    lead: Any = 1.8
    hysteresis: Any = 0.1


def _mass(q: Vector, args: RelayFeedbackArgs) -> FloatScalar:
    return args.inertia


def _direction(t: RealScalarLike, q: Vector, args: RelayFeedbackArgs) -> FloatScalar:
    return 0.5 * (q @ q - 1)


def _thrust(
    t: RealScalarLike, q: Vector, v: Vector, relay: FloatScalar, args: RelayFeedbackArgs
) -> Vector:
    return args.torque * relay * jnp.stack([-q[1], q[0]])


def _still(
    t: RealScalarLike, q: Vector, v: Vector, relay: FloatScalar, args: RelayFeedbackArgs
) -> FloatScalar:
    return jnp.zeros_like(relay)


def _signal(y: State, args: RelayFeedbackArgs) -> FloatScalar:
    q, v, _ = y
    return jnp.arctan2(q[1], q[0]) + args.lead * (q[0] * v[1] - q[1] * v[0])


def _threshold(t: RealScalarLike, y: State, args: RelayFeedbackArgs) -> FloatScalar:
    return y[2] * _signal(y, args) - args.hysteresis


def _switched(t: RealScalarLike, y: State, args: RelayFeedbackArgs) -> State:
    q, v, relay = y
    return q, v, -relay


SYSTEM = MechanicalSystem(_mass, _direction, _thrust, auxiliary=_still)
RELAY = Reset(_threshold, _switched, direction=True)


def _exact(t: np.ndarray, args: RelayFeedbackArgs, y0: Any) -> tuple[np.ndarray, ...]:
    """The angle is a parabola between switches, whose times are roots of quadratic equations."""
    if np.any(t < 0):
        raise ValueError("The solution with jumps is not known before the start.")
    inertia, torque, lead, width = (float(x) for x in args)
    q, v, relay = y0
    a, u = torque / inertia, float(relay)
    angle, rate, last = np.arctan2(q[1], q[0]), q[0] * v[1] - q[1] * v[0], 0.0
    pieces = [(last, angle, rate, u)]
    while last <= np.max(t, initial=0.0):
        # u times the signal is c + b s + a s^2 / 2 after the time s, and reaches the threshold.
        b, c = u * rate + lead * a, u * (angle + lead * rate) - width
        s = (np.sqrt(b**2 - 2 * a * c) - b) / a
        angle, rate = angle + rate * s + a * u * s**2 / 2, rate + a * u * s
        last, u = last + s, -u
        pieces.append((last, angle, rate, u))
    starts = np.array(pieces)
    start, angle, rate, u = starts[np.searchsorted(starts[:, 0], t, side="right") - 1].T
    s = t - start
    angle, rate = angle + rate * s + a * u * s**2 / 2, rate + a * u * s
    sin, cos = np.sin(angle), np.cos(angle)
    velocity = rate[:, None] * np.stack([-sin, cos], axis=-1)
    return np.stack([cos, sin], axis=-1), velocity, u


def relay_feedback(
    *,
    inertia: Any = 100.0,
    torque: Any = 5.0,
    lead: Any = 1.8,
    hysteresis: Any = 0.1,
    angle: Any = 0.5,
    rate: Any = 0.0,
    t1: float = 30.0,
) -> Problem:
    r"""Relay feedback with hysteresis, the attitude of a satellite whose thrusters turn it with one torque or its
    opposite. The direction in which it points is the unit vector $q = (\cos\varphi, \sin\varphi)$:

    $$I q'' = M u\, (-q_2, q_1) - \lambda q, \qquad \tfrac12 (|q|^2 - 1) = 0,$$

    with the output of the relay $u = \pm 1$ as auxiliary state: the state is $(q, v, u)$. The relay switches, `resets`
    of the problem, where the signal $\sigma = \varphi + k \varphi'$ has passed zero by the hysteresis h: from 1 to -1
    where $\sigma = h$, and from -1 to 1 where $\sigma = -h$.

    The attitude tends to a limit cycle. With $a = M / I$ its period is $4 h / (k a)$, the angle is zero at the switches, the
    rate there $\pm h / k$ and the largest angle $h^2 / (2 a k^2)$. From switch to switch distances from it change by
    the factor $-(a k^2 - h) / (a k^2 + h)$.

    Exact solution: a parabola from switch to switch.

    **Arguments:**

    - `inertia` I (kg m^2), `torque` M (N m), `lead` k (s) and `hysteresis` h (rad): positive scalars, `args`. `with_args`
        keeps the initial state.
    - `angle`, `rate`: at the start (rad, rad/s), with the thrusters against the signal.
    - `t1`: the end of the time span (s).

    Sources: Tsypkin, Relay Control Systems (1984); Astrom, Oscillations in systems with relay feedback, in
    Adaptive Control, Filtering, and Signal Processing, IMA vol. 74 (1995) 1-25, for period and stability of
    the limit cycle, here with a double integrator.
    """
    angle, rate = as_floating(angle), as_floating(rate)
    args = RelayFeedbackArgs(inertia, torque, lead, hysteresis)
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    relay = jnp.where(angle + lead * rate > 0, -1.0, 1.0).astype(angle.dtype)
    return Problem(
        "relay-feedback",
        system=SYSTEM,
        t1=t1,
        args=args,
        start=(jnp.stack([cos, sin]), rate * jnp.stack([-sin, cos]), relay),
        resets=(RELAY,),
        exact=_exact,
    )
