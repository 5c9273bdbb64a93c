"""The free rigid body (Euler's equations)."""

import math
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from ._problem import as_floating, Problem


STANDARD_START = (math.cos(1.1), 0.0, math.sin(1.1))


class RigidBodyArgs(NamedTuple):
    """Parameters of `rigid_body`: the principal moments of inertia, shape `(3,)`."""

    inertia: Any


def _field(t: RealScalarLike, y: Float[Array, "3"], args: RigidBodyArgs) -> Float[Array, "3"]:
    w = y / args.inertia
    cyclic = [(1, 2), (2, 0), (0, 1)]
    return jnp.stack([y[i] * w[j] - y[j] * w[i] for i, j in cyclic])


def _invariants(t: RealScalarLike, y: Float[Array, "3"], args: RigidBodyArgs) -> Float[Array, "2"]:
    return jnp.stack([jnp.sum(y * y), 0.5 * jnp.sum(y * y / args.inertia)])


def _exact(t: np.ndarray, args: RigidBodyArgs, y0: np.ndarray) -> np.ndarray:
    """Jacobi elliptic functions, from any initial state and for any moments of inertia.

    `y = (s a1 dn, s' a2 sn, a3 cn)`, where axis 1 is the one that the momentum circles
    (largest or smallest inertia) and axis 2 the middle one.
    """
    inertia = args.inertia
    rest = np.broadcast_to(y0, (t.size, 3)).copy()
    order = np.argsort(-inertia)
    middle = inertia[order[1]]
    if np.sum(y0 * y0 * (middle / inertia - 1)) > 0:
        order = order[::-1]
    # An exchange of two axes is a reflection, which makes -y of a solution y.
    parity = np.linalg.det(np.eye(3)[order])
    I1, I2, I3 = inertia[order]
    y1, y2, y3 = parity * y0[order]
    if I1 == I3:
        return rest
    # (|y|^2 - 2 T I3) / (I1 - I3) and (2 T I1 - |y|^2) / (I1 - I3) without cancellation
    first = y1**2 / I1 + y2**2 / I2 * (I2 - I3) / (I1 - I3)
    third = y3**2 / I3 + y2**2 / I2 * (I1 - I2) / (I1 - I3)
    if first == 0 or third == 0:
        return rest
    m = min((I2 - I3) / (I1 - I2) * third / first, 1.0)
    rate = np.sqrt((I1 - I2) * (I1 - I3) * first / (I1 * I2 * I3))
    a1, a3 = np.sqrt(I1 * first), np.sqrt(I3 * third)
    a2 = np.sqrt(I2 * third * (I1 - I3) / (I1 - I2))
    s = np.copysign(1.0, y1)
    sense = -s * np.sign(I1 - I2)  # from y3' = y1 y2 (1 / I2 - 1 / I1)
    u = scipy.special.ellipkinc(np.arctan2(sense * y2 * a3, y3 * a2), m) + rate * t
    if not np.all(np.isfinite(u)):  # rotation about the middle axis
        return rest
    sn, cn, dn, _ = scipy.special.ellipj(u, m)
    y = np.empty((t.size, 3))
    y[:, order] = parity * np.stack([s * a1 * dn, sense * a2 * sn, a3 * cn], axis=-1)
    return y


def rigid_body(
    *, inertia: Any = (2.0, 1.0, 2 / 3), y0: Any = STANDARD_START, t1: float = 30.0
) -> Problem:
    r"""Euler's equations of the free rigid body.

    For its angular momentum $y$ in the body frame, with two invariants, the Casimir
    $|y|^2$ and the energy:

    $$y' = y \times \omega, \quad \omega_i = y_i / I_i, \quad
    |y|^2 = \text{const}, \quad \tfrac12 \textstyle\sum_i y_i^2 / I_i = \text{const}.$$

    The state is `y`, shape `(3,)`; two constraints. Exact solution by Jacobi elliptic
    functions for every initial state and all moments of inertia, to about `1e-14` away
    from the separatrix. No symmetry hides an order here: a good problem to measure it.

    **Arguments:**

    - `inertia`: principal moments of inertia, shape `(3,)`, `args.inertia`.
    - `y0`: initial angular momentum, shape `(3,)`, by default `(cos 1.1, 0, sin 1.1)`.
        `with_args` keeps it and freezes the invariants anew.
    - `t1`: the end of the time span.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration (2nd ed., 2006),
    chapter IV: these moments of inertia and this initial state.
    """
    return Problem(
        "rigid-body",
        diffrax.ODETerm(_field),
        t1=t1,
        args=RigidBodyArgs(as_floating(inertia)),
        start=as_floating(y0),
        invariants=_invariants,
        exact=_exact,
    )
