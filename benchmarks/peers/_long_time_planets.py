"""Planets for long runs: one on the shell of its energy, and those of the outer solar system at constant distances."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj
from manifold_jax.problems._rods import allowed, Rods

from ._long_time_task import on_rods, Task


# Sun (with the inner planets), Jupiter, Saturn, Uranus, Neptune, Pluto, on September 5, 1994, in astronomical
# units and days: Hairer, Lubich & Wanner, Geometric Numerical Integration (2006), section I.2.4.
DAYS = 365.25  # in the unit of time here
GRAVITATION = 2.95912208286e-4 * DAYS**2
MASSES = np.array(
    [
        1.00000597682,
        0.000954786104043,
        0.000285583733151,
        0.0000437273164546,
        0.0000517759138449,
        1 / 1.3e8,
    ]
)
POSITIONS = np.array(
    [
        [0.0, 0.0, 0.0],
        [-3.5023653, -3.8169847, -1.5507963],
        [9.0755314, -3.0458353, -1.6483708],
        [8.3101420, -16.2901086, -7.2521278],
        [11.4707666, -25.7294829, -10.8169456],
        [-15.5387357, -25.2225594, -3.1902382],
    ]
)
VELOCITIES = DAYS * np.array(
    [
        [0.0, 0.0, 0.0],
        [0.00565429, -0.00412490, -0.00190589],
        [0.00168318, 0.00483525, 0.00192462],
        [0.00354178, 0.00137102, 0.00055029],
        [0.00288930, 0.00114527, 0.00039677],
        [0.00276725, -0.00170702, -0.00136504],
    ]
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
    conserved = {"energy": energy, "angular momentum": momentum}
    return Task(
        "planet",
        dfx.ODETerm(gravity),
        methods,
        2**-7,
        y0,
        conserved,
        "angular momentum",
        violation,
        field,
    )


def solar_system() -> Task:
    """A rod between the Sun and each planet keeps its distance; initial velocities are the nearest that rods allow,
    in the metric of the masses. The pull of the Sun along the rods does no work; planets disturb each other."""
    sun, planets = np.zeros(5, int), np.arange(1, 6)
    q0 = POSITIONS
    v0 = allowed(Rods.between(sun, planets, 1 / MASSES), q0, VELOCITIES)
    v0 -= MASSES @ v0 / MASSES.sum()  # the center of mass rests
    i, j = np.triu_indices(6, 1)
    weights = GRAVITATION * MASSES[i] * MASSES[j]

    def force(q):
        xp = jnp if isinstance(q, jax.Array) else np
        d = q[None, :] - q[:, None]
        squares = (d * d).sum(-1) + np.eye(6)
        pull = GRAVITATION * MASSES[:, None] * MASSES / (squares * xp.sqrt(squares))
        return (pull[..., None] * d).sum(1)

    def energy(q, v):
        kinetic = (MASSES[:, None] * v * v).sum((-1, -2)) / 2
        return kinetic - (weights / np.linalg.norm(q[..., i, :] - q[..., j, :], axis=-1)).sum(-1)

    linear = lambda q, v: (MASSES[:, None] * v).sum(-2)
    angular = lambda q, v: np.cross(q, MASSES[:, None] * v).sum(-2)
    kinetic = (MASSES[:, None] * v0 * v0).sum() / 2
    speed, spin = np.abs(MASSES[:, None] * v0).sum(), np.linalg.norm(angular(q0, v0))
    return on_rods(
        "solar system",
        sun,
        planets,
        MASSES,
        (q0, v0),
        links=lambda q: q[1:] - q[:1],
        force=force,
        step=2**-5,
        conserved={
            "energy": lambda q, v: energy(q, v) / kinetic,
            "angular momentum": lambda q, v: angular(q, v) / spin,
            "linear momentum": lambda q, v: linear(q, v) / speed,
        },
    )
