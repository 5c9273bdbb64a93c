"""A truss of rigid bars, falling and turning."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, Problem
from ._rods import equal_masses, stretch


Joints: TypeAlias = Float[Array, "joints 2 2"]
State: TypeAlias = tuple[Joints, Joints]


class TrussArgs(NamedTuple):
    """Parameters of `falling_truss`: mass of every joint (kg), length and height of a panel (m), and
    gravity (m/s^2)."""

    mass: Any
    length: Any
    height: Any
    gravity: Any


def _bars(t: RealScalarLike, q: Joints, args: TrussArgs) -> Float[Array, " bars"]:
    """Return posts, lower and upper chord, and diagonals, by panels."""
    lower, upper = q[:, 0], q[:, 1]
    post = stretch(upper - lower, args.height**2)
    chords = (stretch(jnp.diff(chord, axis=0), args.length**2) for chord in (lower, upper))
    diagonal = stretch(upper[1:] - lower[:-1], args.length**2 + args.height**2)
    panels = jnp.stack([*chords, diagonal, post[1:]], axis=1)
    return jnp.concatenate([post[:1], panels.reshape(-1)])


def _force(t: RealScalarLike, q: Joints, v: Joints, args: TrussArgs) -> Joints:
    return jnp.broadcast_to(jnp.stack([0 * args.gravity, -args.mass * args.gravity]), q.shape)


def _initial_state(args: TrussArgs, start: State) -> State:
    """Return the state for the place, the angle and the motion in `start`, with the lengths of `args`."""
    return _moved(jnp, *_motion(jnp, start), args, start[0].shape[0])


def _motion(xp: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Return centre, velocity, angle and rate of a truss that is in shape."""
    (q, v), along = y, y[0][-1, 0] - y[0][0, 0]
    turned = v[-1, 0] - v[0, 0]
    rate = (along[0] * turned[1] - along[1] * turned[0]) / (along[0] ** 2 + along[1] ** 2)
    return q.mean((0, 1)), v.mean((0, 1)), xp.arctan2(along[1], along[0]), rate


def _moved(xp: Any, centre: Any, velocity: Any, angle: Any, rate: Any, args: Any, joints: int):
    """Return the joints of shape `(..., joints, 2, 2)`; the motion may have leading axes."""
    along, up = np.meshgrid(np.arange(joints) - (joints - 1) / 2, [-0.5, 0.5], indexing="ij")
    x = args.length * xp.asarray(along, args.length.dtype)
    y = args.height * xp.asarray(up, args.height.dtype)
    angle, rate = angle[..., None, None], rate[..., None, None]
    c, s = xp.cos(angle), xp.sin(angle)
    arm = xp.stack([c * x - s * y, s * x + c * y], axis=-1)
    turning = xp.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    centre, velocity = centre[..., None, None, :], velocity[..., None, None, :]
    return centre + arm, velocity + rate[..., None] * turning


def _exact(t: np.ndarray, args: TrussArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    centre, velocity, angle, rate = _motion(np, y0)
    down = np.array([0.0, -args.gravity])
    time = t[:, None]
    centre = centre + time * velocity + 0.5 * time**2 * down
    velocity = velocity + time * down
    return _moved(np, centre, velocity, angle + rate * t, rate + 0 * t, args, y0[0].shape[0])


def falling_truss(
    panels: int = 10,
    *,
    mass: Any = 1.0,
    length: Any = 1.0,
    height: Any = 1.0,
    gravity: Any = 9.81,
    velocity: Any = (1.0, 2.0),
    rate: Any = 0.5,
    t1: float = 2.0,
) -> Problem:
    r"""A plane truss of N panels thrown into the air, 4N + 1 rigid bars between 2N + 2 joints: two
    chords, posts, and one diagonal in each panel.

    $$m r_i'' = (0, -m g) - \sum_k \pm \lambda_k d_k, \qquad
    \tfrac12 (|d_k|^2 - L_k^2) = 0,$$

    $q$ of shape `(N + 1, 2, 2)`: panel points, lower and upper chord, x and y. The bars are as
    many as keep the truss in shape, so that it moves like one rigid body, three degrees of
    freedom of 4N + 4. Their equations become ill conditioned like $N^4$, as long trusses bend easily.

    The solution is exact: the centre falls freely, and the truss turns at a constant rate.

    **Arguments:**

    - `panels`: their number N.
    - `mass` (kg) of each joint, `length` and `height` (m) of the panels, `gravity` (m/s^2): `args`.
        `with_args` keeps the centre, the angle and the motion.
    - `velocity` (m/s) of the centre and `rate` (radian/s) at `t = 0`; the truss is level then.
    - `t1`: the end of the time span (s).

    Source: classical.
    """
    if panels < 1:
        raise ValueError(f"`panels` must be at least 1, got {panels}.")
    args = TrussArgs(*map(as_floating, (mass, length, height, gravity)))
    motion = jnp.zeros(2), as_floating(velocity), jnp.asarray(0.0), as_floating(rate)
    return Problem(
        "falling-truss",
        system=MechanicalSystem(equal_masses, _bars, _force),
        t1=t1,
        args=args,
        start=_moved(jnp, *motion, args, panels + 1),
        initial_state=_initial_state,
        exact=_exact,
    )
