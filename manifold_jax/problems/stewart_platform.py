"""A Stewart platform: six telescopic legs between a base and a platform."""

import math
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._multibody import Assembly, Body, GROUND, JointSpring, Pose, Prismatic, Spherical, Universal
from .._multibody.parametrized import parametrized
from ._problem import as_floating, integrate, Problem


State: TypeAlias = tuple[Pose, Pose]

CYLINDERS = tuple(f"cylinder {i}" for i in range(1, 7))
PISTONS = tuple(f"piston {i}" for i in range(1, 7))
# Angles of the joints, seen from above, in pairs; those of the platform are turned by 60 degrees.
AT_BASE = tuple(math.radians(120 * (i // 2) + (-15, 15)[i % 2]) for i in range(6))
AT_PLATFORM = tuple(math.radians(120 * (i // 2) + (-45, 45)[i % 2]) for i in range(6))
# Centres of mass of cylinders and pistons from their ends, and their moments of inertia across
# and along the leg over the mass, all for a platform of radius 1.
CENTER, ACROSS, ALONG = 0.4, 0.06, 0.002


class StewartPlatformArgs(NamedTuple):
    """Parameters of `stewart_platform`: radius of base and platform and height of the drawing (m),
    masses of the platform and of each cylinder and piston (kg), stiffness of the legs (N/m), their
    length without load (m) and gravity (m/s^2)."""

    base_radius: Any
    platform_radius: Any
    height: Any
    platform_mass: Any
    leg_mass: Any
    stiffness: Any
    rest_length: Any
    gravity: Any


def _points(xp: Any, args: Any) -> tuple[Any, Any, Any]:
    """Return joints at base and platform, and the first axes of the universal joints."""
    dtype = args.base_radius.dtype
    circle = lambda angles: xp.asarray(
        np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1), dtype
    )
    return (
        args.base_radius * circle(AT_BASE),
        args.platform_radius * circle(AT_PLATFORM),
        circle(np.array(AT_BASE) + math.pi / 2),
    )


def _legs(xp: Any, base: Any, ends: Any, first_axes: Any) -> tuple[Any, Any]:
    """Return lengths and frames of the legs, `(6, 3, 3)`: the columns are the second axis of the
    universal joint, the normal of both, and the direction of the leg. Also for complex numbers."""
    span = ends - base
    length = xp.sqrt(xp.sum(span * span, axis=-1))
    n = span / length[:, None]
    second = xp.cross(first_axes, n)
    second = second / xp.sqrt(xp.sum(second * second, axis=-1))[:, None]
    return length, xp.stack([second, xp.cross(n, second), n], axis=-1)


def _leg_motion(xp: Any, points: tuple, x: Any, R: Any, u: Any, w: Any) -> tuple[Any, ...]:
    """Return, for position, rotation and twists `(..., 3)` of the platform, the upper ends of the legs
    and their velocities, the frames of the legs, rates of the directions, and angular velocities. The
    universal joint determines the spin: its second axis stays perpendicular to its first."""
    base, local, first_axes = points
    arms = local @ R.T
    ends = arms + x[None, :]
    moving = u[..., None, :] + xp.cross(w[..., None, :], arms)
    length, frames = _legs(xp, base, ends, first_axes)
    second, normal, n = frames[..., 0], frames[..., 1], frames[..., 2]
    dot = lambda a, b: xp.sum(a * b, axis=-1)[..., None]
    turning = (moving - n * dot(n, moving)) / length[:, None]
    sine = dot(xp.cross(first_axes, n), second)
    spin = dot(turning, xp.cross(normal, first_axes)) / sine
    return ends, moving, frames, turning, xp.cross(n, turning) + spin * n


def assembly(args: StewartPlatformArgs) -> Assembly:
    """Return the platform as drawn: level, at its height."""
    base, local, first_axes = _points(jnp, args)
    zero = jnp.zeros_like(args.height)
    center = jnp.stack([zero, zero, args.height])
    ends = local + center[None, :]
    length, frames = _legs(jnp, base, ends, first_axes)
    size, mass = args.platform_radius, args.leg_mass
    moments = jnp.asarray([ACROSS, ACROSS, ALONG], size.dtype) * mass * size**2
    disc = jnp.asarray([0.25, 0.25, 0.5], size.dtype) * args.platform_mass * size**2
    bodies = [Body("platform", args.platform_mass, disc, position=center)]
    joints, springs = [], []
    turned = _quaternions(jnp, frames)
    for i, (cylinder, piston) in enumerate(zip(CYLINDERS, PISTONS, strict=True)):
        second, n = frames[i, :, 0], frames[i, :, 2]
        below, above = base[i] + CENTER * size * n, ends[i] - CENTER * size * n
        for name, at in ((cylinder, below), (piston, above)):
            bodies.append(Body(name, mass, moments, position=at, orientation=turned[i]))
        slider = f"leg {i + 1}"
        joints += [
            Universal(GROUND, cylinder, at=base[i], axis=(first_axes[i], second)),
            Prismatic(cylinder, piston, at=ends[i], axis=n, name=slider),
            Spherical(piston, "platform", at=ends[i]),
        ]
        springs.append(JointSpring(slider, args.stiffness, args.rest_length - length[i]))
    return Assembly(bodies, joints, springs, gravity=jnp.stack([zero, zero, -args.gravity]))


def _quaternions(xp: Any, frames: Any) -> Any:
    """Return the quaternions of rotation matrices `(..., 3, 3)` whose trace is not near -1."""
    R = lambda i, j: frames[..., i, j]
    a = xp.sqrt(1 + R(0, 0) + R(1, 1) + R(2, 2)) / 2
    vector = xp.stack([R(2, 1) - R(1, 2), R(0, 2) - R(2, 0), R(1, 0) - R(0, 1)], axis=-1)
    return xp.concatenate([a[..., None], vector / (4 * a[..., None])], axis=-1)


def _spinning(xp: Any, p: Any, spin: Any) -> Any:
    """Return rates of quaternions for angular velocities in space."""
    a, v = p[..., :1], p[..., 1:]
    scalar = -xp.sum(v * spin, axis=-1)[..., None]
    return xp.concatenate([scalar, a * spin + xp.cross(spin, v)], axis=-1) / 2


def _spin(xp: Any, p: Any, p_rate: Any) -> Any:
    """Return the angular velocity in space."""
    return 2 * (p[0] * p_rate[1:] - p_rate[0] * p[1:] + xp.cross(p[1:], p_rate[1:]))


def _rotation(xp: Any, p: Any) -> Any:
    """Return the rotation matrix of a unit quaternion."""
    a, v = p[0], p[1:]
    cross = xp.cross(xp.eye(3, dtype=v.dtype), v)  # the matrix of v x
    return (2 * a * a - 1) * xp.eye(3, dtype=v.dtype) + 2 * v[:, None] * v[None, :] + 2 * a * cross


def _initial_state(args: StewartPlatformArgs, start: State) -> State:
    """Return the state for pose and velocities of the platform in `start`, with the lengths of `args`."""
    q, v = start
    return _bodies(jnp, q.position[0], q.orientation[0], v.position[0], v.orientation[0], args)


def _bodies(xp: Any, x: Any, p: Any, u: Any, p_rate: Any, args: Any) -> State:
    """Return all bodies, from the platform."""
    points = _points(xp, args)
    base, R, spin = points[0], _rotation(xp, p), _spin(xp, p, p_rate)
    ends, moving, frames, turning, spins = _leg_motion(xp, points, x, R, u, spin)
    c, n = CENTER * args.platform_radius, frames[..., 2]
    alternating = lambda lower, upper: xp.stack([lower, upper], axis=1).reshape(12, -1)
    join = lambda platform, legs: xp.concatenate([platform[None, :], legs])
    turned = alternating(*[_quaternions(xp, frames)] * 2)
    rates = _spinning(xp, turned, alternating(spins, spins))
    position = join(x, alternating(base + c * n, ends - c * n))
    velocity = join(u, alternating(c * turning, moving - c * turning))
    return Pose(position, join(p, turned)), Pose(velocity, join(p_rate, rates))


def _exact(t: np.ndarray, args: StewartPlatformArgs, y0: Any) -> State:
    """Integrate Kane's equations of the platform alone, whose twist determines the velocities of all
    bodies; the accelerations that are left when its twist is constant by a complex step."""
    q, v = y0
    twist = _twist_equation(args)
    x, p, u, p_rate = q.position[0], q.orientation[0], v.position[0], v.orientation[0]

    def field(t, state):
        return np.concatenate([state[7:10], _spinning(np, state[3:7], state[10:]), twist(state)])

    states = integrate(field, np.concatenate([x, p, u, _spin(np, p, p_rate)]), t)
    rows = []
    for state in states:
        p = state[3:7] / np.linalg.norm(state[3:7])
        p_rate = _spinning(np, p, state[10:])
        rows.append(_bodies(np, state[:3], p, state[7:10], p_rate, args))
    return jtu.tree_map(lambda *leaves: np.stack(leaves), *rows)


def _twist_equation(args: StewartPlatformArgs) -> Any:
    """Return the acceleration and angular acceleration of the platform."""
    base, local, first_axes = points = _points(np, args)
    size, tiny = float(args.platform_radius), 1e-30
    masses = np.array([args.platform_mass] + [args.leg_mass] * 12)
    of_leg = float(args.leg_mass) * size**2
    disc = np.array([0.25, 0.25, 0.5]) * args.platform_mass * size**2

    def velocities(x, R, u, w):
        """Return velocities of centres of mass and of turning, `(..., 13, 3)`, for twists `(..., 3)`."""
        _, moving, _, turning, spins = _leg_motion(np, points, x, R, u, w)
        c = CENTER * size
        linear = np.concatenate([u[..., None, :], c * turning, moving - c * turning], axis=-2)
        return linear, np.concatenate([w[..., None, :], spins, spins], axis=-2)

    def twist(state):
        x, u, w = state[:3], state[7:10], state[10:]
        R = _rotation(np, state[3:7] / np.linalg.norm(state[3:7]))
        units = np.eye(6)
        linear, angular = velocities(x, R, units[:, :3], units[:, 3:])
        turned = np.cross(w, R.T).T  # w x R, column by column
        bias, turning_bias = (
            np.imag(part) / tiny
            for part in velocities(x + 1j * tiny * u, R + 1j * tiny * turned, u, w)
        )
        length, frames = _legs(np, base, local @ R.T + x, first_axes)
        n = frames[..., 2]
        leg = of_leg * (ACROSS * np.eye(3) + (ALONG - ACROSS) * n[:, :, None] * n[:, None, :])
        inertia = np.concatenate([(R * disc @ R.T)[None], leg, leg])
        spin = np.einsum("kbi,k->bi", angular, state[7:])
        momentum = np.einsum("bij,bj->bi", inertia, spin)
        torque = np.einsum("bij,bj->bi", inertia, turning_bias) + np.cross(spin, momentum)
        force = masses[:, None] * (bias + np.array([0, 0, args.gravity]))
        right = -np.einsum("kbi,bi->k", linear, force) - np.einsum("kbi,bi->k", angular, torque)
        tension = args.stiffness * (length - args.rest_length)
        ends = units[:, None, :3] + np.cross(units[:, None, 3:], local @ R.T)
        right -= np.einsum("l,li,kli->k", tension, n, ends)
        matrix = np.einsum("kbi,b,mbi->km", linear, masses, linear)
        matrix += np.einsum("kbi,bij,mbj->km", angular, inertia, angular)
        return np.linalg.solve(matrix, right)

    return twist


def stewart_platform(
    *,
    base_radius: Any = 1.0,
    platform_radius: Any = 0.6,
    height: Any = 1.2,
    platform_mass: Any = 20.0,
    leg_mass: Any = 2.0,
    stiffness: Any = 5000.0,
    rest_length: Any = 1.35,
    gravity: Any = 9.81,
    velocity: Any = (0.3, -0.2, 0.1),
    spin: Any = (0.2, 0.4, 0.5),
    t1: float = 1.0,
) -> Problem:
    r"""A Stewart platform on springs: thirteen bodies, five closed loops in space.

    Six legs, each of a cylinder on a universal joint at the base and a piston that slides in it and
    carries the platform by a ball joint. With the positions and quaternions of the bodies,

    $$M q'' = Q - J^T \lambda, \quad \phi(q) = 0,$$

    four equations for each universal joint, five for each slider, three for each ball joint and the
    norms of the quaternions: 85 for 91 coordinates. A spring in each leg; z upwards. An assembly of
    `mj.multibody`. The state is `(q, v)`, both of positions `(13, 3)` and orientations
    `(13, 4)` of the platform and of cylinder and piston of each leg in turn. It starts level, with a
    push. Large: some tens of seconds to compile.

    The solution is an independent integration (SciPy's DOP853) of Kane's equations in pose and twist
    of the platform alone, from every initial state on the manifold whose legs are not turned around;
    standard problem: to about 1e-12.

    **Arguments:**

    - `base_radius`, `platform_radius`, `height` of the platform in the drawing (m), `platform_mass`,
        `leg_mass` of each cylinder and piston (kg), `stiffness` (N/m) and `rest_length` (m) of the
        legs, `gravity` (m/s^2): `args`. `with_args` keeps pose and velocities of the platform.
    - `velocity` (m/s) and `spin` (rad/s, in space) of the platform at `t = 0`, shape `(3,)`.
    - `t1`: the end of the time span (s).

    Source: Stewart, Proc. Inst. Mech. Eng. 180 (1965) 371-386; Kane & Levinson, Dynamics (1985).
    """
    numbers = (
        base_radius, platform_radius, height, platform_mass,
        leg_mass, stiffness, rest_length, gravity,
    )  # fmt: skip
    args = StewartPlatformArgs(*map(as_floating, numbers))
    drawing = assembly(args).bodies.drawing
    still = jnp.zeros_like(drawing.orientation)
    pushed = jnp.zeros_like(drawing.position).at[0].set(as_floating(velocity))
    turned = still.at[0].set(_spinning(jnp, drawing.orientation[0], as_floating(spin)))
    return Problem(
        "stewart-platform",
        system=parametrized(assembly),
        t1=t1,
        args=args,
        start=(drawing, Pose(pushed, turned)),
        initial_state=_initial_state,
        exact=_exact,
    )
