"""The planar Kepler problem."""

import math
from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from ._problem import Problem


State: TypeAlias = tuple[Float[Array, "2"], Float[Array, "2"]]


class KeplerArgs(NamedTuple):
    """Parameters of `kepler`: the gravitational parameter and the eccentricity.

    The eccentricity is that of the standard orbit; the vector field does not use it.
    """

    mu: Any = 1.0
    eccentricity: Any = 0.6


def _field(t: RealScalarLike, y: State, args: KeplerArgs) -> State:
    q, v = y
    r2 = jnp.sum(q * q)
    return v, -args.mu / (r2 * jnp.sqrt(r2)) * q


def _invariants(t: RealScalarLike, y: State, args: KeplerArgs) -> tuple[FloatScalar, FloatScalar]:
    q, v = y
    energy = 0.5 * jnp.sum(v * v) - args.mu / jnp.sqrt(jnp.sum(q * q))
    return energy, q[0] * v[1] - q[1] * v[0]


def _initial_state(args: KeplerArgs, start: State | None) -> State:
    if start is not None:
        return start
    mu, e = args
    zero = jnp.zeros_like(e)
    return jnp.stack([1 - e, zero]), jnp.stack([zero, jnp.sqrt(mu * (1 + e) / (1 - e))])


def _exact(t: np.ndarray, args: KeplerArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Solve Kepler's equation; then the functions of Lagrange give `q = f q0 + g v0`."""
    mu = float(args.mu)
    q0, v0 = y0
    r0 = np.hypot(*q0)
    a = 1 / (2 / r0 - np.dot(v0, v0) / mu)
    if not a > 0:
        raise ValueError(
            "The solution of `kepler` is implemented for bound orbits only (energy < 0)."
        )
    n = np.sqrt(mu / a**3)
    e_cos, e_sin = 1 - r0 / a, np.dot(q0, v0) / np.sqrt(mu * a)
    e = np.hypot(e_cos, e_sin)
    E0 = np.arctan2(e_sin, e_cos)
    E = _eccentric_anomaly(E0 - e_sin + n * t, e)
    s, c = np.sin(E - E0), 1 - np.cos(E - E0)
    r = a * (1 - e * np.cos(E))
    f, g = 1 - a / r0 * c, ((1 - e_cos) * s + e_sin * c) / n
    df, dg = -np.sqrt(mu * a) / (r * r0) * s, 1 - a / r * c
    return np.outer(f, q0) + np.outer(g, v0), np.outer(df, q0) + np.outer(dg, v0)


def _eccentric_anomaly(mean: np.ndarray, e: float) -> np.ndarray:
    """Solve `E - e sin E = mean` for `E`, up to a multiple of `2 pi`."""
    mean = np.remainder(mean + np.pi, 2 * np.pi) - np.pi
    # From here Newton's method converges for every e < 1 (Danby 1987).
    E = mean + 0.85 * e * np.sign(mean)
    for _ in range(50):
        E = E - (E - e * np.sin(E) - mean) / (1 - e * np.cos(E))
    return E


def kepler(*, mu: Any = 1.0, eccentricity: Any = 0.6, t1: float = 6 * math.pi) -> Problem:
    r"""The planar Kepler problem with two invariants, energy and angular momentum:

    $$q'' = -\mu q / |q|^3, \quad \tfrac12 |v|^2 - \mu / |q| = \text{const}, \quad
    q_1 v_2 - q_2 v_1 = \text{const}.$$

    The state is `(q, v)`, each of shape `(2,)`; two constraints. It starts at the pericentre of an
    orbit of semi-major axis 1, `q = (1 - e, 0)`, `v = (0, sqrt(mu (1 + e) / (1 - e)))`, with period
    `2 pi / sqrt(mu)`. Exact solution by Kepler's equation from every initial state on a bound orbit, to
    about `1e-14` for the standard one.

    The Laplace vector is conserved too but not enforced: together with energy and
    angular momentum it would be four equations of which only three are independent.

    **Arguments:**

    - `mu`: gravitational parameter, `args.mu`.
    - `eccentricity`: of the standard orbit, `0 <= e < 1`, `args.eccentricity`.
        `with_args` rebuilds the standard initial state from both; one of yours is kept.
    - `t1`: the end of the time span, by default three periods for `mu = 1`.

    Source: classical; `e = 0.6` as in Hairer, Lubich & Wanner, Geometric Numerical
    Integration (2nd ed., 2006), section I.2.
    """
    return Problem(
        "kepler",
        diffrax.ODETerm(_field),
        t1=t1,
        args=KeplerArgs(mu, eccentricity),
        initial_state=_initial_state,
        invariants=_invariants,
        exact=_exact,
    )
