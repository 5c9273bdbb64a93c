"""Mechanisms of point masses on rods for long runs: a pendulum in the plane and in space, a chain, a top."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from ._long_time_task import constant, methods_of, of_rods, on_rods, Task


GRAVITY = 9.8125  # exact in single precision, as all numbers of the pendulum are
# Of the top: the vectors between its point masses and its fixed point.
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1))
SPIN = 12.0
LINKS = 10


def pendulum() -> Task:
    """A rod of length 1 that is released in the horizontal."""
    return _pendulum("pendulum", jnp.array([1.0, 0.0]), jnp.zeros(2), {})


def spherical_pendulum() -> Task:
    """The same in space, swung sideways."""
    momentum = lambda q, v: (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]) / 2
    start = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0])
    return _pendulum("spherical pendulum", *start, {"angular momentum": momentum})


def _pendulum(name: str, q0: Any, v0: Any, conserved: dict[str, Any]) -> Task:
    """A mass on a rod; the last coordinate is the height."""
    down = np.zeros(q0.size)
    down[-1] = -GRAVITY
    system = mj.MechanicalSystem(
        1.0, lambda t, q, args: q @ q - 1, lambda t, q, v, args: constant(down, q)
    )

    def field(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[: down.size], y[down.size :]
        pull = (v @ v - GRAVITY * q[-1]) / (q @ q)
        return np.concatenate([v, down - pull * q])

    energy = lambda q, v: ((v * v).sum(-1) / 2 + GRAVITY * q[..., -1]) / GRAVITY
    return Task(
        name,
        system.terms,
        methods_of(system),
        step=2**-7,
        y0=(q0, v0),
        conserved={"energy": energy} | conserved,
        observed="energy",
        violation=lambda q, v: of_rods(q[:, None], v[:, None], np.ones(1)),
        field=field,
    )


def chain() -> Task:
    """Ten masses one below the other on rods in the plane, released at rest and bent: the angles from the vertical
    are 0.3 at the top and -0.1 at the end."""
    angles = np.linspace(0.3, -0.1, LINKS)
    q0 = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)
    height = GRAVITY * (q0[:, 1].sum() + LINKS * (LINKS + 1) / 2)  # above the lowest place
    energy = lambda q, v: ((v * v).sum((-1, -2)) / 2 + GRAVITY * q[..., 1].sum(-1)) / height
    return on_rods(
        "chain",
        np.arange(-1, LINKS - 1),
        np.arange(LINKS),
        np.ones(LINKS),
        (q0, np.zeros((LINKS, 2))),
        links=lambda q: jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2), q.dtype)),
        force=lambda q: constant(np.array([0.0, -GRAVITY]), q),
        step=2**-9,
        conserved={"energy": energy},
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
        return of_rods(q[:, j] - q[:, i], v[:, j] - v[:, i], lengths)

    kinetic = (v0 * v0).sum() / 2
    energy = lambda q, v: ((v * v).sum((-1, -2)) / 2 + GRAVITY * q[..., 2].sum(-1)) / kinetic
    vertical = lambda q, v: (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]).sum(-1)
    momentum = lambda q, v: vertical(q, v) / np.abs(vertical(q0, v0))
    y0 = jnp.asarray(q0), jnp.asarray(v0)
    system = mj.MechanicalSystem(1.0, rods, weight)
    methods = methods_of(system)
    conserved = {"energy": energy, "angular momentum": momentum}
    return Task("top", system.terms, methods, 2**-9, y0, conserved, "energy", of_points, field)
