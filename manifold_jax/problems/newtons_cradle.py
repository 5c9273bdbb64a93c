"""Newton's cradle: balls on rods that hit each other."""

import functools
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import impact, MechanicalSystem
from .._resets.reset import Reset
from ._problem import integrate_with_resets, Problem, repeated


Balls: TypeAlias = Float[Array, "N 2"]
State: TypeAlias = tuple[Balls, Balls]


class NewtonsCradleArgs(NamedTuple):
    """Parameters of `newtons_cradle`: masses of the balls (kg), shape `(N,)`, their radius, the length of the
    rods and the distance of their pivots (m), gravity (m/s^2) and coefficient of restitution."""

    masses: Any
    radius: Any = 0.05
    length: Any = 1.0
    spacing: Any = 0.102
    gravity: Any = 9.81
    restitution: Any = 0.95


def _from_pivots(q: Balls, args: NewtonsCradleArgs) -> Balls:
    pivots = args.spacing * jnp.arange(q.shape[0], dtype=q.dtype)
    return q - jnp.stack([pivots, jnp.zeros_like(pivots)], axis=1)


def _mass(q: Balls, args: NewtonsCradleArgs) -> Balls:
    return jnp.broadcast_to(args.masses[:, None], q.shape)


def _rods(t: RealScalarLike, q: Balls, args: NewtonsCradleArgs) -> Float[Array, " N"]:
    x, y = _from_pivots(q, args).T
    return 0.5 * (x * x + y * y - args.length**2)


def _force(t: RealScalarLike, q: Balls, v: Balls, args: NewtonsCradleArgs) -> Balls:
    weights = -args.masses * args.gravity
    return jnp.stack([jnp.zeros_like(weights), weights], axis=1)


def _gap(i: int, t: RealScalarLike, q: Balls, args: NewtonsCradleArgs) -> FloatScalar:
    """Return the distance between the surfaces of the balls `i` and `i + 1`."""
    between = q[i + 1] - q[i]
    return jnp.sqrt(between @ between) - 2 * args.radius


def _restitution(args: NewtonsCradleArgs) -> FloatScalar:
    return args.restitution


@functools.cache
def _impacts(balls: int) -> tuple[Reset, ...]:
    """Return the same functions for every problem of so many balls: it is compiled once."""
    system = MechanicalSystem(_mass, _rods, _force)
    gaps = [lambda t, q, args, i=i: _gap(i, t, q, args) for i in range(balls - 1)]
    return tuple(impact(system, gap, _restitution) for gap in gaps)


def _initial_state(args: NewtonsCradleArgs, start: State) -> State:
    """Return the state for the angles and rates of `start`, with the lengths of `args`."""
    angles, rates = start[0][:, 0], start[1][:, 0]
    sin, cos, L = jnp.sin(angles), jnp.cos(angles), args.length
    pivots = args.spacing * jnp.arange(angles.size, dtype=angles.dtype)
    q = jnp.stack([pivots + L * sin, -L * cos], axis=1)
    return q, L * rates[:, None] * jnp.stack([cos, sin], axis=1)


def _exact(t: np.ndarray, args: NewtonsCradleArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the angles of all rods, restarted at impacts, whose impulses act along the line between the
    centres."""
    n, L, e = args.masses.size, float(args.length), float(args.restitution)
    pivots = float(args.spacing) * np.arange(n)
    places = lambda a: np.stack([pivots + L * np.sin(a), -L * np.cos(a)], axis=-1)
    along = lambda a: np.stack([np.cos(a), np.sin(a)], axis=-1)
    distances = lambda x: np.linalg.norm(np.diff(places(x[:n]), axis=0), axis=1)
    gap = lambda i: lambda t, x: float(distances(x)[i] - 2 * args.radius)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[n:], -float(args.gravity) / L * np.sin(x[:n])])

    def collide(i: int, x: np.ndarray) -> np.ndarray:
        a = x[:n]
        normal = np.diff(places(a), axis=0)[i]
        normal = normal / np.linalg.norm(normal)
        levers = L * along(a)[i : i + 2] @ normal * np.array([-1.0, 1.0])  # of the rate of the gap
        inverse = 1 / (args.masses[i : i + 2] * L**2)
        impulse = -(1 + e) * (levers @ x[n + i : n + i + 2]) / (levers**2 @ inverse)
        after = x.copy()
        after[n + i : n + i + 2] += impulse * inverse * levers
        return after

    q, v = (np.asarray(part) for part in y0)
    angles = np.arctan2(q[:, 0] - pivots, -q[:, 1])
    rates = np.sum(v * along(angles), axis=1) / L
    gaps = [gap(i) for i in range(n - 1)]
    x = integrate_with_resets(field, np.concatenate([angles, rates]), t, gaps, collide)
    return places(x[:, :n]), L * x[:, n:, None] * along(x[:, :n])


def newtons_cradle(
    balls: int = 3,
    *,
    masses: Any = 1.0,
    radius: Any = 0.05,
    length: Any = 1.0,
    spacing: Any = 0.102,
    gravity: Any = 9.81,
    restitution: Any = 0.95,
    angles: Any = None,
    t1: float = 2.0,
) -> Problem:
    r"""Newton's cradle, N balls on rods side by side that hit each other one after the other, in Cartesian
    coordinates: $q$ of shape `(N, 2)`, the centres of the balls, y upwards, with the pivots at $(i s, 0)$.

    $$m_i q_i'' = (0, -m_i g) - \lambda_i (q_i - p_i), \qquad \tfrac12 (|q_i - p_i|^2 - L^2) = 0,$$

    and an impact without friction where $|q_{i+1} - q_i| = 2 r$, `resets` of the problem: [`impact`][] with
    the restitution of `args`. At rest the balls are apart by the spacing less their diameter, so that
    impacts come one at a time; of balls that touch the order of the impacts would not be determined.

    The solution is an independent integration in the angles of the rods (SciPy's DOP853), restarted at
    impacts; to about 1e-11.

    **Arguments:**

    - `balls`: their number N, two or more.
    - `masses` (kg), a scalar or of shape `(N,)`, `radius`, `length`, `spacing` (m), `gravity` (m/s^2) and
        `restitution`: `args`. `with_args` keeps the angles and their rates.
    - `angles`: of the rods at the start, at rest, shape `(N,)`; by default the first ball is raised by 0.8 rad.
    - `t1`: the end of the time span (s).

    Source: classical; Brogliato, Nonsmooth Mechanics (2016), ch. 6 (multiple impacts).
    """
    if balls < 2:
        raise ValueError(f"`balls` must be at least 2, got {balls}.")
    masses = repeated(masses, balls, "masses", " one for each ball")
    raised = np.where(np.arange(balls) == 0, -0.8, 0.0) if angles is None else angles
    raised = repeated(raised, balls, "angles", " one for each ball")
    still = jnp.zeros_like(raised)
    return Problem(
        "newtons-cradle",
        system=MechanicalSystem(_mass, _rods, _force),
        t1=t1,
        args=NewtonsCradleArgs(masses, radius, length, spacing, gravity, restitution),
        start=(jnp.stack([raised, still], axis=1), jnp.zeros((balls, 2), raised.dtype)),
        initial_state=_initial_state,
        resets=_impacts(balls),
        exact=_exact,
    )
