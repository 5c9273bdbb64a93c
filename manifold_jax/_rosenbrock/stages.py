"""The stages of a Rosenbrock step."""

from typing import Any, NamedTuple

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
    tableau: RosenbrockTableau,
    system: System,
    x0: Vector,
    derivative: Vector | None,
    largest_written_out: int,
) -> RosenbrockStep:
    r"""One step. If `M` depends on time or state, the method is that for the larger system
    $y' = z$, $0 = f(t, y) - M(t, y) z$, with $z$ eliminated from its linear systems: with $Z_i$ for
    $h z$ at a stage, $V_i$ for its increments, and $J, T$ the derivatives of $f - M z_0$,

    $$(M_0/\gamma - h J) U_i = h f_i - (M_i - M_0) Z_i + M_0 \sum_j C_{ij} U_j + d_i h^2 T, \qquad
      V_i = U_i / \gamma - Z_i - \sum_j C_{ij} U_j.$$

    Source: Hairer & Wanner, Solving ODEs II, VI.4 and VI.6; Lubich & Roche, Computing 43 (1990)
    325-342.
    """
    h = system.step.astype(x0.dtype)
    Z0 = None if derivative is None else h * derivative
    f0, J, T = system.linearized(x0, Z0)
    M0 = system.mass_at(system.t0, x0)
    factor = factorize_pivoted(_iteration_matrix(M0, tableau.gamma, J), largest_written_out)
    U: list[Vector] = []
    V: list[Vector] = []
    known = {((), 0.0): (f0, M0)}
    for i, c in enumerate(tableau.c):
        row = _without_zeros(tableau.a_lower[i - 1] if i > 0 else ())
        if (row, c) not in known:  # some methods have stages at the same point
            t, x = system.time(c), _plus(x0, row, U)
            known[row, c] = system.increment(t, x), M0 if Z0 is None else system.mass_at(t, x)  # pyright: ignore[reportArgumentType]
        f, M = known[row, c]  # pyright: ignore[reportArgumentType]
        coupling = _plus(None, tableau.c_lower[i - 1] if i > 0 else (), U)
        right = f if tableau.d[i] == 0 else f + tableau.d[i] * T
        if coupling is not None:
            right = right + (coupling if M0 is None else product(M0, coupling))
        if Z0 is None:
            U.append(factor.solve(right))
            continue
        Z = _plus(Z0, row, V)
        U.append(factor.solve(right - product(M - M0, Z)))  # pyright: ignore[reportOperatorIssue]
        V.append(U[i] / tableau.gamma - Z - (0 if coupling is None else coupling))
    finite = [jnp.all(jnp.isfinite(value)) for value in (f0, J, T)]
    # A finished lane of a batch makes steps of no length.
    after = None if Z0 is None else _plus(Z0, tableau.m, V) / jnp.where(h == 0, 1, h)
    return RosenbrockStep(
        _plus(x0, tableau.m, U),
        _plus(None, tableau.error, U),
        tuple(_plus(None, weights, U) for weights in tableau.dense),
        after,
        finite[0] & finite[1] & finite[2],
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


def _plus(start: Vector | None, row: Row, vectors: list[Vector]) -> Any:
    """`start` and the combination of those vectors that have a coefficient."""
    total = start
    for c, v in zip(row, vectors, strict=False):
        if c != 0:
            part = v if c == 1 else c * v
            total = part if total is None else total + part
    return total
