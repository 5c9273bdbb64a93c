"""The compass gait: two straight legs that walk down a slope without a motor."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import MechanicalSystem
from .._resets.reset import Reset
from ._problem import as_floating, integrate_with_resets, Problem


Vector: TypeAlias = Float[Array, "4"]  # hip along and above the slope, angles of the two legs
State: TypeAlias = tuple[Vector, Vector]

# Angle and rate of the stance leg, then of the angle between the legs, after heel strike.
# Source: P. A. Bhounsule, passivewalker.m (2009), whose walker these parameters are.
FIXED_POINT = (0.200161072169750, -0.199906060087682, 0.400322144339512, -0.015805473227965)


class CompassGaitArgs(NamedTuple):
    """Parameters of `compass_gait`: masses of hip and leg (kg), inertia of a leg about its centre of mass
    (kg m^2), length of the legs and distance of their centres of mass from the hip (m), gravity (m/s^2) and
    slope (rad)."""

    hip_mass: Any = 1000.0
    leg_mass: Any = 1.0
    leg_inertia: Any = 0.0
    leg_length: Any = 1.0
    center: Any = 1.0
    gravity: Any = 1.0
    slope: Any = 0.009


def _mass(q: Vector, args: CompassGaitArgs) -> Float[Array, "4 4"]:
    total = args.hip_mass + 2 * args.leg_mass
    moment = args.leg_mass * args.center
    inertia = args.leg_inertia + args.leg_mass * args.center**2
    angles, zero = q[2:], jnp.zeros_like(total)
    along, up = moment * jnp.cos(angles), moment * jnp.sin(angles)
    return jnp.stack(
        [
            jnp.stack([total, zero, along[0], along[1]]),
            jnp.stack([zero, total, up[0], up[1]]),
            jnp.stack([along[0], up[0], inertia, zero]),
            jnp.stack([along[1], up[1], zero, inertia]),
        ]
    )


def _force(t: RealScalarLike, q: Vector, v: Vector, args: CompassGaitArgs) -> Vector:
    """Gravity, and the centrifugal forces of the legs on the hip."""
    along, down = args.gravity * jnp.sin(args.slope), args.gravity * jnp.cos(args.slope)
    total = args.hip_mass + 2 * args.leg_mass
    moment = args.leg_mass * args.center
    sin, cos, square = jnp.sin(q[2:]), jnp.cos(q[2:]), v[2:] ** 2
    hip = [total * along + moment * (sin @ square), -total * down - moment * (cos @ square)]
    return jnp.concatenate([jnp.stack(hip), moment * (along * cos - down * sin)])


def _foot(q: Vector, leg: int, args: CompassGaitArgs) -> Float[Array, "2"]:
    angle = q[2 + leg]
    return q[:2] + args.leg_length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


def _stance(t: RealScalarLike, q: Vector, args: CompassGaitArgs) -> Float[Array, "2"]:
    return _foot(q, 0, args)


def _strike(t: RealScalarLike, y: State, args: CompassGaitArgs) -> FloatScalar:
    """Where the feet are equally high with the hip before the stance foot: not where the legs meet."""
    stance, swing = y[0][2], y[0][3]
    return jnp.maximum(stance + swing, stance)


def _exchange(t: RealScalarLike, y: State, args: CompassGaitArgs) -> State:
    """Exchange the legs, and put the origin at the new stance foot. The correction that follows every
    jump, orthogonal in the metric of the masses, is the plastic impact of this foot."""
    q, v = y
    hip, order = q[:2] - _foot(q, 1, args), np.array([1, 0])
    return jnp.concatenate([hip, q[2:][order]]), jnp.concatenate([v[:2], v[2:][order]])


HEEL_STRIKE = Reset(_strike, _exchange, direction=False)


def _initial_state(args: CompassGaitArgs, start: State) -> State:
    """Return the angles and rates in `start`, with the hip above the stance foot."""
    (angle, swing), (rate, swing_rate) = start[0][2:], start[1][2:]
    hip = args.leg_length * jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
    velocity = -args.leg_length * rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    return (
        jnp.concatenate([hip, jnp.stack([angle, swing])]),
        jnp.concatenate([velocity, jnp.stack([rate, swing_rate])]),
    )


def _exact(t: np.ndarray, args: CompassGaitArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate Lagrange's equations in the two angles."""
    M, m, inertia, length, c, g, slope = (float(x) for x in args)
    stance = M * length**2 + m * ((length - c) ** 2 + length**2) + inertia
    swing = m * c**2 + inertia
    pull = M * length + m * (2 * length - c)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        a, b, u, w = x.tolist()
        coupling, gyroscopic = m * length * c * np.array([np.cos(a - b), np.sin(a - b)])
        forces = [
            g * pull * np.sin(a - slope) + gyroscopic * w * w,
            g * m * c * np.sin(slope - b) - gyroscopic * u * u,
        ]
        masses = np.array([[stance, -coupling], [-coupling, swing]])
        return np.concatenate([x[2:], np.linalg.solve(masses, forces)])

    strike = lambda t, x: max(x[0] + x[1], x[0])
    exchange = lambda _, x: _after_strike(x, (M, m, inertia, length, c))
    x0 = np.array([*y0[0][2:], *y0[1][2:]])
    a, b, u, w = integrate_with_resets(field, x0, t, [strike], exchange).T
    q = [-length * np.sin(a), length * np.cos(a), a, b]
    v = [-length * np.cos(a) * u, -length * np.sin(a) * u, u, w]
    return np.stack(q, axis=1), np.stack(v, axis=1)


def _after_strike(x: np.ndarray, masses: tuple[float, ...]) -> np.ndarray:
    """Return angles and rates of the exchanged legs from the balances of angular momentum: of all about the
    foot that strikes, and of the other leg about the hip."""
    M, m, inertia, length, c = masses
    a, b, u, w = x.tolist()
    along = lambda angle: np.array([np.sin(angle), -np.cos(angle)])
    across = lambda angle: np.array([np.cos(angle), np.sin(angle)])
    cross = lambda r, v: r[0] * v[1] - r[1] * v[0]
    foot = length * along(b)

    def momenta(hip: np.ndarray, u: float, w: float) -> np.ndarray:
        """Of the legs at the angles `a` and `b` with the rates `u` and `w`, and the hip at this velocity."""
        first, second = hip + c * u * across(a), hip + c * w * across(b)
        about_foot = M * cross(-foot, hip) + inertia * (u + w)
        about_foot += m * cross(c * along(a) - foot, first) + m * cross(c * along(b) - foot, second)
        return np.array([about_foot, m * cross(c * along(a), first) + inertia * u])

    after = lambda u, w: momenta(-length * w * across(b), u, w)
    before = momenta(-length * u * across(a), u, w)
    other, stance = np.linalg.solve(np.stack([after(1.0, 0.0), after(0.0, 1.0)], axis=1), before)
    return np.array([b, a, stance, other])


def compass_gait(
    *,
    hip_mass: Any = 1000.0,
    leg_mass: Any = 1.0,
    leg_inertia: Any = 0.0,
    leg_length: Any = 1.0,
    center: Any = 1.0,
    gravity: Any = 1.0,
    slope: Any = 0.009,
    angles: Any = None,
    t1: float = 12.0,
) -> Problem:
    r"""The compass gait, two legs without knees that walk down a slope, in the coordinates
    $q = (x, y, \alpha, \beta)$: the hip along and above the slope, measured from the stance foot, and the
    angles of stance and swing leg from the normal of the slope. The stance foot is held,

    $$(x, y) + l (\sin \alpha, -\cos \alpha) = 0.$$

    When the swing foot meets the slope ($\alpha + \beta = 0$ with the hip before the stance foot; that the
    straight legs scuff when they pass each other is ignored) it takes over and the other foot is free: a plastic impact
    that exchanges the legs, `resets` of the problem. Distances walked are sums of the steps:

    ```python
    problem = mj.problems.compass_gait()
    solver = mj.Projected(dfx.Tsit5(), problem.constraint)
    sol = mj.diffeqsolve(
        problem.terms, solver, 0.0, problem.t1, None, problem.y0, problem.args,
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9), resets=problem.resets,
    )
    length_of_steps = 2 * problem.args.leg_length * jnp.sin(jnp.abs(sol.resets.before[0][:, 2]))
    ```

    The standard walker, heavy at the hip with small masses at the feet, starts on its limit cycle:
    the state after each heel strike is the published one, to 3e-12.

    **Arguments:**

    - `hip_mass`, `leg_mass` (kg, of each leg), `leg_inertia` (kg m^2, about its centre of mass),
        `leg_length`, `center` (m, from the hip to the centre of mass of a leg), `gravity` (m/s^2),
        `slope` (rad): scalars, `args`. `with_args` keeps angles and rates.
    - `angles`: the start, $(\alpha, \alpha', \alpha - \beta, \alpha' - \beta')$ after a heel strike, by
        default the published one.
    - `t1`: the end of the time span (s), by default three steps.

    The solution is an independent integration in the two angles (SciPy's DOP853), restarted at heel
    strikes with the balances of angular momentum; to about 1e-11.

    Sources: Garcia, Chatterjee, Ruina & Coleman, J. Biomech. Eng. 120 (1998) 281-288; the numbers are
    those of P. A. Bhounsule's `passivewalker.m` (2009), which walks in steps of its own derivation.
    """
    stance, rate, between, rate_between = as_floating(FIXED_POINT if angles is None else angles)
    zero = jnp.zeros_like(stance)
    q = jnp.stack([zero, zero, stance, stance - between])
    v = jnp.stack([zero, zero, rate, rate - rate_between])
    args = CompassGaitArgs(hip_mass, leg_mass, leg_inertia, leg_length, center, gravity, slope)
    return Problem(
        "compass-gait",
        system=MechanicalSystem(_mass, _stance, _force),
        t1=t1,
        args=args,
        start=(q, v),
        initial_state=_initial_state,
        resets=(HEEL_STRIKE,),
        exact=_exact,
    )
