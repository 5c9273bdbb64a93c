"""Two mechanisms of point masses on rods for long runs, and what is known of their solutions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


GRAVITY = 9.8125  # exact in single precision, as all numbers of the pendulum are
# Of the top: the vectors between its point masses and its fixed point.
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1))
SPIN = 12.0


class Task(NamedTuple):
    """A mechanism with masses 1; states have leading axes of times. `step` is that of one evaluation of
    forces, a power of two for single precision. `energy` is relative to that of the motion,
    `momentum` is conserved, too, and `violation` is relative to lengths and speeds."""

    name: str
    system: mj.MechanicalSystem
    step: float
    y0: Any
    energy: Callable[[Any, Any], Any]
    momentum: Callable[[Any, Any], Any] | None
    violation: Callable[[Any, Any], Any]
    field: Callable[[float, np.ndarray], np.ndarray]  # for SciPy, (q, v) as one vector


def pendulum() -> Task:
    """A rod of length 1 that is released in the horizontal."""
    weight = lambda t, q, v, args: jnp.stack([jnp.zeros_like(q[0]), -GRAVITY * jnp.ones_like(q[1])])
    system = mj.MechanicalSystem(1.0, lambda t, q, args: q @ q - 1, weight)

    def field(t: float, y: np.ndarray) -> np.ndarray:
        x, z, vx, vz = y
        pull = (vx * vx + vz * vz - GRAVITY * z) / (x * x + z * z)
        return np.array([vx, vz, -pull * x, -pull * z - GRAVITY])

    energy = lambda q, v: ((v * v).sum(-1) / 2 + GRAVITY * q[..., 1]) / GRAVITY
    violation = lambda q, v: _of_rods(q[:, None], v[:, None], np.ones(1))
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)
    return Task("pendulum", system, 2**-7, y0, energy, None, violation, field)


def _vectors(q: Any) -> Any:
    """Of the rods of the top."""
    points = jnp.concatenate([jnp.zeros((1, 3), q.dtype), q])
    return jnp.stack([points[j] - points[i] for i, j in PAIRS])


def top() -> Task:
    """A symmetric heavy top: three point masses and its fixed point are the corners of a pyramid of rods. It
    is released tilted, turning about its axis."""
    angles = 2 * np.pi * np.arange(3) / 3
    body = np.stack([0.5 * np.cos(angles), 0.5 * np.sin(angles), np.full(3, 0.75)], axis=1)
    turn = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    q0 = body @ turn.T
    v0 = np.cross(SPIN * turn[:, 2], q0)
    lengths = np.linalg.norm(np.asarray(_vectors(jnp.asarray(q0))), axis=1)
    rods = lambda t, q, args: jnp.sum(_vectors(q) ** 2, axis=1) - lengths.astype(q.dtype) ** 2
    weight = lambda t, q, v, args: jnp.broadcast_to(
        jnp.array([0.0, 0.0, -GRAVITY], q.dtype), q.shape
    )

    def field(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y.reshape(2, 3, 3)
        J, bias = np.zeros((6, 3, 3)), np.empty(6)
        for row, (i, j) in enumerate(PAIRS):
            d, rate = q[j - 1].copy(), v[j - 1].copy()
            if i > 0:
                d -= q[i - 1]
                rate -= v[i - 1]
                J[row, i - 1] = -d
            J[row, j - 1] = d
            bias[row] = rate @ rate
        J = J.reshape(6, 9)
        free = np.tile([0.0, 0.0, -GRAVITY], 3)
        forces = np.linalg.solve(J @ J.T, J @ free + bias)
        return np.concatenate([y[9:], free - J.T @ forces])

    def of_points(q: Any, v: Any) -> Any:
        origin = lambda x: np.concatenate([np.zeros((len(x), 1, 3)), x], axis=1)
        i, j = np.array(PAIRS).T
        q, v = origin(q), origin(v)
        return _of_rods(q[:, j] - q[:, i], v[:, j] - v[:, i], lengths)

    kinetic = (v0 * v0).sum() / 2
    energy = lambda q, v: ((v * v).sum((-1, -2)) / 2 + GRAVITY * q[..., 2].sum(-1)) / kinetic
    vertical = lambda q, v: (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]).sum(-1)
    momentum = lambda q, v: vertical(q, v) / np.abs(vertical(q0, v0))
    y0 = jnp.asarray(q0), jnp.asarray(v0)
    system = mj.MechanicalSystem(1.0, rods, weight)
    return Task("top", system, 2**-9, y0, energy, momentum, of_points, field)


def _of_rods(d: Any, rate: Any, lengths: np.ndarray) -> np.ndarray:
    """Return for all times the largest `||d| / L - 1|` and `|d . d'| / (L max(|d'|, 1))`."""
    stretch = np.abs(np.linalg.norm(d, axis=-1) / lengths - 1)
    speed = np.maximum(np.linalg.norm(rate, axis=-1), 1)
    slip = np.abs((d * rate).sum(-1)) / (lengths * speed)
    return np.maximum(stretch, slip).max(-1)
