"""What `benchmarks.peers.neural` learns: two systems, laws of their data, and what is known of them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


@dataclasses.dataclass(frozen=True)
class System:
    """A vector field to be learned from orbits, and a quantity that is known to be conserved.

    - `inputs`, `outputs`: of the network.
    - `field`: `(t, y, network)`, where the network stands for what is not known.
    - `conserved`: `(t, y, args)`; also for NumPy.
    - `span`: of the orbits learned from, sampled every `interval`.
    - `orbit`: the exact solution `(times, states)` for one draw of the random start.
    """

    name: str
    inputs: int
    outputs: int
    field: Callable[[Any, Any, Any], Any]
    conserved: Callable[[Any, Any, Any], Any]
    span: float
    interval: float
    draw: Callable[[np.random.Generator], float]
    orbit: Callable[[float, np.ndarray], np.ndarray]

    def orbits(self, random: np.random.Generator, count: int, times: np.ndarray) -> np.ndarray:
        """Shape `(count, times, n)`."""
        return np.stack([self.orbit(self.draw(random), times) for _ in range(count)])


def _two_body_orbit(eccentricity: float, times: np.ndarray) -> np.ndarray:
    problem = mj.problems.kepler()
    args = problem.args._replace(eccentricity=jnp.asarray(eccentricity))
    return np.concatenate(problem.with_args(args).reference(times), axis=1)


def _rigid_body_orbit(angle: float, times: np.ndarray) -> np.ndarray:
    start = (np.cos(angle), 0.0, np.sin(angle))
    return mj.problems.rigid_body(inertia=(1.6, 1.0, 2 / 3), y0=start).reference(times)


# Relative motion of two bodies from perihelion: the acceleration is learned. One revolution
# of a semi-major axis 1 takes 2 pi.
TWO_BODY = System(
    name="two-body",
    inputs=4,
    outputs=2,
    field=lambda t, y, network: jnp.concatenate([y[2:], network(y)]),
    conserved=lambda t, y, args: y[0] * y[3] - y[1] * y[2],
    span=2 * np.pi,
    interval=0.1,
    draw=lambda random: random.uniform(0.5, 0.7),
    orbit=_two_body_orbit,
)

# Euler's equations: all of the vector field is learned, its Casimir is known.
RIGID_BODY = System(
    name="rigid-body",
    inputs=3,
    outputs=3,
    field=lambda t, y, network: network(y),
    conserved=lambda t, y, args: (y * y).sum() / 2,
    span=15.0,
    interval=0.1,
    draw=lambda random: random.uniform(0.5, 1.5),
    orbit=_rigid_body_orbit,
)

SYSTEMS = {system.name: system for system in (TWO_BODY, RIGID_BODY)}


def windows(orbits: np.ndarray, length: int) -> jax.Array:
    """Every piece of `length` intervals, shape `(pieces, length + 1, n)`."""
    pieces = np.lib.stride_tricks.sliding_window_view(orbits, length + 1, axis=1)
    return jnp.asarray(np.moveaxis(pieces, -1, 2).reshape(-1, length + 1, orbits.shape[-1]))
