"""A bead on a rotating hoop, with a stop that it hits."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import impact, MechanicalSystem
from ._problem import as_floating, integrate_with_resets, Problem


Vector: TypeAlias = Float[Array, "3"]
State: TypeAlias = tuple[Vector, Vector]


class RotatingHoopArgs(NamedTuple):
    """Parameters of `rotating_hoop`: radius of the hoop (m), its rate of rotation (rad/s), gravity (m/s^2), the
    angle of the stop (rad) and the coefficient of restitution."""

    radius: Any = 0.2
    rate: Any = 10.0
    gravity: Any = 9.81
    stop: Any = 1.3
    restitution: Any = 0.8


def _hoop(t: RealScalarLike, q: Vector, args: RotatingHoopArgs) -> Float[Array, "2"]:
    """The bead is on the sphere of the hoop, and in its plane."""
    turned = args.rate * t
    across = q[1] * jnp.cos(turned) - q[0] * jnp.sin(turned)
    return jnp.stack([0.5 * (q @ q - args.radius**2), across])


def _weight(t: RealScalarLike, q: Vector, v: Vector, args: RotatingHoopArgs) -> Vector:
    return jnp.zeros_like(q).at[2].set(-args.gravity)


def _gap(t: RealScalarLike, q: Vector, args: RotatingHoopArgs) -> FloatScalar:
    turned = args.rate * t
    outwards = q[0] * jnp.cos(turned) + q[1] * jnp.sin(turned)
    return args.stop - jnp.arctan2(outwards, -q[2])


def _restitution(args: RotatingHoopArgs) -> FloatScalar:
    return args.restitution


SYSTEM = MechanicalSystem(1.0, _hoop, _weight)
STOP = impact(SYSTEM, _gap, _restitution)


def _initial_state(args: RotatingHoopArgs, start: State) -> State:
    """Return the state at time 0 for the angle and the rate along the hoop in `start`."""
    q, v = start
    angle = jnp.arctan2(q[0], -q[2])
    sin, cos, zero = jnp.sin(angle), jnp.cos(angle), jnp.zeros_like(angle)
    along = (v[0] * cos + v[2] * sin) * args.radius / jnp.sqrt(q[0] ** 2 + q[2] ** 2)
    position = args.radius * jnp.stack([sin, zero, -cos])
    return position, jnp.stack([along * cos, args.radius * args.rate * sin, along * sin])


def _exact(t: np.ndarray, args: RotatingHoopArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the angle from the lowest point."""
    R, w, g, stop, e = (float(x) for x in args)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        return np.array([x[1], np.sin(x[0]) * (w**2 * np.cos(x[0]) - g / R)])

    q, v = y0
    angle = np.arctan2(q[0], -q[2])
    rate = (v[0] * np.cos(angle) + v[2] * np.sin(angle)) / R
    gap, bounce = lambda t, x: stop - x[0], lambda i, x: np.array([x[0], -e * x[1]])
    angle, rate = integrate_with_resets(field, [angle, rate], t, [gap], bounce).T
    sin, cos, zero = np.sin(angle), np.cos(angle), np.zeros_like(angle)
    outwards = np.stack([np.cos(w * t), np.sin(w * t), zero], axis=-1)
    across = np.stack([-np.sin(w * t), np.cos(w * t), zero], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    position = R * (sin[:, None] * outwards - cos[:, None] * up)
    velocity = R * rate[:, None] * (cos[:, None] * outwards + sin[:, None] * up)
    return position, velocity + R * w * sin[:, None] * across


def rotating_hoop(
    *,
    radius: Any = 0.2,
    rate: Any = 10.0,
    gravity: Any = 9.81,
    stop: Any = 1.3,
    restitution: Any = 0.8,
    angle: Any = 0.4,
    t1: float = 3.0,
) -> Problem:
    r"""A bead on a hoop that rotates about its vertical diameter and carries a stop, in Cartesian coordinates of
    the fixed frame, $q$ of shape `(3,)`, z upwards, mass one:

    $$q'' = (0, 0, -g) - J^T \lambda, \qquad \tfrac12 (|q|^2 - R^2) = 0, \quad
    q_2 \cos \omega t - q_1 \sin \omega t = 0.$$

    The bead hits the stop, at the angle `stop` from the lowest point, without friction: `resets` of the
    problem, an [`impact`][] whose gap moves with the hoop.

    With $\theta$ the angle of the bead from the lowest point, $\theta'' = \sin\theta\, (\omega^2 \cos\theta - g / R)$.
    For $\omega^2 R > g$ the bead is at rest in the hoop at $\cos\theta = g / (\omega^2 R)$. The energy is not
    conserved, as the hoop is driven, but the Jacobi integral is, between impacts,

    $$h = \tfrac12 |q'|^2 + g q_3 - \omega (q_1 q_2' - q_2 q_1')
    = \tfrac12 R^2 \theta'^2 - \tfrac12 \omega^2 R^2 \sin^2\theta - g R \cos\theta.$$

    Hence the bead always comes back to the stop, with the speed that it left it with: before the k-th
    impact it is $e^{k-1}$ times that of the first.

    The solution is an independent integration of $\theta$ (SciPy's DOP853), restarted at impacts; to about 1e-11.

    **Arguments:**

    - `radius` R (m), `rate` $\omega$ (rad/s), `gravity` g (m/s^2), `stop` (rad, between 0 and $\pi$) and `restitution`:
        scalars, `args`. `with_args` keeps the angle and its rate.
    - `angle`: of the bead at the start, at rest in the hoop (rad).
    - `t1`: the end of the time span (s).

    Sources: Goldstein, Poole & Safko, Classical Mechanics (2002), exercise 2.18; Kibble & Berkshire, Classical
    Mechanics (2004), section 10.4.
    """
    angle = as_floating(angle)
    lowest = jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), -jnp.cos(angle)])
    return Problem(
        "rotating-hoop",
        system=SYSTEM,
        t1=t1,
        args=RotatingHoopArgs(radius, rate, gravity, stop, restitution),
        start=(lowest, jnp.zeros_like(lowest)),
        initial_state=_initial_state,
        resets=(STOP,),
        exact=_exact,
    )
