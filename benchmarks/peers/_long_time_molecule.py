"""A rigid molecule for long runs: three atoms at fixed distances, each drawn to a place of its own."""

import jax
import jax.numpy as jnp
import numpy as np

from ._long_time_task import on_rods, Task


# The axes of the coordinates are the principal ones of the body, its center of mass is the origin.
MASSES = np.array([1.0, 1.0, 2.0])
BODY = np.array([[-0.75, -0.5, 0.0], [0.75, -0.5, 0.0], [0.0, 0.5, 0.0]])
PLACES = np.array([[-1.0, 0.0, 0.5], [1.0, -0.5, 0.0], [0.0, 0.5, -0.5]])
ATTRACTIONS = np.array([1.0, 2.0, 3.0])
VELOCITY, RATE = np.array([0.5, 0.0, 0.25]), np.array([1.0, 2.0, 0.5])


def molecule() -> Task:
    start, end = np.array([0, 1, 2]), np.array([1, 2, 0])
    v0 = VELOCITY + np.cross(RATE, BODY)

    def force(q):
        if isinstance(q, jax.Array):
            return jnp.asarray(ATTRACTIONS[:, None]) * (jnp.asarray(PLACES) - q)
        return ATTRACTIONS[:, None] * (PLACES - q)

    def energy(q, v):
        d = q - PLACES
        return (MASSES[:, None] * v * v + ATTRACTIONS[:, None] * d * d).sum((-1, -2)) / 2

    first = energy(BODY, v0)
    return on_rods(
        "molecule",
        start,
        end,
        MASSES,
        (BODY, v0),
        links=lambda q: jnp.stack([q[1] - q[0], q[2] - q[1], q[0] - q[2]]),
        force=force,
        step=2**-6,
        conserved={"energy": lambda q, v: energy(q, v) / first},
    )
