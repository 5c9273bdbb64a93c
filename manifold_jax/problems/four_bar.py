"""A planar four-bar linkage: a closed loop of bodies."""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, integrate, Problem


Vector: TypeAlias = Float[Array, "9"]
State: TypeAlias = tuple[Vector, Vector]


class FourBarArgs(NamedTuple):
    """Parameters of `four_bar`: masses of crank, coupler and rocker (kg), shape `(3,)`, lengths of
    crank, coupler, rocker and ground (m), shape `(4,)`, and gravity (m/s^2)."""

    masses: Any
    lengths: Any
    gravity: Any


def _mass(q: Vector, args: FourBarArgs) -> Vector:
    inertia = args.masses * args.lengths[:3] ** 2 / 12
    return jnp.stack([args.masses, args.masses, inertia], axis=1).reshape(-1)


def _joints(t: RealScalarLike, q: Vector, args: FourBarArgs) -> Float[Array, "4 2"]:
    """Return the gaps at the pivot of the crank, the ends of the coupler, and the pivot of the rocker."""
    x, y, angle = q[0::3], q[1::3], q[2::3]
    centers = jnp.stack([x, y], axis=1)
    halves = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1) * (0.5 * args.lengths[:3, None])
    start, end = centers - halves, centers + halves
    pivot = jnp.stack([args.lengths[3], jnp.zeros_like(args.lengths[3])])
    return jnp.stack([start[0], end[0] - start[1], end[1] - end[2], start[2] - pivot])


def _force(t: RealScalarLike, q: Vector, v: Vector, args: FourBarArgs) -> Vector:
    zero = jnp.zeros_like(args.masses)
    return jnp.stack([zero, -args.masses * args.gravity, zero], axis=1).reshape(-1)


def _initial_state(args: FourBarArgs, start: State) -> State:
    """Return the state for crank angle and rate in `start` and its way to close the loop, with the
    lengths of `args`."""
    angle, rate = start[0][2::3], start[1][2]
    a, b, c, d = args.lengths[0], args.lengths[1], args.lengths[2], args.lengths[3]
    # from the end of the crank to the pivot of the rocker, and the triangle on that side
    x, y = d - a * jnp.cos(angle[0]), -a * jnp.sin(angle[0])
    distance2 = x**2 + y**2
    cosine = (distance2 + b**2 - c**2) / (2 * b * jnp.sqrt(distance2))
    side = jnp.sign(jnp.sin(angle[2] - angle[1]))
    coupler = jnp.arctan2(y, x) + side * jnp.arccos(cosine)
    rocker = jnp.arctan2(b * jnp.sin(coupler) - y, b * jnp.cos(coupler) - x)
    turns = jnp.round((angle[1:] - jnp.stack([coupler, rocker])) / (2 * math.pi))
    angles = jnp.stack([angle[0], coupler, rocker]).at[1:].add(2 * math.pi * turns)
    rates = rate * jnp.stack(_ratios(jnp, angles, args.lengths))
    return _bodies(jnp, angles, rates, args.lengths)


def _ratios(xp: ModuleType, angles: Any, lengths: Any) -> tuple[Any, Any, Any]:
    """Return the rates of the angles over that of the crank, in NumPy or JAX."""
    crank, coupler, rocker = angles[..., 0], angles[..., 1], angles[..., 2]
    sine = xp.sin(coupler - rocker)
    of_coupler = lengths[0] * xp.sin(rocker - crank) / (lengths[1] * sine)
    of_rocker = lengths[0] * xp.sin(coupler - crank) / (lengths[2] * sine)
    return xp.ones_like(sine), of_coupler, of_rocker


def _bodies(xp: ModuleType, angles: Any, rates: Any, lengths: Any) -> tuple[Any, Any]:
    """Return positions and velocities of the bodies, the last axis of both of length 9."""
    s, c = xp.sin(angles), xp.cos(angles)
    unit = xp.stack([c, s, -s * rates, c * rates])
    crank, coupler, rocker = (unit[..., i] * lengths[i] / 2 for i in range(3))
    pivot = xp.zeros_like(rocker[0]) + lengths[3]
    rocker = xp.stack([rocker[0] + pivot, rocker[1], rocker[2], rocker[3]])
    x, y, vx, vy = xp.stack([crank, 2 * crank + coupler, rocker], axis=-1)
    flat = lambda *parts: xp.stack(parts, axis=-1).reshape(*angles.shape[:-1], 9)
    return flat(x, y, angles), flat(vx, vy, rates)


def _exact(t: np.ndarray, args: FourBarArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the equation of motion of the crank's angle, `A(p) p'' + A'(p) p'^2 / 2 + V'(p) = 0`;
    the other two angles are integrated with it, so that they may turn, and closed by Newton."""
    lengths = args.lengths
    angles, rate = y0[0][2::3], y0[1][2]
    field = _crank_equation(args)
    states = integrate(field, np.append(angles, rate), t)
    angles, rate = states[:, :3], states[:, 3]
    a, b, c, d = lengths
    for _ in range(2):
        crank, coupler, rocker = angles.T
        x = a * np.cos(crank) + b * np.cos(coupler) - c * np.cos(rocker) - d
        y = a * np.sin(crank) + b * np.sin(coupler) - c * np.sin(rocker)
        sine = np.sin(coupler - rocker)
        angles[:, 1] += (x * np.cos(rocker) + y * np.sin(rocker)) / (b * sine)
        angles[:, 2] += (x * np.cos(coupler) + y * np.sin(coupler)) / (c * sine)
    rates = rate[:, None] * np.stack(_ratios(np, angles, lengths), axis=-1)
    return _bodies(np, angles, rates, lengths)


def _crank_equation(args: FourBarArgs) -> Callable[[float, np.ndarray], tuple[float, ...]]:
    """Return the equation of the three angles and the rate of the crank, on lists of floats (fast)."""
    a, b, c, _ = args.lengths.tolist()
    m1, m2, m3 = args.masses.tolist()
    g = float(args.gravity)
    inertia1, inertia2, inertia3 = (m1 / 3 + m2) * a**2, m2 * b**2 / 3, m3 * c**2 / 3
    coupling = m2 * a * b

    def field(t: float, state: np.ndarray) -> tuple[float, ...]:
        p1, p2, p3, rate = state.tolist()
        sine, cosine = math.sin(p2 - p3), math.cos(p2 - p3)
        r2 = a * math.sin(p3 - p1) / (b * sine)
        r3 = a * math.sin(p2 - p1) / (c * sine)
        # their derivatives by the crank's angle
        dr2 = (c * r3**2 - b * r2**2 * cosine - a * math.cos(p1 - p3)) / (b * sine)
        dr3 = (c * r3**2 * cosine - b * r2**2 - a * math.cos(p1 - p2)) / (c * sine)
        s12, c12 = math.sin(p1 - p2), math.cos(p1 - p2)
        A = inertia1 + inertia2 * r2**2 + inertia3 * r3**2 + coupling * r2 * c12
        half_dA = inertia2 * r2 * dr2 + inertia3 * r3 * dr3
        half_dA += 0.5 * coupling * (dr2 * c12 - r2 * (1 - r2) * s12)
        dV = (m1 / 2 + m2) * a * math.cos(p1) + m2 * b / 2 * math.cos(p2) * r2
        dV = g * (dV + m3 * c / 2 * math.cos(p3) * r3)
        return rate, r2 * rate, r3 * rate, -(half_dA * rate**2 + dV) / A

    return field


def four_bar(
    *,
    masses: Any = (1.0, 2.5, 2.0),
    lengths: Any = (1.0, 2.5, 2.0, 2.2),
    gravity: Any = 9.81,
    crank_angle: Any = 2.0,
    crank_rate: Any = 6.0,
    t1: float = 5.0,
) -> Problem:
    r"""A planar four-bar linkage of three moving bodies, a closed loop.

    $q = (x_1, y_1, \theta_1, \dots, x_3, y_3, \theta_3)$: the centres and angles of crank,
    coupler and rocker, uniform rods of length $l_i$ along $e_i = (\cos\theta_i, \sin\theta_i)$.
    With gravity and the masses $(m_i, m_i, m_i l_i^2 / 12)$, y upwards, four joints:

    $$r_1 - \tfrac{l_1}{2} e_1 = 0, \quad
    r_1 + \tfrac{l_1}{2} e_1 = r_2 - \tfrac{l_2}{2} e_2, \quad
    r_2 + \tfrac{l_2}{2} e_2 = r_3 + \tfrac{l_3}{2} e_3, \quad
    r_3 - \tfrac{l_3}{2} e_3 = (l_4, 0).$$

    The state is `(q, v)`, each of shape `(9,)`; 16 constraints, 8 positions and 8
    velocities, one degree of freedom. The standard linkage is a crank-rocker: the crank
    turns fully (the shortest and the longest link together are shorter than the others).

    The solution is an independent integration (SciPy's DOP853) of the equation of motion
    of the crank's angle, to about 1e-12, from every initial state on the manifold until
    coupler and rocker are in line: there the crank cannot move them.

    **Arguments:**

    - `masses` (kg) of crank, coupler and rocker, shape `(3,)`, `lengths` (m) of crank, coupler, rocker
        and ground, shape `(4,)`, `gravity` (m/s^2): `args`. `with_args` keeps the crank's angle and
        rate and the way the loop is closed, also those of an initial state of yours.
    - `crank_angle`, `crank_rate`: at `t = 0` (radian, radian/s), with the coupler and the
        rocker above the line from the crank's end to the rocker's pivot.
    - `t1`: the end of the time span (s).

    Source: the linkage is classical; coordinates as in Haug, Computer Aided Kinematics and
    Dynamics of Mechanical Systems (1989), chapter 3.
    """
    angles = jnp.stack([as_floating(crank_angle), jnp.asarray(0.0), jnp.asarray(math.pi / 2)])
    rates = jnp.stack([as_floating(crank_rate), jnp.asarray(0.0), jnp.asarray(0.0)])
    lengths = as_floating(lengths)
    return Problem(
        "four-bar",
        system=MechanicalSystem(_mass, _joints, _force),
        t1=t1,
        args=FourBarArgs(as_floating(masses), lengths, gravity),
        start=_bodies(jnp, angles, rates, lengths),
        initial_state=_initial_state,
        exact=_exact,
    )
