"""A parallelogram linkage with one crank too many."""

from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, Problem
from .pendulum import swing


Vector: TypeAlias = Float[Array, "6"]
State: TypeAlias = tuple[Vector, Vector]


class ParallelogramArgs(NamedTuple):
    """Parameters of `parallelogram`: mass (kg) and moment of inertia (kg m^2) of the coupler,
    mass (kg) and length (m) of each crank, distance between neighbours (m), gravity (m/s^2)."""

    coupler_mass: Any = 2.0
    coupler_inertia: Any = 0.2
    crank_mass: Any = 0.5
    length: Any = 1.0
    spacing: Any = 0.5
    gravity: Any = 9.81


def _mass(q: Vector, args: ParallelogramArgs) -> Vector:
    crank = args.crank_mass * args.length**2 / 3
    coupler = [args.coupler_mass, args.coupler_mass, args.coupler_inertia]
    return jnp.stack([*coupler, crank, crank, crank])


def _joints(t: RealScalarLike, q: Vector, args: ParallelogramArgs) -> Float[Array, "2 3"]:
    """Return the pins of the coupler minus the ends of the cranks."""
    pins = args.spacing * jnp.asarray([-1.0, 0.0, 1.0], q.dtype)
    x = q[0] + pins * jnp.cos(q[2]) - pins - args.length * jnp.sin(q[3:])
    y = q[1] + pins * jnp.sin(q[2]) + args.length * jnp.cos(q[3:])
    return jnp.stack([x, y])


def _force(t: RealScalarLike, q: Vector, v: Vector, args: ParallelogramArgs) -> Vector:
    zero = jnp.zeros_like(args.gravity)
    coupler = jnp.stack([zero, -args.coupler_mass * args.gravity, zero])
    torques = -0.5 * args.crank_mass * args.gravity * args.length * jnp.sin(q[3:])
    return jnp.concatenate([coupler, torques])


def _initial_state(args: ParallelogramArgs, start: State) -> State:
    """Return the state for the angles and rates of the cranks, with the length of `args`."""
    (_, _, tilt, *cranks), (_, _, _, rate, *_) = start
    return _links(jnp, tilt, cranks, rate, args.length)


def _links(xp: ModuleType, tilt: Any, cranks: list, rate: Any, length: Any) -> tuple[Any, Any]:
    """Return the state of cranks that turn at one rate, in NumPy or JAX."""
    x, y, still = length * xp.sin(cranks[0]), -length * xp.cos(cranks[0]), 0 * rate
    q, v = [x, y, tilt + still, *cranks], [-y * rate, x * rate, still, rate, rate, rate]
    return xp.stack(q, axis=-1), xp.stack(v, axis=-1)


def _exact(t: np.ndarray, args: ParallelogramArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """A pendulum: `(M + m) L angle'' = -(M + 3 m / 2) g sin(angle)`."""
    M, _, m, L, _, g = (float(p) for p in args)
    (_, _, tilt, *cranks), (_, _, _, rate, *_) = y0
    frequency = np.sqrt((M + 1.5 * m) / (M + m) * g / L)
    turns = 2 * np.pi * np.round(cranks[0] / (2 * np.pi))
    start = cranks[0] - turns
    if frequency**2 * np.cos(start) - rate**2 / 2 <= 0 or np.cos(start) <= 0:
        raise ValueError(
            "The solution of `parallelogram` is implemented for cranks that stay below the "
            "horizontal: there all links are in line and the motion is not determined."
        )
    sin_half, cos_half, rate = swing(t, frequency, start, rate)
    angle = 2 * np.arctan2(sin_half, cos_half)
    return _links(np, tilt, [angle + (crank - start) for crank in cranks], rate, L)


def parallelogram(
    *,
    coupler_mass: Any = 2.0,
    coupler_inertia: Any = 0.2,
    crank_mass: Any = 0.5,
    length: Any = 1.0,
    spacing: Any = 0.5,
    gravity: Any = 9.81,
    angle: Any = 1.0,
    rate: Any = 0.0,
    t1: float = 10.0,
) -> Problem:
    r"""A parallelogram linkage with a redundant third crank, hanging from three pivots.

    $q = (x, y, \theta, \alpha_1, \alpha_2, \alpha_3)$: the middle and the tilt of the coupler
    and the angles of the cranks from the downward vertical. The coupler is pinned to the
    cranks, uniform rods of length L, at its points $s_i = -w, 0, w$:

    $$x + s_i \cos\theta - s_i - L \sin\alpha_i = 0, \quad
    y + s_i \sin\theta + L \cos\alpha_i = 0, \quad i = 1, 2, 3,$$

    with the masses $(M, M, I, J, J, J)$, $J = m L^2 / 3$, and gravity. Of the six equations
    five are independent (`redundant=True`): without the third crank the motion would be
    the same, and how the load is shared between the cranks is not determined.

    The state is `(q, v)`, each of shape `(6,)`; twelve constraints, of which ten are independent.

    Exact solution by Jacobi elliptic functions: the coupler does not tilt, and the cranks
    swing like one pendulum of length $L (M + m) / (M + 3 m / 2)$. It holds for swings that
    stay below the horizontal, where all links are in line and the motion is not determined.

    **Arguments:**

    - `coupler_mass` M (kg), `coupler_inertia` I (kg m^2), `crank_mass` m (kg) and `length` L
        (m) of each crank, `spacing` w (m), `gravity` (m/s^2): scalars, `args`. `with_args`
        keeps the angles and rates, also those of an initial state of yours.
    - `angle`, `rate`: of the cranks at `t = 0` (radian, radian/s).
    - `t1`: the end of the time span (s).

    Source: the mechanism is classical; redundant constraints as in Garcia de Jalon & Bayo,
    Kinematic and Dynamic Simulation of Multibody Systems (1994).
    """
    args = ParallelogramArgs(coupler_mass, coupler_inertia, crank_mass, length, spacing, gravity)
    angle, rate = as_floating(angle), as_floating(rate)
    zero = jnp.zeros_like(angle)
    start = jnp.stack([zero] * 3 + [angle] * 3), jnp.stack([zero] * 3 + [rate] * 3)
    return Problem(
        "parallelogram",
        system=MechanicalSystem(_mass, _joints, _force, redundant=True),
        t1=t1,
        args=args,
        start=start,
        initial_state=_initial_state,
        exact=_exact,
    )
