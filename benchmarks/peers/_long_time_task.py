"""What a problem of `benchmarks.peers.long_times` consists of, and mechanisms of point masses on rods."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj
from manifold_jax.problems._rods import rod_field, Rods


class Task(NamedTuple):
    """A problem; states have leading axes of times. `methods` are solvers, and how many times `step` their
    steps are, a power of two for single precision. Of `conserved` quantities, scalars or vectors, all relative,
    `observed` is one that no equation prescribes. `violation` is that of the constraint, `field` for SciPy, with
    `(q, v)` as one vector, over a `share` of the time."""

    name: str
    terms: Any
    methods: dict[str, tuple[int, Any]]
    step: float
    y0: Any
    conserved: dict[str, Callable[[Any, Any], Any]]
    observed: str
    violation: Callable[[Any, Any], Any]
    field: Callable[[float, np.ndarray], np.ndarray]
    share: float = 1.0


def methods_of(system: mj.MechanicalSystem) -> dict[str, tuple[int, Any]]:
    """Steps in proportion to their evaluations of forces. RATTLE takes over one from the step before."""
    return {
        "RATTLE 2": (1, mj.rattle(system)),
        "RATTLE 4": (5, mj.rattle(system, order=4)),
        "RATTLE 6": (9, mj.rattle(system, order=6)),
        "projected Dopri5": (6, mj.Projected(dfx.Dopri5(), system.constraint)),
        "projected Dopri8": (12, mj.Projected(dfx.Dopri8(), system.constraint)),
    }


def on_rods(
    name: str,
    start: np.ndarray,
    end: np.ndarray,
    masses: np.ndarray,
    y0: tuple[np.ndarray, np.ndarray],
    *,
    links: Callable[[Any], Any],
    force: Callable[[Any], Any],
    step: float,
    conserved: dict[str, Callable[[Any, Any], Any]],
    observed: str = "energy",
) -> Task:
    """Point masses with positions of shape `(points, dimensions)` under a `force` of these, for JAX and NumPy.
    `links` are the vectors of rods from `start` to `end`, where point -1 is the origin, which is fixed."""
    q0, v0 = y0
    d0, _ = rod_vectors(start, end, q0[None], v0[None])
    squares = (d0[0] ** 2).sum(axis=1)

    def rods(t, q, args):
        return 0.5 * (jnp.sum(links(q) ** 2, axis=1) - squares.astype(q.dtype))

    system = mj.MechanicalSystem(
        jnp.asarray(np.broadcast_to(masses[:, None], q0.shape)),
        rods,
        lambda t, q, v, args: force(q),
    )

    def violation(q, v):
        return of_rods(*rod_vectors(start, end, q, v), np.sqrt(squares))

    field = free_field(start, end, masses, force, q0.shape)
    y0 = jnp.asarray(q0), jnp.asarray(v0)
    methods = methods_of(system)
    return Task(name, system.terms, methods, step, y0, conserved, observed, violation, field, 0.1)


def free_field(
    start: np.ndarray, end: np.ndarray, masses: np.ndarray, force: Callable, shape: tuple[int, int]
) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the field of the points that move, for SciPy."""
    points, dimensions = shape
    inverse_masses = np.append(1 / masses, 0.0)
    padded = lambda x: np.concatenate([x, np.zeros((1, dimensions))])
    rods = Rods.between(start % (points + 1), end % (points + 1), inverse_masses)
    with_origin = rod_field(rods, lambda q: padded(force(q[:-1])), dimensions)

    def field(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y.reshape(2, points, dimensions)
        x = np.concatenate([padded(q), padded(v)]).reshape(-1)
        return with_origin(t, x).reshape(2, points + 1, dimensions)[:, :-1].reshape(-1)

    return field


def rod_vectors(start: np.ndarray, end: np.ndarray, q: Any, v: Any) -> tuple[Any, Any]:
    """Return the vectors along rods and their rates, for states at many times; point -1 is the origin."""
    padded = lambda x: np.concatenate([x, np.zeros_like(x[:, :1])], axis=1)
    q, v = padded(np.asarray(q)), padded(np.asarray(v))
    return q[:, end] - q[:, start], v[:, end] - v[:, start]


def of_rods(d: Any, rate: Any, lengths: np.ndarray) -> np.ndarray:
    """Return for all times the largest `||d| / L - 1|` and `|d . d'| / (L max(|d'|, 1))`."""
    stretch = np.abs(np.linalg.norm(d, axis=-1) / lengths - 1)
    speed = np.maximum(np.linalg.norm(rate, axis=-1), 1)
    slip = np.abs((d * rate).sum(-1)) / (lengths * speed)
    return np.maximum(stretch, slip).max(-1)


def constant(value: np.ndarray, q: Any) -> Any:
    """Return `value`, for every point, in the precision of `q`."""
    xp = jnp if isinstance(q, jax.Array) else np
    return xp.broadcast_to(xp.asarray(value, q.dtype), q.shape)
