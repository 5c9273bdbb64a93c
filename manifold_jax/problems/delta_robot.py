"""A delta robot: three arms, six rods, and a platform that does not turn."""

import math
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from .._multibody import Assembly, Body, Distance, GROUND, JointSpring, Pose, Revolute
from .._multibody.parametrized import parametrized
from ._problem import as_floating, integrate, Problem


State: TypeAlias = tuple[Pose, Pose]

ARMS = ("arm 1", "arm 2", "arm 3")
# Directions of the arms, seen from above.
DIRECTIONS = tuple(2 * math.pi * i / 3 for i in range(3))
# Half the distance of the two rods of an arm over the radius of the platform.
SPREAD = 0.5


class DeltaRobotArgs(NamedTuple):
    """Parameters of `delta_robot`: radius of the base, lengths of arms and rods and radius of the
    platform (m), masses of each arm and of the platform (kg), stiffness of the springs in the hinges
    (N m/rad) and gravity (m/s^2)."""

    base_radius: Any
    arm_length: Any
    rod_length: Any
    platform_radius: Any
    arm_mass: Any
    platform_mass: Any
    stiffness: Any
    gravity: Any


class RobotParts(NamedTuple):
    """Bodies, joints, springs in the hinges, and the acceleration of gravity."""

    bodies: list[Body]
    joints: list[Revolute | Distance]
    springs: list[JointSpring]
    gravity: Any


def parts(args: DeltaRobotArgs) -> RobotParts:
    """Return the robot as drawn: arms horizontal, with the platform hanging on its rods."""
    L, r = args.arm_length, args.platform_radius
    depth = jnp.sqrt(args.rod_length**2 - (args.base_radius + L - r) ** 2)
    zero = jnp.zeros_like(L)
    center = jnp.stack([zero, zero, -depth])
    bodies, joints, springs = [], [], []
    for name, direction in zip(ARMS, DIRECTIONS, strict=True):
        radial = jnp.stack([zero + math.cos(direction), zero + math.sin(direction), zero])
        tangential = jnp.stack([-radial[1], radial[0], zero])
        inertia = args.arm_mass * L**2 / 12 * jnp.asarray([0.01, 1.0, 1.0], L.dtype)
        turned = jnp.asarray([math.cos(direction / 2), 0, 0, math.sin(direction / 2)], L.dtype)
        middle = (args.base_radius + L / 2) * radial
        bodies.append(Body(name, args.arm_mass, inertia, position=middle, orientation=turned))
        hinge = Revolute(
            GROUND, name, at=args.base_radius * radial, axis=tangential, name=f"hinge of {name}"
        )
        elbow, wrist = (args.base_radius + L) * radial, center + r * radial
        aside = SPREAD * r * tangential
        ends = ((elbow + aside, wrist + aside), (elbow - aside, wrist - aside))
        joints += [hinge, *[Distance(name, "platform", end, args.rod_length) for end in ends]]
        springs.append(JointSpring(f"hinge of {name}", args.stiffness))
    disc = args.platform_mass * r**2 / 4 * jnp.asarray([1.0, 1.0, 2.0], L.dtype)
    bodies.append(Body("platform", args.platform_mass, disc, position=center))
    return RobotParts(bodies, joints, springs, jnp.stack([zero, zero, -args.gravity]))


def assembly(args: DeltaRobotArgs) -> Assembly:
    bodies, joints, springs, gravity = parts(args)
    return Assembly(bodies, joints, springs, gravity=gravity)


def _initial_state(args: DeltaRobotArgs, start: State) -> State:
    """Return the state for the platform's motion in `start`, with the lengths of `args`."""
    q, v = start
    angle, rate, _ = _arms(jnp, q.position[3], v.position[3], args)
    return _bodies(jnp, q.position[3], v.position[3], angle, rate, args)


def _directions(xp: ModuleType, dtype: Any, fraction: float = 1.0) -> tuple[Any, Any]:
    """Return cosines and sines of the directions of the arms, or of a fraction of these angles."""
    angles = fraction * np.array(DIRECTIONS)
    return xp.asarray(np.cos(angles), dtype), xp.asarray(np.sin(angles), dtype)


def _arms(xp: ModuleType, x: Any, u: Any, args: Any) -> tuple[Any, Any, tuple]:
    """Return angles of the arms below the horizontal, their rates, and rods `n` with the directions of
    the arms and their derivatives; in NumPy or JAX, for positions of the platform `(..., 3)`."""
    L = args.arm_length
    cosines, sines = _directions(xp, L.dtype)
    flat = lambda a: a[..., 0:1] * cosines + a[..., 1:2] * sines  # radial parts
    across = lambda a: a[..., 1:2] * cosines - a[..., 0:1] * sines
    radial = flat(x) + args.platform_radius - args.base_radius  # from the hinges to the wrists
    down = x[..., 2:3] + xp.zeros_like(radial)
    size2 = radial**2 + across(x) ** 2 + down**2
    k = (size2 + L**2 - args.rod_length**2) / (2 * L)
    angle = -xp.arctan2(down, radial) - xp.arccos(k / xp.sqrt(radial**2 + down**2))
    s, c = xp.sin(angle), xp.cos(angle)
    rods = (radial - L * c, across(x), down + L * s)  # radial, tangential, vertical
    lever = L * (-rods[0] * s - rods[2] * c)
    speed = (flat(u), across(u), u[..., 2:3] + xp.zeros_like(radial))
    rate = sum(n * w for n, w in zip(rods, speed, strict=True)) / lever
    return angle, rate, (rods, speed, lever, s, c)


def _bodies(xp: ModuleType, x: Any, u: Any, angle: Any, rate: Any, args: Any) -> State:
    """Return poses and rates of arms and platform; the leading axes are those of `x`."""
    cosines, sines = _directions(xp, args.arm_length.dtype)
    s, c, half = xp.sin(angle), xp.cos(angle), args.arm_length / 2
    out, fast = args.base_radius + half * c, -half * s * rate
    arms = xp.stack([out * cosines, out * sines, -half * s], axis=-1)
    moving = xp.stack([fast * cosines, fast * sines, -half * c * rate], axis=-1)
    # the turn about the vertical after that about the hinge
    a, b = _directions(xp, args.arm_length.dtype, 0.5)
    s, c = xp.sin(angle / 2), xp.cos(angle / 2)
    turned = xp.stack([a * c, -b * s, a * s, b * c], axis=-1)
    turning = xp.stack([-a * s, -b * c, a * c, -b * s], axis=-1) * rate[..., None] / 2
    upright = xp.zeros_like(turned[..., :1, :])
    still = xp.concatenate([upright[..., :1] + 1, upright[..., 1:]], axis=-1)
    join = lambda arms, platform: xp.concatenate([arms, platform], axis=-2)
    return (
        Pose(join(arms, x[..., None, :]), join(turned, still)),
        Pose(join(moving, u[..., None, :]), join(turning, upright)),
    )


def _exact(t: np.ndarray, args: DeltaRobotArgs, y0: Any) -> State:
    """Integrate the equation of motion of the platform's position, the angles being functions of it:

    (m + J sum_i g_i g_i^T) x'' = m g + sum_i g_i (torque_i - J bias_i), g_i = d angle_i / dx.
    """
    L, mass, g = args.arm_length, args.platform_mass, float(args.gravity)
    inertia = args.arm_mass * L**2 / 3
    cosines, sines = _directions(np, np.float64)

    def field(t, state):
        x, u = state[:3], state[3:]
        angle, rate, (rods, speed, lever, s, c) = _arms(np, x, u, args)
        x_part, y_part = rods[0] * cosines - rods[1] * sines, rods[0] * sines + rods[1] * cosines
        gradients = np.stack([x_part, y_part, rods[2]]) / lever
        across = (speed[0] + L * s * rate) ** 2 + speed[1] ** 2 + (speed[2] + L * c * rate) ** 2
        bias = (L * (rods[0] * c - rods[2] * s) * rate**2 + across) / lever
        torque = args.arm_mass * g * L / 2 * c - args.stiffness * angle
        right = gradients @ (torque - inertia * bias) - np.array([0, 0, mass * g])
        matrix = mass * np.eye(3) + inertia * gradients @ gradients.T
        return np.concatenate([u, np.linalg.solve(matrix, right)])

    q, v = y0
    start = np.concatenate([q.position[3], v.position[3]])
    x, u = np.split(integrate(field, start, t), 2, axis=1)
    angle, rate, _ = _arms(np, x, u, args)
    return _bodies(np, x, u, angle, rate, args)


def delta_robot(
    *,
    base_radius: Any = 0.2,
    arm_length: Any = 0.35,
    rod_length: Any = 0.8,
    platform_radius: Any = 0.08,
    arm_mass: Any = 0.5,
    platform_mass: Any = 1.0,
    stiffness: Any = 8.0,
    gravity: Any = 9.81,
    velocity: Any = (0.6, 0.3, 0.0),
    t1: float = 2.0,
) -> Problem:
    r"""A delta robot on springs: three closed loops in space.

    Three arms on hinges in the base, z upwards, carry a platform by two parallel massless rods each,
    which keep it from turning. With the positions and quaternions of the four bodies,

    $$M q'' = Q - J^T \lambda, \quad \tfrac12 (|d_k|^2 / L - L) = 0, \quad k = 1, \dots, 6,$$

    five equations for each hinge, and the norms of the quaternions: 25 for 28 coordinates. A spring
    in each hinge, slack when its arm is horizontal. An assembly of `mj.multibody`. The state is
    `(q, v)`, both of positions `(4, 3)` and orientations `(4, 4)` of arms and platform. It starts
    with horizontal arms and a push.

    The solution is an independent integration (SciPy's DOP853) of the equation of motion of the
    platform's position alone, from every initial state on the manifold whose arms point outwards;
    standard problem: to about 1e-12.

    **Arguments:**

    - `base_radius`, `arm_length`, `rod_length`, `platform_radius` (m), `arm_mass`,
        `platform_mass` (kg), `stiffness` (N m/rad) and `gravity` (m/s^2): `args`. `with_args`
        keeps position and velocity of the platform, those of the standard start as well as yours.
    - `velocity` of the platform at `t = 0` (m/s), shape `(3,)`.
    - `t1`: the end of the time span (s).

    Source: Clavel, US patent 4976582 (1990); equations by the virtual work of the platform.
    """
    numbers = (
        base_radius, arm_length, rod_length, platform_radius,
        arm_mass, platform_mass, stiffness, gravity,
    )  # fmt: skip
    args = DeltaRobotArgs(*map(as_floating, numbers))
    drawing = assembly(args).bodies.drawing
    pushed = jnp.zeros_like(drawing.position).at[3].set(as_floating(velocity))
    return Problem(
        "delta-robot",
        system=parametrized(assembly),
        t1=t1,
        args=args,
        start=(drawing, Pose(pushed, jnp.zeros_like(drawing.orientation))),
        initial_state=_initial_state,
        exact=_exact,
    )
