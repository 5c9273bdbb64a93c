"""The stages of a Rosenbrock step."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar
from .elimination import factorize_pivoted
from .mass_matrix import product
from .system import System, Vector
from .tableau import RosenbrockTableau, Row


class RosenbrockStep(NamedTuple):
    """The state at the end, its error estimate, the rows of dense output, `y'` at the end if it is
    carried; whether the equations are defined at the beginning, and the matrix regular."""

    x1: Vector
    error: Vector
    dense: tuple[Vector, ...]
    derivative: Vector | None
    defined: BoolScalar
    regular: BoolScalar


def rosenbrock_step(
    tableau: RosenbrockTableau, system: System, x0: Vector, derivative: Vector | None
) -> RosenbrockStep:
    r"""One step. If `M` depends on time or state, the method is that for the larger system
    $y' = z$, $0 = f(t, y) - M(t, y) z$, with $z$ eliminated from its linear systems: with $Z_i$ for
    $h z$ at a stage, $V_i$ for its increments, and $J, T$ the derivatives of $f - M z_0$,

    $$(M_0/\gamma - h J) U_i = h f_i - (M_i - M_0) Z_i + M_0 \sum_j C_{ij} U_j + d_i h^2 T, \qquad
      V_i = U_i / \gamma - Z_i - \sum_j C_{ij} U_j.$$

    Source: Hairer & Wanner, Solving ODEs II, VI.4 and VI.6; Lubich & Roche, Computing 43 (1990)
    325-342.
    """
    carries = derivative is not None
    h = system.step.astype(x0.dtype)
    Z0 = h * derivative if carries else None
    f0, J, T = system.linearized(x0, Z0)
    M0 = system.mass_at(system.t0, x0)
    factor = factorize_pivoted(_iteration_matrix(M0, tableau.gamma, J))
    U: list[Vector] = []
    V: list[Vector] = []
    known = {((), 0.0): (x0, f0, M0)}
    for i in range(len(tableau.c)):
        row = _without_zeros(tableau.a_lower[i - 1] if i > 0 else ())
        at = row, tableau.c[i]
        if at not in known:
            t, x = system.time(tableau.c[i]), x0 + _combination(row, U)
            known[at] = x, system.increment(t, x), system.mass_at(t, x) if carries else M0
        _, f, M = known[at]
        right = f
        coupling = _combination(tableau.c_lower[i - 1], U) if i > 0 else None
        if coupling is not None:
            right = right + (coupling if M0 is None else product(M0, coupling))
        if tableau.d[i] != 0:
            right = right + tableau.d[i] * T
        Z = None
        if carries:
            Z = Z0 + _combination(row, V) if row else Z0
            right = right - product(M - M0, Z)
        U.append(factor.solve(right))
        if carries:
            V.append(U[i] / tableau.gamma - Z - (0 if coupling is None else coupling))
    defined = jnp.all(jnp.isfinite(f0)) & jnp.all(jnp.isfinite(J)) & jnp.all(jnp.isfinite(T))
    # A finished lane of a batch makes steps of no length.
    after = None
    if carries:
        after = (Z0 + _combination(tableau.m, V)) / jnp.where(h == 0, 1, h)
    return RosenbrockStep(
        x0 + _combination(tableau.m, U),
        _combination(tableau.error, U),
        tuple(_combination(row, U) for row in tableau.dense),
        after,
        defined,
        factor.regular,
    )


def _iteration_matrix(
    M: Float[Array, "..."] | None, gamma: float, J: Float[Array, "n n"]
) -> Float[Array, "n n"]:
    """`M / gamma - J`."""
    n = J.shape[0]
    M = jnp.ones((), J.dtype) if M is None else M
    return (M if M.ndim == 2 else jnp.diag(jnp.broadcast_to(M, (n,)))) / gamma - J


def _without_zeros(row: Row) -> Row:
    """Also at its end, so that equal stages are recognized."""
    while row and row[-1] == 0:
        row = row[:-1]
    return row


def _combination(row: Row, vectors: list[Vector]) -> Vector:
    """Of those with a coefficient, as many as there are."""
    parts = [c * v if c != 1 else v for c, v in zip(row, vectors, strict=False) if c != 0]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total
