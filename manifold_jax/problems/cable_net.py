"""A net of inextensible cables, hung up by its corners."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, Problem
from ._rods import equal_masses, Rods, solve_rods, stretch


Knots: TypeAlias = Float[Array, "rows columns 3"]
State: TypeAlias = tuple[Knots, Knots]

_CORNERS = np.array([0, 0, -1, -1]), np.array([0, -1, 0, -1])


class CableNetArgs(NamedTuple):
    """Parameters of `cable_net`: mass of every knot (kg), length of every cable between two of them
    (m), the distance of neighbouring knots in plan at the start over that length, and gravity (m/s^2)."""

    mass: Any
    length: Any
    spacing: Any
    gravity: Any


def _cables(t: RealScalarLike, q: Knots, args: CableNetArgs) -> Any:
    corners = q[_CORNERS] - _folded(jnp, q.shape, args)[_CORNERS]
    return tuple(stretch(jnp.diff(q, axis=axis), args.length**2) for axis in (0, 1)), corners


def _force(t: RealScalarLike, q: Knots, v: Knots, args: CableNetArgs) -> Knots:
    weight = jnp.zeros(3).at[2].set(-1.0) * args.mass * args.gravity
    return jnp.broadcast_to(weight.astype(q.dtype), q.shape)


def _folded(xp: Any, shape: Any, args: CableNetArgs) -> Any:
    """Place neighbours alternately up and down, so that all cables have their length."""
    i, j = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    i, j, up = (xp.asarray(part, args.length.dtype) for part in (i, j, (i + j) % 2))
    step, rise = args.length * args.spacing, args.length * xp.sqrt(1 - args.spacing**2)
    return xp.stack([i * step, j * step, up * rise], axis=-1)


def _initial_state(args: CableNetArgs, start: State) -> State:
    """Return the folded net at rest, with as many knots."""
    q = _folded(jnp, start[0].shape, args)
    return q, jnp.zeros_like(q)


def _exact(t: np.ndarray, args: CableNetArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    q, v = y0
    shape = q.shape
    knots = np.arange(shape[0] * shape[1]).reshape(shape[:2])
    start = np.concatenate([knots[:-1].ravel(), knots[:, :-1].ravel()])
    end = np.concatenate([knots[1:].ravel(), knots[:, 1:].ravel()])
    inverse = np.full(shape[:2], 1 / args.mass)
    inverse[_CORNERS] = 0.0
    weight = np.array([0.0, 0.0, -args.mass * args.gravity])
    force = lambda q: np.broadcast_to(weight, q.shape)
    rods = Rods.between(start, end, inverse.ravel())
    q, v = solve_rods(rods, force, t, q.reshape(-1, 3), v.reshape(-1, 3))
    return q.reshape(t.size, *shape), v.reshape(t.size, *shape)


def cable_net(
    rows: int = 5,
    columns: int = 5,
    *,
    mass: Any = 1.0,
    length: Any = 1.0,
    spacing: Any = 0.9,
    gravity: Any = 9.81,
    t1: float = 0.5,
) -> Problem:
    r"""A net of inextensible cables between knots in rows and columns, hung up by its four corners
    and released in folds.

    $$m r_{ij}'' = (0, 0, -m g) - \sum_k \pm \lambda_k d_k, \qquad
    \tfrac12 (|d_k|^2 - L^2) = 0$$

    for the cables between neighbours, and the corners held where they are. $q$ has the shape
    `(rows, columns, 3)`, with z upwards. `rows (columns - 1) + columns (rows - 1) + 12` equations,
    as many on velocities: in the plane of the net each has up to six neighbours, so that
    $J M^{-1} J^T$ has a band as wide as about twice the shorter side of the net.

    The solution is an independent integration (SciPy's DOP853) of the same equations with banded
    solves, not projected, to about 1e-12. Nets become taut with a jerk, after about one second: cables
    push as well as pull here.

    **Arguments:**

    - `rows`, `columns`: of knots, two or more.
    - `mass` (kg) of every knot, `length` (m) of every cable, `spacing` of the knots in plan over
        that length, at the start and of the corners for ever, and `gravity` (m/s^2): `args`.
        `with_args` folds the net anew, also instead of an initial state of yours.
    - `t1`: the end of the time span (s).

    Source: classical.
    """
    if rows < 2 or columns < 2:
        raise ValueError(f"`rows` and `columns` must be at least 2, got {rows} and {columns}.")
    args = CableNetArgs(*map(as_floating, (mass, length, spacing, gravity)))
    return Problem(
        "cable-net",
        system=MechanicalSystem(equal_masses, _cables, _force),
        t1=t1,
        args=args,
        start=(jnp.zeros((rows, columns, 3)), jnp.zeros((rows, columns, 3))),
        initial_state=_initial_state,
        exact=_exact,
    )
