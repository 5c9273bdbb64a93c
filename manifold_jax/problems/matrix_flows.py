"""Flows on classical matrix manifolds with closed-form solutions.

All data come from fixed formulas, no random numbers: every implementation can use the same ones.
"""

from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._constraint.constraint import Constraint
from .._lie_groups import LieGroupChart, SO3
from ._problem import as_floating, Problem


Vector: TypeAlias = Float[Array, " n"]
Matrix: TypeAlias = Float[Array, "3 3"]


class SphereFlowArgs(NamedTuple):
    """Parameters of `sphere_flow`: the symmetric matrix, shape `(n, n)`."""

    matrix: Any


def _sphere_field(t: RealScalarLike, y: Vector, args: SphereFlowArgs) -> Vector:
    image = args.matrix @ y
    return image - jnp.sum(y * image) * y


def _sphere_residual(t: RealScalarLike, y: Vector, args: SphereFlowArgs) -> FloatScalar:
    return jnp.sum(y * y) - 1


def _sphere_initial_state(args: SphereFlowArgs, start: Vector | None) -> Vector:
    if start is not None:
        return start
    n, dtype = args.matrix.shape[0], args.matrix.dtype
    x = np.sin(np.arange(1.0, n + 1) ** 2)
    return jnp.asarray(x / np.linalg.norm(x), dtype)


def _sphere_exact(t: np.ndarray, args: SphereFlowArgs, y0: np.ndarray) -> np.ndarray:
    if not np.allclose(args.matrix, args.matrix.T):
        raise ValueError(
            "The solution of `sphere-flow` is implemented for symmetric matrices only."
        )
    values, vectors = np.linalg.eigh(args.matrix)
    growth = np.exp(np.outer(t, values) - np.max(np.outer(t, values), axis=1, keepdims=True))
    y = (growth * (vectors.T @ y0)) @ vectors.T
    return y / np.linalg.norm(y, axis=1, keepdims=True)


def sphere_flow(*, n: int = 10, t1: float = 2.0) -> Problem:
    r"""The gradient flow of the Rayleigh quotient on the unit sphere,

    $$y' = A y - (y \cdot A y)\, y, \quad |y|^2 = 1,$$

    towards the eigenvector of the largest eigenvalue. Exact solution
    `e^(tA) y0 / |e^(tA) y0|`, from every initial state on the sphere.

    The state has shape `(n,)`; one constraint. Any size: a problem to watch how the cost
    grows with `n`.

    **Arguments:**

    - `n`: the size. The matrix, `args.matrix`, is the symmetric part of
        `cos(i + 2j)`, `i, j = 1, ..., n`; the initial state is proportional to
        `sin(i^2)`. It does not depend on the entries of the matrix.
    - `t1`: the end of the time span.

    Source: classical (Helmke & Moore, Optimization and Dynamical Systems, 1994,
    section 1.3); the data are ours.
    """
    i = np.arange(1.0, n + 1)
    entries = np.cos(i[:, None] + 2 * i[None, :])
    return Problem(
        "sphere-flow",
        diffrax.ODETerm(_sphere_field),
        constraint=Constraint(_sphere_residual),
        t1=t1,
        args=SphereFlowArgs(as_floating((entries + entries.T) / 2)),
        initial_state=_sphere_initial_state,
        exact=_sphere_exact,
    )


class RotationArgs(NamedTuple):
    """Parameters of `rotation`: the angular velocity in the body frame, shape `(3,)`."""

    omega: Any


def _rotation_field(t: RealScalarLike, y: Matrix, args: RotationArgs) -> Matrix:
    # row by row: r^T hat(omega) = (r x omega)^T
    return jnp.cross(y, args.omega[None, :])


def _rotation_residual(t: RealScalarLike, y: Matrix, args: RotationArgs) -> Float[Array, "6"]:
    # the upper triangle: the whole symmetric matrix would be 9 dependent equations
    products = [jnp.sum(y[:, i] * y[:, j]) - float(i == j) for i in range(3) for j in range(i, 3)]
    return jnp.stack(products)


def _rotation_initial_state(args: RotationArgs, start: Matrix | None) -> Matrix:
    return jnp.eye(3, dtype=args.omega.dtype) if start is None else start


def _rotation_exact(t: np.ndarray, args: RotationArgs, y0: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, with `sinc` for the case of no rotation."""
    x, y, z = args.omega
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.linalg.norm(args.omega) * t
    sine = (t * np.sinc(angle / np.pi))[:, None, None]
    cosine = (t**2 / 2 * np.sinc(angle / (2 * np.pi)) ** 2)[:, None, None]
    return y0 @ (np.eye(3) + sine * hat + cosine * (hat @ hat))


def rotation(*, omega: Any = (1.0, -2.0, 0.5), t1: float = 10.0) -> Problem:
    r"""A rotation matrix turning at a constant angular velocity of the body,

    $$R' = R\, \hat\omega, \quad R^T R = I,$$

    from the identity. Exact solution `R0 exp(t hat(omega))` (Rodrigues' formula), from
    every initial state. The state is `R`, shape `(3, 3)`; six constraints, the upper
    triangle of `R^T R - I` row by row.

    **Arguments:**

    - `omega`: angular velocity (rad/s), shape `(3,)`, `args.omega`. Neither the initial
        state nor the constraint depends on it.
    - `t1`: the end of the time span (s).

    Source: classical (Hairer, Lubich & Wanner, Geometric Numerical Integration, 2nd ed.,
    2006, section IV.6); the data are ours.
    """
    return Problem(
        "rotation",
        diffrax.ODETerm(_rotation_field),
        constraint=Constraint(_rotation_residual),
        chart=LieGroupChart(SO3()),
        t1=t1,
        args=RotationArgs(as_floating(omega)),
        initial_state=_rotation_initial_state,
        exact=_rotation_exact,
    )
