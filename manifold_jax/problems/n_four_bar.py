"""Many four-bar linkages side by side, a benchmark of multibody dynamics with singular positions."""

import math
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, integrate, Problem


Bodies: TypeAlias = Float[Array, "bodies 3"]
State: TypeAlias = tuple[Bodies, Bodies]


class NFourBarArgs(NamedTuple):
    """Parameters of `n_four_bar`: mass (kg) and length (m) of every link, and gravity (m/s^2)."""

    mass: Any
    length: Any
    gravity: Any


def _mass(q: Bodies, args: NFourBarArgs) -> Bodies:
    one = jnp.stack([args.mass, args.mass, args.mass * args.length**2 / 12])
    return jnp.broadcast_to(one, q.shape)


def _joints(t: RealScalarLike, q: Bodies, args: NFourBarArgs) -> Any:
    """Return the gaps of the joints of the crank with the ground, with the coupler before it and with
    the one after it."""
    half = 0.5 * args.length * jnp.stack([jnp.cos(q[:, 2]), jnp.sin(q[:, 2])], axis=1)
    start, end = q[:, :2] - half, q[:, :2] + half
    pivots = jnp.arange(start[::2].shape[0], dtype=q.dtype) * args.length
    ground = start[::2] - jnp.stack([pivots, jnp.zeros_like(pivots)], axis=1)
    return ground, end[1::2] - end[2::2], end[:-1:2] - start[1::2]


def _force(t: RealScalarLike, q: Bodies, v: Bodies, args: NFourBarArgs) -> Bodies:
    weight = jnp.stack([jnp.zeros_like(args.mass), -args.mass * args.gravity, 0 * args.mass])
    return jnp.broadcast_to(weight, q.shape)


def _initial_state(args: NFourBarArgs, start: State) -> State:
    """Return the state for the angle of the first crank and its rate, with the length of `args`."""
    angle, rate = start[0][0, 2], start[1][0, 2]
    return _bodies(jnp, angle, rate, args.length, start[0].shape[0] // 2)


def _bodies(xp: Any, angle: Any, rate: Any, length: Any, loops: int) -> tuple[Any, Any]:
    """Return cranks and couplers in turn, all cranks at the same angle: the last two axes."""
    c, s, zero = xp.cos(angle), xp.sin(angle), 0 * angle
    rows = lambda *parts: xp.stack([xp.stack(part, axis=-1) for part in parts], axis=-2)
    one = rows((0.5 * length * c, 0.5 * length * s, angle), (length * (c + 0.5), length * s, zero))
    v = rows((-0.5 * length * s, 0.5 * length * c, zero + 1), (-length * s, length * c, zero))
    v = rate[..., None, None] * v
    body = np.arange(2 * loops + 1)
    shift = length * xp.asarray(body // 2, length.dtype)
    shift = xp.stack([shift, 0 * shift, 0 * shift], axis=-1)
    return one[..., body % 2, :] + shift, v[..., body % 2, :]


def _exact(t: np.ndarray, args: NFourBarArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """All cranks at one angle: a pendulum with the inertia `(N + 1) m L^2 / 3 + N m L^2`."""
    loops = y0[0].shape[0] // 2
    pull = (loops + 1) / 2 + loops
    frequency2 = args.gravity * pull / (args.length * ((loops + 1) / 3 + loops))
    field = lambda _, x: (x[1], -frequency2 * math.cos(x[0]))
    states = integrate(field, [y0[0][0, 2], y0[1][0, 2]], t)
    return _bodies(np, states[:, 0], states[:, 1], args.length, loops)


def n_four_bar(
    loops: int = 40,
    *,
    mass: Any = 1.0,
    length: Any = 1.0,
    gravity: Any = 9.81,
    speed: Any = 1.0,
    t1: float = 20.0,
) -> Problem:
    r"""N four-bar linkages side by side, 2N + 1 equal links: N + 1 cranks on pivots in a row, N
    couplers between their ends.

    $q$ has a row $(x, y, \theta)$ for each link, its centre and angle, cranks and couplers in
    turn from the left; masses $(m, m, m L^2 / 12)$, gravity downwards. Joints of the cranks with the
    ground, and with the couplers before and after: 6N + 2 equations on 6N + 3 coordinates, as many on
    velocities. One degree of freedom, but N + 1 where all links are in line, which the mechanism
    passes with every half turn: there the equations depend on each other, and other motions branch
    off. At an angle $\delta$ before it the equations hold to round-off `eps` where the cranks are
    apart by `eps / delta`, which changes accelerations by some `eps / delta^3`: tolerances below about
    1e-8 may not be met, and a solve that creeps up to it, where accelerations are NaN at last, fails.
    Projected Tsit5 at 1e-8 goes through all singular positions of 20 s; the benchmark allows errors of
    1e-3 (its "high precision"), here they are 1e-4.

    The solution is an independent integration (SciPy's DOP853) of the equation of motion of one
    angle, that of all cranks, to about 1e-12:

    $$\left(\tfrac{N + 1}{3} + N\right) L \theta'' = -g \left(\tfrac{N + 1}{2} + N\right) \cos \theta.$$

    **Arguments:**

    - `loops`: their number N.
    - `mass` (kg) and `length` (m) of each link, `gravity` (m/s^2): `args`. `with_args` keeps the
        angle of the cranks and its rate.
    - `speed`: of the ends of the cranks at `t = 0` (m/s), to the right; the cranks point upwards.
    - `t1`: the end of the time span (s).

    Source: benchmark A02 of the IFToMM library of multibody benchmarks (M. Gonzalez et al., Multibody
    Syst. Dyn. 16 (2006) 19-36), N = 40 with these numbers and 20 s, from Bayo & Avello, Nonlinear
    Dyn. 5 (1994) 209-231.
    """
    if loops < 1:
        raise ValueError(f"`loops` must be at least 1, got {loops}.")
    args = NFourBarArgs(*map(as_floating, (mass, length, gravity)))
    rate = -as_floating(speed) / args.length
    return Problem(
        "n-four-bar",
        system=MechanicalSystem(_mass, _joints, _force),
        t1=t1,
        args=args,
        start=_bodies(jnp, as_floating(math.pi / 2), rate, args.length, loops),
        initial_state=_initial_state,
        exact=_exact,
    )
