"""Problems for long runs, their methods at similar cost, and what is known of their solutions: two mechanisms of
point masses on rods, and a planet."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


GRAVITY = 9.8125  # exact in single precision, as all numbers of the pendulum are
# Of the top: the vectors between its point masses and its fixed point.
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1))
SPIN = 12.0


class Task(NamedTuple):
    """A problem; states have leading axes of times. `methods` are solvers, and how many times `step` their
    steps are, a power of two for single precision. `energy` and `momentum` are relative, `violation`
    is that of the constraint."""

    name: str
    terms: Any
    methods: dict[str, tuple[int, Any]]
    step: float
    y0: Any
    energy: Callable[[Any, Any], Any]
    momentum: Callable[[Any, Any], Any] | None
    observed: str  # of these two, the one that no equation prescribes
    violation: Callable[[Any, Any], Any]
    field: Callable[[float, np.ndarray], np.ndarray]  # for SciPy, (q, v) as one vector


def _methods(system: mj.MechanicalSystem) -> dict[str, tuple[int, Any]]:
    """Steps in proportion to their evaluations of forces. RATTLE takes over one from the step before."""
    return {
        "RATTLE 2": (1, mj.rattle(system)),
        "RATTLE 4": (5, mj.rattle(system, order=4)),
        "RATTLE 6": (9, mj.rattle(system, order=6)),
        "projected Dopri5": (6, mj.Projected(dfx.Dopri5(), system.constraint)),
        "projected Dopri8": (12, mj.Projected(dfx.Dopri8(), system.constraint)),
    }


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
    methods = _methods(system)
    return Task(
        "pendulum", system.terms, methods, 2**-7, y0, energy, None, "energy", violation, field
    )


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
    methods = _methods(system)
    return Task(
        "top", system.terms, methods, 2**-9, y0, energy, momentum, "energy", of_points, field
    )


def planet() -> Task:
    """Kepler's ellipse of eccentricity 0.6 on the shell of its energy. The angular momentum is not constrained."""

    def gravity(t: Any, y: Any, args: Any) -> Any:
        q, v = y
        return v, -q / jnp.sum(q * q) ** 1.5

    def field(t: float, y: np.ndarray) -> np.ndarray:
        cube = (y[0] * y[0] + y[1] * y[1]) ** 1.5
        return np.array([y[2], y[3], -y[0] / cube, -y[1] / cube])

    energy = lambda q, v: (v * v).sum(-1) - 2 / (q * q).sum(-1) ** 0.5
    momentum = lambda q, v: (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]) / 0.8
    y0 = jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0])
    shell = mj.Invariants(lambda t, y, args: energy(*y), y0=y0)
    methods = {
        "symmetric 2": (2, mj.SymmetricProjection(shell)),
        "symmetric 4": (8, mj.SymmetricProjection(shell, order=4)),
        "symmetric 6": (16, mj.SymmetricProjection(shell, order=6)),
        "projected Dopri5": (8, mj.Projected(dfx.Dopri5(), shell)),
        "projected Dopri8": (16, mj.Projected(dfx.Dopri8(), shell)),
    }
    violation = lambda q, v: np.abs(energy(q, v) + 1)
    terms = dfx.ODETerm(gravity)
    return Task("planet", terms, methods, 2**-7, y0, energy, momentum, "momentum", violation, field)


def _of_rods(d: Any, rate: Any, lengths: np.ndarray) -> np.ndarray:
    """Return for all times the largest `||d| / L - 1|` and `|d . d'| / (L max(|d'|, 1))`."""
    stretch = np.abs(np.linalg.norm(d, axis=-1) / lengths - 1)
    speed = np.maximum(np.linalg.norm(rate, axis=-1), 1)
    slip = np.abs((d * rate).sum(-1)) / (lengths * speed)
    return np.maximum(stretch, slip).max(-1)
