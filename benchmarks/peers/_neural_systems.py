"""What `benchmarks.peers.neural` learns: three systems, laws of their data, and what is known of them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import manifold_jax as mj


@dataclasses.dataclass(frozen=True)
class Published:
    """Means over orbits and times of the relative errors of a stabilized network, and the figure they are read from."""

    error: float
    violation: float
    source: str


@dataclasses.dataclass(frozen=True)
class System:
    """A vector field to be learned from orbits, and quantities that are known to be conserved.

    - `inputs`, `outputs`: of the network.
    - `field`: `(t, y, network)`, where the network stands for what is not known.
    - `conserved`: `(t, y, args)`, for one state, an array.
    - `span`: of the orbits learned from, sampled every `interval`, in `substeps` steps.
    - `test_span`: of the orbits followed.
    - `draw`, `orbit`: a random start, and the exact solution `(times, states)` for it.
    - `observed`: what errors are measured of, for an array of states.
    """

    name: str
    inputs: int
    outputs: int
    field: Callable[[Any, Any, Any], Any]
    conserved: Callable[[Any, Any, Any], Any]
    span: float
    interval: float
    substeps: int
    test_span: float
    draw: Callable[[np.random.Generator], float]
    orbit: Callable[[float, np.ndarray], np.ndarray]
    observed: Callable[[np.ndarray], np.ndarray]
    published: Published

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


def _end_point(angles: Any) -> Any:
    """Of three segments of length 1, whose directions are `angles`."""
    xp = np if isinstance(angles, np.ndarray) else jnp
    return xp.stack([xp.cos(angles).sum(-1), xp.sin(angles).sum(-1)], axis=-1)


def _arm_orbit(angle: float, times: np.ndarray) -> np.ndarray:
    """Of the least rates of the angles. They depend on time only through the distance, so that the arm goes the
    same way to and fro: one solution in terms of the distance."""

    def rates(distance: float, angles: np.ndarray) -> np.ndarray:
        J = np.stack([-np.sin(angles), np.cos(angles)])
        return J.T @ np.linalg.solve(J @ J.T, np.array([1.0, 0.0]))

    start, largest = np.array([angle, -angle, angle]), 1 / (2 * np.pi)
    options = dict(method="DOP853", rtol=1e-13, atol=1e-13, max_step=0.01, dense_output=True)
    along = [solve_ivp(rates, (0, end), start, **options).sol for end in (-largest, largest)]
    distances = -np.sin(2 * np.pi * times) / (2 * np.pi)
    return np.where(distances > 0, along[1](distances), along[0](distances)).T


def _arm_field(t: Any, y: Any, network: Any) -> Any:
    rate = jnp.stack([-jnp.cos(2 * jnp.pi * t), jnp.zeros_like(t)])
    return network(jnp.concatenate([jnp.cos(y), jnp.sin(y), rate]))


def _from_path(t: Any, y: Any, args: Any) -> Any:
    """The vector between the end of the arm and the path, which is known."""
    path = jnp.stack([-jnp.sin(2 * jnp.pi * t) / (2 * jnp.pi), jnp.zeros_like(t)])
    return _end_point(y) - path


# Relative motion of two bodies from perihelion: the acceleration is learned. One revolution
# of a semi-major axis 1 takes 2 pi.
TWO_BODY = System(
    name="two-body",
    inputs=4,
    outputs=2,
    field=lambda t, y, network: jnp.concatenate([y[2:], network(y)]),
    conserved=lambda t, y, args: y[:1] * y[3:] - y[1:2] * y[2:3],
    span=2 * np.pi,
    interval=0.1,
    substeps=4,
    test_span=100.0,
    draw=lambda random: random.uniform(0.5, 0.7),
    orbit=_two_body_orbit,
    observed=lambda y: y,
    published=Published(0.18, 8.5e-4, "figure 2"),
)

# Euler's equations: all of the vector field is learned, its Casimir is known.
RIGID_BODY = System(
    name="rigid-body",
    inputs=3,
    outputs=3,
    field=lambda t, y, network: network(y),
    conserved=lambda t, y, args: (y * y).sum(keepdims=True) / 2,
    span=15.0,
    interval=0.1,
    substeps=2,
    test_span=1000.0,
    draw=lambda random: random.uniform(0.5, 1.5),
    orbit=_rigid_body_orbit,
    observed=lambda y: y,
    published=Published(0.53, 1.3e-4, "figure 2"),
)

# The end of an arm is led along a path, by the least rates of its three angles: these are learned.
ARM = System(
    name="arm",
    inputs=8,
    outputs=3,
    field=_arm_field,
    conserved=_from_path,
    span=5.0,
    interval=0.1,
    substeps=2,
    test_span=500.0,
    draw=lambda random: random.uniform(np.pi / 4, 3 * np.pi / 8),
    orbit=_arm_orbit,
    observed=_end_point,
    published=Published(4.9e-4, 4.9e-4, "figure 4"),
)

SYSTEMS = {system.name: system for system in (TWO_BODY, RIGID_BODY, ARM)}
