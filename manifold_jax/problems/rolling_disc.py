"""A disc that rolls on an inclined plane: constraints on velocities alone."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, Problem


Vector: TypeAlias = Float[Array, "4"]
State: TypeAlias = tuple[Vector, Vector]


class RollingDiscArgs(NamedTuple):
    """Parameters of `rolling_disc`: mass (kg), radius (m), moments of inertia about the axis
    and about a diameter (kg m^2), gravity (m/s^2), slope of the plane (radian)."""

    mass: Any = 1.0
    radius: Any = 0.5
    rolling_inertia: Any = 0.125
    steering_inertia: Any = 0.0625
    gravity: Any = 9.81
    slope: Any = 0.3


def _mass(q: Vector, args: RollingDiscArgs) -> Vector:
    return jnp.stack([args.mass, args.mass, args.steering_inertia, args.rolling_inertia])


def _no_slip(t: RealScalarLike, q: Vector, v: Vector, args: RollingDiscArgs) -> Float[Array, "2"]:
    speed = args.radius * v[3]
    return jnp.stack([v[0] - speed * jnp.cos(q[2]), v[1] - speed * jnp.sin(q[2])])


def _force(t: RealScalarLike, q: Vector, v: Vector, args: RollingDiscArgs) -> Vector:
    downhill = args.mass * args.gravity * jnp.sin(args.slope)
    return jnp.zeros_like(q).at[0].set(downhill)


def _initial_state(args: RollingDiscArgs, start: State) -> State:
    """Return the state for position and angular velocities in `start`, rolling without slipping."""
    q, v = start
    speed = args.radius * v[3]
    return q, jnp.stack([speed * jnp.cos(q[2]), speed * jnp.sin(q[2]), v[2], v[3]])


def _exact(t: np.ndarray, args: RollingDiscArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """The heading `h` turns at a constant rate and the speed is `u0 + k S`, `S` the integral of
    `cos h` over time and `k` the acceleration straight downhill; `S1` and `S2` are the
    integrals of `S` and `S sin h`."""
    R = float(args.radius)
    (x, y, heading0, roll), (_, _, turning, spin) = y0
    u0 = R * spin
    k = args.gravity * np.sin(args.slope) / (1 + args.rolling_inertia / (args.mass * R**2))

    def integrals(t):
        """Return the integrals of `cos h` and `sin h`; `turning` may be zero."""
        middle, chord = heading0 + turning * t / 2, t * np.sinc(turning * t / (2 * np.pi))
        return chord * np.cos(middle), chord * np.sin(middle)

    heading = heading0 + turning * t
    S, C = integrals(t)
    if abs(turning) * np.max(np.abs(t)) > 1:
        sin0, cos0 = np.sin(heading0), np.cos(heading0)
        S1 = (C - sin0 * t) / turning
        products = (np.sin(heading) * np.cos(heading) - sin0 * cos0) / turning
        S2 = ((t - products) / 2 - sin0 * C) / turning
    else:  # the formulas divide by `turning`: Gauss quadrature, exact to rounding here
        nodes, weights = np.polynomial.legendre.leggauss(16)
        s = np.multiply.outer(t, (1 + nodes) / 2)
        S1 = t / 2 * (integrals(s)[0] @ weights)
        S2 = t / 2 * ((integrals(s)[0] * np.sin(heading0 + turning * s)) @ weights)
    speed = u0 + k * S
    still = np.ones_like(t)
    q = [x + u0 * S + k * S**2 / 2, y + u0 * C + k * S2, heading, roll + (u0 * t + k * S1) / R]
    v = [speed * np.cos(heading), speed * np.sin(heading), turning * still, speed / R]
    return np.stack(q, axis=-1), np.stack(v, axis=-1)


def rolling_disc(
    *,
    mass: Any = 1.0,
    radius: Any = 0.5,
    rolling_inertia: Any = 0.125,
    steering_inertia: Any = 0.0625,
    gravity: Any = 9.81,
    slope: Any = 0.3,
    t1: float = 10.0,
) -> Problem:
    r"""An upright disc that rolls on an inclined plane without slipping (nonholonomic).

    $q = (x, y, \theta, \psi)$: the point of contact with x downhill, the heading and the
    angle of rolling:

    $$(m x'', m y'', I \theta'', J \psi'') = (m g \sin\alpha, 0, 0, 0) - A^T \lambda, \quad
    x' = R \psi' \cos\theta, \quad y' = R \psi' \sin\theta.$$

    The state is `(q, v)`, each of shape `(4,)`; two constraints, on velocities alone, with
    the constraint forces $-\lambda$ at the point of contact. From the origin with the
    heading 0.4, turning at 1.5 /s and rolling at 2 /s, to `t = 10`.

    Exact elementary solution from every initial state on the manifold, to rounding: the heading turns
    at a constant rate $\omega$, the speed is $u_0 + k (\sin\theta - \sin\theta_0) / \omega$,
    $k = m g \sin\alpha / (m + J / R^2)$, and the disc drifts sideways, not downhill.

    **Arguments:**

    - `mass` m (kg), `radius` R (m), `rolling_inertia` J and `steering_inertia` I (kg m^2, by
        default those of a homogeneous disc), `gravity` g (m/s^2), `slope` $\alpha$
        (radian): scalars, `args`. `with_args` keeps the initial position and the two
        angular velocities, also those of an initial state of yours.
    - `t1`: the end of the time span (s).

    Source: Bloch, Nonholonomic Mechanics and Control (2003), section 1.4; gravity on the
    inclined plane adds the second integral, elementary as the heading is linear in time.
    """
    return Problem(
        "rolling-disc",
        system=MechanicalSystem(_mass, None, _force, velocity_constraint=_no_slip),
        t1=t1,
        args=RollingDiscArgs(mass, radius, rolling_inertia, steering_inertia, gravity, slope),
        start=(as_floating([0.0, 0.0, 0.4, 0.0]), as_floating([0.0, 0.0, 1.5, 2.0])),
        initial_state=_initial_state,
        exact=_exact,
    )
