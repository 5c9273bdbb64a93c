"""The heavy top with its attitude as a unit quaternion: a singular mass matrix."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import MechanicalSystem
from .._multibody.rotations import rates_matrix
from ._problem import as_floating, integrate, Problem


Vector: TypeAlias = Float[Array, "4"]

# The axis 0.6 radian from the vertical.
TILTED = (math.cos(0.3), math.sin(0.3), 0.0, 0.0)

# The benchmark of the literature, its axis of symmetry e2 horizontal at first, for
# `heavy_top(**BENCHMARK)`; moments of inertia (0.234375, 0.46875, 0.234375) about the centre
# of mass. Source: Bruls, Cardona & Arnold, Mech. Mach. Theory 48 (2012) 121-137.
BENCHMARK = dict(
    mass=15.0,
    inertia=(15.234375, 0.46875, 15.234375),
    center=(0.0, 1.0, 0.0),
    gravity=9.81,
    orientation=(1.0, 0.0, 0.0, 0.0),
    spin=(0.0, 150.0, -4.61538),
    t1=2.0,
)
# Displacement of the centre of mass (m) and quaternion at its end, t = 2 s. By a method of
# second order with steps of 2e-6 s: 5 digits are right. Source: Kynema,
# tests/regression_tests/regression/verification/dynamic_heavy_top.cpp.
BENCHMARK_DISPLACEMENT = (-0.150416985652933, -1.724164450779749, -0.673023460701136)
BENCHMARK_QUATERNION = (
    0.122947275600560, -0.491079359219981, 0.350430794926147, -0.787986857972906,
)  # fmt: skip


class HeavyTopArgs(NamedTuple):
    """Parameters of `heavy_top`: mass (kg), principal moments of inertia about the fixed point (kg
    m^2), shape `(3,)`, centre of mass in the frame of the body (m), shape `(3,)`, and gravity (m/s^2)."""

    mass: Any
    inertia: Any
    center: Any
    gravity: Any


def _mass(q: Vector, args: HeavyTopArgs) -> Float[Array, "4 4"]:
    G = rates_matrix(q)
    return 4 * (G.T * args.inertia[None, :]) @ G


def _norm(t: RealScalarLike, q: Vector, args: HeavyTopArgs) -> FloatScalar:
    return jnp.sum(q * q) - 1


def _weight(q: Vector, args: HeavyTopArgs) -> FloatScalar:
    """Return the potential energy."""
    a, b, c, d = q[0], q[1], q[2], q[3]
    vertical = [2 * (b * d - a * c), 2 * (c * d + a * b), a**2 - b**2 - c**2 + d**2]
    return args.mass * args.gravity * jnp.sum(jnp.stack(vertical) * args.center)


def _force(t: RealScalarLike, q: Vector, v: Vector, args: HeavyTopArgs) -> Vector:
    """Return the force of the Lagrangian `(2 G(q) v).I (2 G(q) v) / 2 - V(q)`, with `G(q) v = -G(v) q`."""
    gyroscopic = -8 * rates_matrix(v).T @ (args.inertia * (rates_matrix(q) @ v))
    return gyroscopic - jax.grad(_weight)(q, args)


def _exact(t: np.ndarray, args: HeavyTopArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate Euler's equations and the kinematics of the quaternion, `p = (a, b, c, d)`,
    `I w' = (I w) x w + c x weight`, `2 p' = p w`."""
    I1, I2, I3 = args.inertia.tolist()
    load = (float(args.mass * args.gravity) * args.center).tolist()

    def field(t, x):
        numbers = x.tolist()
        a, b, c, d, w1, w2, w3 = numbers
        up1, up2, up3 = 2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d
        return (
            *_quaternion_rates(numbers),
            ((I2 - I3) * w2 * w3 - load[1] * up3 + load[2] * up2) / I1,
            ((I3 - I1) * w3 * w1 - load[2] * up1 + load[0] * up3) / I2,
            ((I1 - I2) * w1 * w2 - load[0] * up2 + load[1] * up1) / I3,
        )

    (a, b, c, d), v0 = y0
    spin = 2 * np.array([[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]) @ v0
    states = integrate(field, np.concatenate([y0[0], spin]), t)
    q = states[:, :4] / np.linalg.norm(states[:, :4], axis=1, keepdims=True)
    v = _quaternion_rates([*q.T, *states[:, 4:].T])
    return q, np.stack(v, axis=-1)


def _quaternion_rates(x: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """Return the product of quaternions `p w / 2` of `x = (p, w)`, numbers or arrays."""
    a, b, c, d, w1, w2, w3 = x
    return (
        0.5 * (-b * w1 - c * w2 - d * w3),
        0.5 * (a * w1 + c * w3 - d * w2),
        0.5 * (a * w2 + d * w1 - b * w3),
        0.5 * (a * w3 + b * w2 - c * w1),
    )


def heavy_top(
    *,
    mass: Any = 1.0,
    inertia: Any = (0.5, 0.5, 0.3),
    center: Any = (0.0, 0.0, 0.5),
    gravity: Any = 9.81,
    orientation: Any = TILTED,
    spin: Any = (0.0, 0.0, 12.0),
    t1: float = 5.0,
) -> Problem:
    r"""The heavy top about its fixed point, its attitude a unit quaternion.

    With the angular velocity $\omega = 2 G(q) q'$ in the frame of the body and the moments
    of inertia I about the fixed point:

    $$4 G^T I G\, q'' = Q - J^T \lambda, \quad
    Q = -8 G(q')^T I G(q) q' - \partial V / \partial q, \quad |q|^2 = 1,$$

    $V$ being the weight times the height of the centre of mass, z upwards. $q$ is scalar
    first and turns vectors of the body into space. The mass matrix has rank 3: it is the
    constraint that makes the accelerations unique. The state is `(q, v)`, each of shape
    `(4,)`; two constraints, position and velocity.

    The standard problem is a symmetric (Lagrange) top, released with its axis 0.6 radian from
    the vertical: it nutates between two heights, with cusps, while it precesses.

    The solution is an independent integration (SciPy's DOP853) of Euler's equations with the kinematics
    of the quaternion, for all moments of inertia and from every initial state on the manifold; to about
    1e-12 in the standard problem. Its height agrees with the elliptic function that it is.

    The benchmark of the literature is `heavy_top(**BENCHMARK)`, a top that spins at 150 rad/s,
    with 5 published digits at the end
    (`from manifold_jax.problems.heavy_top import BENCHMARK, BENCHMARK_QUATERNION`).

    **Arguments:**

    - `mass` (kg), `inertia` (kg m^2), `center` of mass in the frame of the body (m) and
        `gravity` (m/s^2): `args`. `with_args` keeps the initial state.
    - `orientation`: the quaternion at `t = 0`, shape `(4,)`; it is normalized.
    - `spin`: the angular velocity at `t = 0` in the frame of the body (rad/s), shape `(3,)`.
    - `t1`: the end of the time span (s).

    Sources: Goldstein, Classical Mechanics (2nd ed., 1980), section 5-7 (the top); Haug,
    Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), chapter 11 (equations of
    motion in Euler parameters).
    """
    q = as_floating(orientation)
    q = q / jnp.sqrt(jnp.sum(q * q))
    return Problem(
        "heavy-top",
        system=MechanicalSystem(_mass, _norm, _force),
        t1=t1,
        args=HeavyTopArgs(mass, as_floating(inertia), as_floating(center), gravity),
        start=(q, 0.5 * rates_matrix(q).T @ as_floating(spin)),
        exact=_exact,
    )
