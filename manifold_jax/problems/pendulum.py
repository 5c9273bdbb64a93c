"""The planar and the spherical pendulum in Cartesian coordinates."""

from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.core import Tracer
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, integrate, Problem


Vector: TypeAlias = Float[Array, " n"]  # two numbers, three for the spherical pendulum
State: TypeAlias = tuple[Vector, Vector]

# Coordinates of benchmark A01 at t = 0, 0.5, ..., 10: released at rest from (-1, 0) with
# g = 9.81, m = L = 1. All 6 printed digits are right. Source: IFToMM Technical Committee
# for Multibody Dynamics, Library of Computational Benchmark Problems, A01 (simple pendulum).
A01_X = (
    -1.0, -0.391049, 0.986292, 0.884132, -0.793566, -0.996334, 0.176652,
    0.999914, 0.577564, -0.963293, -0.942305, 0.665293, 0.999498, 0.0511945,
    -0.998619, -0.727459, 0.919858, 0.975626, -0.498374, -0.999992, -0.275087,
)  # fmt: skip
A01_Y = (
    0.0, -0.92037, -0.165011, -0.467237, -0.608484, -0.0855439, -0.984273,
    -0.013142, -0.816346, -0.268452, -0.334754, -0.746583, -0.0316965, -0.998689,
    -0.0525408, -0.686151, -0.392252, -0.21944, -0.866962, -0.00402112, -0.961419,
)  # fmt: skip


class PendulumArgs(NamedTuple):
    """Parameters of `pendulum` and `spherical_pendulum`: gravity (m/s^2), length (m), mass (kg)."""

    gravity: Any = 9.81
    length: Any = 1.0
    mass: Any = 1.0


def _mass(q: Vector, args: PendulumArgs) -> FloatScalar:
    return args.mass


def _rod(t: RealScalarLike, q: Vector, args: PendulumArgs) -> FloatScalar:
    return jnp.sum(q * q) - args.length**2


def _force(t: RealScalarLike, q: Vector, v: Vector, args: PendulumArgs) -> Vector:
    return jnp.stack([jnp.zeros_like(args.mass), -args.mass * args.gravity])


def _field(t: RealScalarLike, y: State, args: PendulumArgs) -> State:
    """The field of the system, written out; mass cancels."""
    q, v = y
    free = jnp.stack([jnp.zeros_like(args.gravity), -args.gravity])
    # q . a + v . v = 0, the second derivative of the constraint
    mu = (jnp.sum(q * free) + jnp.sum(v * v)) / jnp.sum(q * q)
    return v, free - mu * q


def _initial_state(args: PendulumArgs, start: State) -> State:
    """Return the position in `start` at the length of `args`, and its velocity."""
    q, v = start
    return q * (args.length / jnp.sqrt(jnp.sum(q * q))), v


def _exact(t: np.ndarray, args: PendulumArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    (x, y), (vx, vy) = y0
    L = float(args.length)
    theta = np.arctan2(x, -y)
    rate = (vx * np.cos(theta) + vy * np.sin(theta)) / L
    sin_half, cos_half, rate = swing(t, np.sqrt(float(args.gravity) / L), theta, rate)
    sin, cos = 2 * sin_half * cos_half, 1 - 2 * sin_half**2
    q = L * np.stack([sin, -cos], axis=-1)
    v = L * np.stack([rate * cos, rate * sin], axis=-1)
    return q, v


def swing(
    t: np.ndarray, frequency: float, theta: float, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve `theta'' = -frequency^2 sin(theta)` by Jacobi elliptic functions, with `theta` and `rate`
    at time 0: `sin(theta / 2)`, `cos(theta / 2)` and `theta'` at `t`."""
    # k^2 = (energy above the lowest point) / (2 m g L), at least 1 if it goes over the top
    k2 = (rate / (2 * frequency)) ** 2 + np.sin(theta / 2) ** 2
    k = np.sqrt(k2)
    if k2 < 1:
        # sin(theta / 2) = k sn, theta' = 2 frequency k cn. The phase through atan2 of both:
        # asin alone would lose half the digits at the turning points.
        phase = np.arctan2(2 * frequency * np.sin(theta / 2), rate)
        u = scipy.special.ellipkinc(phase, k2) + frequency * t
        sn, cn, dn, _ = scipy.special.ellipj(u, k2)
        return k * sn, dn, 2 * frequency * k * cn
    # theta / 2 = +-am
    sense = np.copysign(1.0, rate)
    u = scipy.special.ellipkinc(sense * theta / 2, 1 / k2) + frequency * k * t
    if not np.all(np.isfinite(u)):  # at rest in the upper equilibrium
        still = np.ones(t.size)
        return np.sin(theta / 2) * still, np.cos(theta / 2) * still, 0 * still
    sn, cn, dn, _ = scipy.special.ellipj(u, 1 / k2)
    return sense * sn, cn, sense * 2 * frequency * k * dn


def pendulum(
    *,
    gravity: Any = 9.81,
    length: Any = 1.0,
    mass: Any = 1.0,
    q0: Any = None,
    v0: Any = (0.0, 0.0),
    t1: float = 10.0,
) -> Problem:
    r"""The planar pendulum in Cartesian coordinates, $q = (x, y)$ with $y$ upwards:

    $$m q'' = (0, -m g) - 2 \lambda q, \quad |q|^2 = L^2, \quad q \cdot q' = 0.$$

    The state is `(q, v)`, each of shape `(2,)`; two constraints, position and velocity.
    The rod pushes with the force $-2 \lambda q$, $2 m^{-1} \lambda = (v \cdot v - g y) / L^2$.

    Exact solution by Jacobi elliptic functions from every initial state (swinging or going
    over the top), to about `1e-15 (1 + sqrt(g/L) t)` away from the separatrix.

    **Arguments:**

    - `gravity` (m/s^2), `length` (m), `mass` (kg): scalars, `args`.
    - `q0`: initial position (m), shape `(2,)`, by default `(length, 0)`. `with_args` moves
        it along its ray to the new length and keeps the velocity.
    - `v0`: initial velocity (m/s), shape `(2,)`, perpendicular to `q0`.
    - `t1`: the end of the time span (s).

    Two published cases:

    - IFToMM benchmark A01: `pendulum(q0=(-1.0, 0.0))`; its curve, 6 digits, is in this
        module (`from manifold_jax.problems.pendulum import A01_X, A01_Y`). The text of the
        benchmark starts at `x = +1` in one place, its data at `x = -1`: mirror images.
    - IVP test set: `pendulum(gravity=1.0, v0=(0.0, 1.0), t1=1.0)`. Of the 18 printed digits of the end
        values only 11 are right (`reference` does not use them). Its multiplier is twice $\lambda$.

    A known trap: the gravity with which a pendulum released from the horizontal returns
    after 2 s is `4 K(1/2)^2 = 13.750371636040745`; the value 13.7503716373294544 that is
    often printed is off by 9.4e-11 (relative).

    Sources: IFToMM Technical Committee for Multibody Dynamics, Library of Computational
    Benchmark Problems, A01; Mazzia & Magherini, Test Set for IVP Solvers.
    """
    length = as_floating(length)
    q0 = jnp.stack([length, jnp.zeros_like(length)]) if q0 is None else as_floating(q0)
    v0 = as_floating(v0)
    _check_start(q0, v0, length)
    return Problem(
        "pendulum",
        diffrax.ODETerm(_field),
        system=MechanicalSystem(_mass, _rod, _force),
        t1=t1,
        args=PendulumArgs(gravity, length, mass),
        start=(q0, v0),
        initial_state=_initial_state,
        exact=_exact,
    )


def _check_start(q0: Array, v0: Array, length: Array) -> None:
    if q0.shape != (2,) or v0.shape != (2,):
        raise ValueError(f"`q0` and `v0` must have shape (2,), got {q0.shape} and {v0.shape}.")
    if any(isinstance(x, Tracer) for x in (q0, v0, length)):
        return
    remedy = "For a start off the manifold use `pendulum().with_initial((q0, v0))`."
    distance, speed = np.hypot(*q0), np.hypot(*v0)
    # loose enough for data in single precision
    if not np.isclose(distance, length, rtol=1e-5):
        raise ValueError(
            f"`q0` must have the length {length} of the pendulum, not {distance}. {remedy}"
        )
    if abs(np.dot(q0, v0)) > 1e-5 * distance * speed:
        raise ValueError(f"`v0` must be perpendicular to `q0`, got {v0} and {q0}. {remedy}")


def _spherical_force(t: RealScalarLike, q: Vector, v: Vector, args: PendulumArgs) -> Vector:
    zero = jnp.zeros_like(args.mass)
    return jnp.stack([zero, zero, -args.mass * args.gravity])


def _spherical_exact(t: np.ndarray, args: PendulumArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate Newton's equations (angles on the sphere are singular at its poles):

    q'' = (0, 0, -g) - (|v|^2 - g z) q / |q|^2.
    """
    L, g = float(args.length), float(args.gravity)

    def field(t, x):
        x1, x2, x3, v1, v2, v3 = x.tolist()
        pull = (v1 * v1 + v2 * v2 + v3 * v3 - g * x3) / (x1 * x1 + x2 * x2 + x3 * x3)
        return v1, v2, v3, -pull * x1, -pull * x2, -g - pull * x3

    q, v = np.split(integrate(field, np.concatenate(y0), t), 2, axis=1)
    q *= L / np.linalg.norm(q, axis=1, keepdims=True)
    return q, v - q * (np.sum(q * v, axis=1, keepdims=True) / L**2)


def spherical_pendulum(
    *, gravity: Any = 9.81, length: Any = 1.0, mass: Any = 1.0, t1: float = 10.0
) -> Problem:
    r"""The spherical pendulum, a point mass on a sphere, with z upwards:

    $$m q'' = (0, 0, -m g) - 2 \lambda q, \quad |q|^2 = L^2, \quad q \cdot q' = 0.$$

    The state is `(q, v)`, each of shape `(3,)`; two constraints, position and velocity. From
    `q = L (0.8, 0, -0.6)` with `v = (0, 2, 0)` m/s: the pendulum swings between two heights
    while it turns about the vertical.

    Energy and the vertical angular momentum are conserved but not enforced. The solution is
    an independent integration (SciPy's DOP853) of Newton's equations with the pull of the
    rod eliminated, put on the sphere; to about 1e-12 from every initial state on the
    manifold. It agrees with the elliptic functions that height and azimuth are.

    **Arguments:**

    - `gravity` (m/s^2), `length` (m), `mass` (kg): scalars, `args`. `with_args` moves the initial
        position, also one of yours, along its ray to the new length and keeps the velocity.
    - `t1`: the end of the time span (s).

    Source: Whittaker, A Treatise on the Analytical Dynamics of Particles and Rigid Bodies
    (4th ed., 1937), chapter IV.
    """
    return Problem(
        "spherical-pendulum",
        system=MechanicalSystem(_mass, _rod, _spherical_force),
        t1=t1,
        args=PendulumArgs(gravity, length, mass),
        start=(as_floating([0.8, 0.0, -0.6]), as_floating([0.0, 2.0, 0.0])),
        initial_state=_initial_state,
        exact=_spherical_exact,
    )
