"""Chains of point masses on rigid links, the double pendulum among them."""

import math
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import integrate, Problem, repeated


Points: TypeAlias = Float[Array, " n"]
State: TypeAlias = tuple[Points, Points]


class ChainArgs(NamedTuple):
    """Parameters of `chain` and `double_pendulum` with N links: masses (kg) and lengths (m) from
    the support downwards, shape `(N,)` each, and gravity (m/s^2)."""

    masses: Any
    lengths: Any
    gravity: Any


def _links(points: Points) -> Float[Array, "N 2"]:
    """Return the links from the points `(x1, y1, x2, y2, ...)` to the vectors between them."""
    return jnp.diff(points.reshape(-1, 2), axis=0, prepend=jnp.zeros((1, 2), points.dtype))


def _points(links: Float[Array, "N 2"]) -> Points:
    return jnp.cumsum(links, axis=0).reshape(-1)


def _mass(q: Points, args: ChainArgs) -> Points:
    return jnp.broadcast_to(args.masses[:, None], (*args.masses.shape, 2)).reshape(-1)


def _rods(t: RealScalarLike, q: Points, args: ChainArgs) -> Float[Array, " N"]:
    # For a sum over an axis XLA would call a library, which does not fuse with the rest.
    x, y = _links(q).T
    return 0.5 * (x * x + y * y - args.lengths**2)


def _force(t: RealScalarLike, q: Points, v: Points, args: ChainArgs) -> Points:
    weights = -args.masses * args.gravity
    return jnp.stack([jnp.zeros_like(weights), weights], axis=1).reshape(-1)


def _initial_state(args: ChainArgs, start: State) -> State:
    """Return the state for the angles of the links and their rates, with the lengths of `args`."""
    links, rates = _links(start[0]), _links(start[1])
    stretch = (args.lengths / jnp.sqrt(jnp.sum(links * links, axis=1)))[:, None]
    return _points(stretch * links), _points(stretch * rates)


def _exact(t: np.ndarray, args: ChainArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the equations of motion of the angles `p_i` of the links from the downward vertical,
    with the mass `M_i` that link `i` carries, `M_ij = M_max(i,j)`, and the lengths `L_i`:

    sum_j M_ij L_i L_j (cos(p_i - p_j) p_j'' + sin(p_i - p_j) p_j'^2) = -g M_i L_i sin p_i.
    """
    L = args.lengths
    carried = np.cumsum(args.masses[::-1])[::-1]
    n = L.size
    inertia = np.minimum.outer(carried, carried) * np.outer(L, L)
    torque = -args.gravity * carried * L

    def field(t, x):
        difference = x[:n, None] - x[None, :n]
        right = torque * np.sin(x[:n]) - (inertia * np.sin(difference)) @ x[n:] ** 2
        return np.concatenate([x[n:], np.linalg.solve(inertia * np.cos(difference), right)])

    links, rates = (np.diff(part.reshape(-1, 2), axis=0, prepend=0.0) for part in y0)
    angle = np.arctan2(links[:, 0], -links[:, 1])
    turning = (rates[:, 0] * np.cos(angle) + rates[:, 1] * np.sin(angle)) / L
    angle, turning = np.split(integrate(field, np.concatenate([angle, turning]), t), 2, axis=1)
    s, c = np.sin(angle), np.cos(angle)
    q = np.cumsum(np.stack([L * s, -L * c], axis=-1), axis=1)
    v = np.cumsum(np.stack([L * turning * c, L * turning * s], axis=-1), axis=1)
    return q.reshape(t.size, -1), v.reshape(t.size, -1)


def double_pendulum(
    *,
    masses: Any = (1.0, 1.0),
    lengths: Any = (1.0, 1.0),
    gravity: Any = 9.81,
    angles: Any = (math.pi / 4, -math.pi / 4),
    rates: Any = (0.0, 0.0),
    t1: float = 5.0,
) -> Problem:
    r"""The planar double pendulum in Cartesian coordinates, two point masses on rigid rods:

    $$m_i r_i'' = (0, -m_i g) - \lambda_i d_i + \lambda_{i+1} d_{i+1}, \quad
    \tfrac12 (|d_i|^2 - L_i^2) = 0, \quad d_1 = r_1, \quad d_2 = r_2 - r_1,$$

    with y upwards and the support at the origin; $\lambda_i L_i$ is the tension in rod i.
    The state is `(q, v)`, `q = (x1, y1, x2, y2)`; four constraints, two positions and two
    velocities. Energy is conserved but not enforced.

    The solution is an independent integration (SciPy's DOP853) of the equations of motion of the two
    angles, from every initial state on the manifold. Standard problem: to about 1e-12. The motion is
    chaotic when the pendulum goes over the top: no digits are left after long times then.

    **Arguments:**

    - `masses` (kg), `lengths` (m), shape `(2,)`, and `gravity` (m/s^2): `args`. `with_args`
        keeps the angles of the rods and their rates, also those of an initial state of yours.
    - `angles`: of the rods at `t = 0` from the downward vertical (radian), shape `(2,)`.
    - `rates`: their rates (radian/s), shape `(2,)`.
    - `t1`: the end of the time span (s).

    Source: classical.
    """
    return _build("double-pendulum", 2, (masses, lengths, gravity), angles, rates, t1)


def chain(
    links: int = 3,
    *,
    masses: Any = 1.0,
    lengths: Any = 1.0,
    gravity: Any = 9.81,
    angles: Any = None,
    rates: Any = 0.0,
    t1: float = 5.0,
) -> Problem:
    r"""A chain of N point masses on rigid links hanging from the origin, to be scaled up.

    In Cartesian coordinates, $d_i = r_i - r_{i-1}$ being link i, $r_0 = 0$, y upwards:

    $$m_i r_i'' = (0, -m_i g) - \lambda_i d_i + \lambda_{i+1} d_{i+1}, \quad
    \tfrac12 (|d_i|^2 - L_i^2) = 0, \quad \lambda_{N+1} = 0.$$

    The state is `(q, v)`, `q = (x1, y1, ..., xN, yN)`; 2N constraints, N positions and N velocities.
    The matrix $J M^{-1} J^T$ is tridiagonal. For small angles and equal links the frequencies are
    $(g x_k / L)^{1/2}$ with the zeros $x_k$ of the Laguerre polynomial of degree N.

    The solution is an independent integration (SciPy's DOP853) of the equations of motion
    of the N angles, from every initial state on the manifold. Standard problem: to about
    1e-12. From violent starts (a horizontal chain) the motion is chaotic.

    **Arguments:**

    - `links`: their number N.
    - `masses` (kg), `lengths` (m), scalars or of shape `(N,)`, and `gravity` (m/s^2): `args`.
        `with_args` keeps the angles of the links and their rates, also those of an initial
        state of yours.
    - `angles`: of the links at `t = 0` from the downward vertical (radian), by default
        folded, `pi/4, -pi/4, pi/4, ...`; a scalar for a straight chain.
    - `rates`: their rates (radian/s).
    - `t1`: the end of the time span (s).

    Source: classical (for small angles D. Bernoulli, 1733).
    """
    angles = math.pi / 4 * (-1.0) ** np.arange(links) if angles is None else angles
    return _build("chain", links, (masses, lengths, gravity), angles, rates, t1)


def _build(name: str, links: int, args: tuple, angles: Any, rates: Any, t1: float) -> Problem:
    per_link = lambda value, what: repeated(value, links, what, ", one per link")
    masses, lengths = per_link(args[0], "masses"), per_link(args[1], "lengths")
    angles, rates = per_link(angles, "angles"), per_link(rates, "rates")
    s, c = jnp.sin(angles), jnp.cos(angles)
    positions, velocities = jnp.stack([s, -c], axis=1), jnp.stack([rates * c, rates * s], axis=1)
    return Problem(
        name,
        system=MechanicalSystem(_mass, _rods, _force),
        t1=t1,
        args=ChainArgs(masses, lengths, args[2]),
        start=(_points(positions), _points(velocities)),
        initial_state=_initial_state,
        exact=_exact,
    )
