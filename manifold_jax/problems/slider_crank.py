"""A slider-crank with a spring and a damper."""

import math
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import integrate, Problem


Vector: TypeAlias = Float[Array, "3"]
State: TypeAlias = tuple[Vector, Vector]

# (crank angle, slider position, rod angle) for the standard parameters at t = 2, 6 and 10.
# Source: SUNDIALS, printed output of examples/idas/serial/idasSlCrank_dns.c (5 digits).
PUBLISHED = {
    2.0: (0.57904, 1.3803, -0.27714),
    6.0: (-1.1080, 1.1176, 0.46386),
    10.0: (1.2757, 1.0236, -0.49881),
}


class SliderCrankArgs(NamedTuple):
    """Parameters of `slider_crank`, all dimensionless as in the source."""

    stiffness: Any = 1.0
    damping: Any = 1.0
    spring_length: Any = 1.0
    push: Any = 1.0
    crank_length: Any = 0.5
    crank_inertia: Any = 1.0
    slider_mass: Any = 1.0
    rod_inertia: Any = 2.0


def _mass(q: Vector, args: SliderCrankArgs) -> Vector:
    return jnp.stack([args.crank_inertia, args.slider_mass, args.rod_inertia])


def _linkage(t: RealScalarLike, q: Vector, args: SliderCrankArgs) -> Float[Array, "2"]:
    crank, x, rod = q[0], q[1], q[2]
    a = args.crank_length
    return jnp.stack([x - jnp.cos(rod) - a * jnp.cos(crank), -jnp.sin(rod) - a * jnp.sin(crank)])


def _force(t: RealScalarLike, q: Vector, v: Vector, args: SliderCrankArgs) -> Vector:
    crank, x, rod = q[0], q[1], q[2]
    half = 0.5 * args.crank_length
    # from the middle of the crank to the middle of the rod
    dx = x - 0.5 * jnp.cos(rod) - half * jnp.cos(crank)
    dy = -0.5 * jnp.sin(rod) - half * jnp.sin(crank)
    length = jnp.sqrt(dx**2 + dy**2)
    of_crank = half * (dx * jnp.sin(crank) - dy * jnp.cos(crank))
    of_rod = 0.5 * (dx * jnp.sin(rod) - dy * jnp.cos(rod))
    direction = jnp.stack([of_crank, dx, of_rod]) / length  # d length / dq
    tension = args.stiffness * (length - args.spring_length)
    tension = tension + args.damping * jnp.sum(direction * v)
    push = jnp.stack([jnp.zeros_like(args.push), args.push, -args.push * jnp.sin(rod)])
    return push - tension * direction


def _initial_state(args: SliderCrankArgs, start: State | None) -> State:
    """Return the state at rest, crank upright, or that for the crank's angle and rate in `start`."""
    a = args.crank_length
    if start is None:
        crank, rate, rod = jnp.full_like(a, math.pi / 2), jnp.zeros_like(a), jnp.zeros_like(a)
    else:
        crank, rate, rod = start[0][0], start[1][0], start[0][2]
    side = jnp.sign(jnp.cos(rod))
    x, principal, x1, rod1, _, _ = _configuration(jnp, crank, a, side)
    rod = principal + 2 * math.pi * jnp.round((rod - principal) / (2 * math.pi))
    return jnp.stack([crank, x, rod]), jnp.stack([rate, x1 * rate, rod1 * rate])


def _configuration(xp: ModuleType, crank: Any, a: Any, side: Any) -> tuple[Any, ...]:
    """Return slider and rod for a crank angle, then their first and second derivatives with respect to
    it, in NumPy or JAX; `side` is the sign of the cosine of the rod's angle."""
    s, c = xp.sin(crank), xp.cos(crank)
    sin_rod = -a * s
    cos_rod = side * xp.sqrt(1 - sin_rod**2)
    rod = side * xp.arcsin(sin_rod) + (1 - side) * math.pi / 2
    rod1 = -a * c / cos_rod
    rod2 = (a * s + sin_rod * rod1**2) / cos_rod
    x1 = -a * s - sin_rod * rod1
    x2 = -a * c - cos_rod * rod1**2 - sin_rod * rod2
    return a * c + cos_rod, rod, x1, rod1, x2, rod2


def _exact(t: np.ndarray, args: SliderCrankArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the equation of motion of the crank angle, `B = dq / d crank`:

    (B.M B) crank'' = B.Q - (B.M dB/d crank) crank'^2.
    """
    k, c, l0, push, a, *masses = (float(p) for p in args)
    (crank0, _, rod0), (rate0, _, _) = y0
    side = np.sign(np.cos(rod0))
    turns = np.round((rod0 - _configuration(np, crank0, a, side)[1]) / (2 * np.pi))

    def field(t, state):
        crank, rate = state
        x, rod, x1, rod1, x2, rod2 = _configuration(np, crank, a, side)
        # the spring, and its rate of change along the motion
        dx = x - 0.5 * np.cos(rod) - 0.5 * a * np.cos(crank)
        dx1 = x1 + 0.5 * np.sin(rod) * rod1 + 0.5 * a * np.sin(crank)
        dy = -0.5 * np.sin(rod) - 0.5 * a * np.sin(crank)
        dy1 = -0.5 * np.cos(rod) * rod1 - 0.5 * a * np.cos(crank)
        length = np.sqrt(dx**2 + dy**2)
        length1 = (dx * dx1 + dy * dy1) / length
        force = push * (x1 - np.sin(rod) * rod1)
        force = force - (k * (length - l0) + c * length1 * rate) * length1
        inertia = masses[0] + masses[1] * x1**2 + masses[2] * rod1**2
        bias = (masses[1] * x1 * x2 + masses[2] * rod1 * rod2) * rate**2
        return rate, (force - bias) / inertia

    crank, rate = integrate(field, (crank0, rate0), t).T
    x, rod, x1, rod1, _, _ = _configuration(np, crank, a, side)
    q = np.stack([crank, x, rod + 2 * np.pi * turns], axis=-1)
    return q, np.stack([rate, x1 * rate, rod1 * rate], axis=-1)


def slider_crank(
    *,
    stiffness: Any = 1.0,
    damping: Any = 1.0,
    spring_length: Any = 1.0,
    push: Any = 1.0,
    crank_length: Any = 0.5,
    crank_inertia: Any = 1.0,
    slider_mass: Any = 1.0,
    rod_inertia: Any = 2.0,
    t1: float = 10.0,
) -> Problem:
    r"""A slider-crank with a spring and a damper between crank and rod.

    $q = (\alpha, x, \beta)$ are the crank's angle, the slider's position and the rod's angle;
    the rod has length 1:

    $$(J_1 \alpha'', m_2 x'', J_2 \beta'') = Q - J^T \lambda, \quad
    x = a \cos\alpha + \cos\beta, \quad a \sin\alpha + \sin\beta = 0,$$

    $$Q = -(k (l - l_0) + c\, l')\, \partial l / \partial q + (0, F, -F \sin\beta),$$

    with $l(q)$ the distance between the middles of crank and rod. The state is `(q, v)`,
    each of shape `(3,)`; four constraints, two positions and two velocities. From rest
    with the crank upright, $\alpha = \pi/2$, to `t = 10`.

    The solution is an independent integration (SciPy's DOP853) of the equation of motion of the crank's
    angle alone, to about 1e-13, from every initial state on the manifold. The source prints 5 digits at
    `t = 2, 6, 10` (`from manifold_jax.problems.slider_crank import PUBLISHED`).

    **Arguments:**

    - `stiffness` k, `damping` c and `spring_length` l0 of the spring, `push` F on the slider,
        `crank_length` a < 1, `crank_inertia` J1, `slider_mass` m2, `rod_inertia` J2: scalars, `args`.
        `with_args` keeps the crank's angle and rate, also those of an initial state of yours.
    - `t1`: the end of the time span.

    A known trap: the source prints the integral of the kinetic energy over the time span
    as 3.33661606629, of which 5 digits are right (3.3366067995).

    Source: SUNDIALS (Hindmarsh et al.), examples idasSlCrank.
    """
    args = SliderCrankArgs(
        stiffness,
        damping,
        spring_length,
        push,
        crank_length,
        crank_inertia,
        slider_mass,
        rod_inertia,
    )
    return Problem(
        "slider-crank",
        system=MechanicalSystem(_mass, _linkage, _force),
        t1=t1,
        args=args,
        initial_state=_initial_state,
        exact=_exact,
    )
