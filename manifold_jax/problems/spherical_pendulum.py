"""The spherical pendulum."""

from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, integrate, Problem
from .pendulum import moved_along_ray, PendulumArgs, point_mass, rod


Vector: TypeAlias = Float[Array, "3"]


def _force(t: RealScalarLike, q: Vector, v: Vector, args: PendulumArgs) -> Vector:
    zero = jnp.zeros_like(args.mass)
    return jnp.stack([zero, zero, -args.mass * args.gravity])


def _exact(t: np.ndarray, args: PendulumArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Angles on the sphere are singular at its poles; Newton's equations are not:

    q'' = (0, 0, -g) - (|v|^2 - g z) q / |q|^2.
    """
    L, g = float(args.length), float(args.gravity)

    def field(t, x):
        x1, x2, x3, v1, v2, v3 = x.tolist()
        pull = (v1 * v1 + v2 * v2 + v3 * v3 - g * x3) / (x1 * x1 + x2 * x2 + x3 * x3)
        return v1, v2, v3, -pull * x1, -pull * x2, -g - pull * x3

    q, v = np.split(integrate(field, np.concatenate(y0), t), 2, axis=1)
    q *= L / np.linalg.norm(q, axis=1, keepdims=True)
    return q, v - q * (np.sum(q * v, axis=1, keepdims=True) / L**2)


def spherical_pendulum(
    *, gravity: Any = 9.81, length: Any = 1.0, mass: Any = 1.0, t1: float = 10.0
) -> Problem:
    r"""The spherical pendulum, a point mass on a sphere, with z upwards:

    $$m q'' = (0, 0, -m g) - 2 \lambda q, \quad |q|^2 = L^2, \quad q \cdot q' = 0.$$

    The state is `(q, v)`, each of shape `(3,)`; two constraints, position and velocity. From
    `q = L (0.8, 0, -0.6)` with `v = (0, 2, 0)` m/s: the pendulum swings between two heights
    while it turns about the vertical.

    Energy and the vertical angular momentum are conserved but not enforced. The solution is
    an independent integration (SciPy's DOP853) of Newton's equations with the pull of the
    rod eliminated, put on the sphere; to about 1e-12 from every initial state on the
    manifold. It agrees with the elliptic functions that height and azimuth are.

    **Arguments:**

    - `gravity` (m/s^2), `length` (m), `mass` (kg): scalars, `args`. `with_args` moves the
        initial position, also one of yours, along its ray to the new length and keeps the
        velocity.
    - `t1`: the end of the time span (s).

    Source: Whittaker, A Treatise on the Analytical Dynamics of Particles and Rigid Bodies
    (4th ed., 1937), chapter IV.
    """
    return Problem(
        "spherical-pendulum",
        system=MechanicalSystem(point_mass, rod, _force),
        t1=t1,
        args=PendulumArgs(gravity, length, mass),
        start=(as_floating([0.8, 0.0, -0.6]), as_floating([0.0, 2.0, 0.0])),
        initial_state=moved_along_ray,
        exact=_exact,
    )
