"""The stages of a Rosenbrock step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.types import BoolScalar
from .._jaxpr.trace import num_equations
from .._linalg.dense import Factorization
from .._linalg.pivoted import factorize_pivoted
from .._linalg.rows import product
from .._linalg.sparse import Choice, factorize_sparse, SparseMatrix
from .algebraic import as_matrix
from .system import System, Vector
from .tableau import RosenbrockTableau, Row


# Largest number of equations of the vector field times stages for which stages are written out. A loop
# over the stages of 6000 (transistor amplifier) and 7600 equations (charge pump) takes 1.3 times as
# long in a batch, one of 20000 (wheelset) 0.75 times; that compiles in 0.8 of the time. jaxlib 0.10.2.
LARGEST_UNROLLED = 10_000


class RosenbrockStep(NamedTuple):
    """The state at the end, its error estimate, the rows of dense output, and `y'` at the end if it is
    carried; whether the equations are defined at the beginning, and the matrix nonsingular."""

    x1: Vector
    error: Vector
    dense: tuple[Vector, ...]
    derivative: Vector | None
    defined: BoolScalar
    nonsingular: BoolScalar


def rosenbrock_step(
    tableau: RosenbrockTableau,
    system: System,
    x0: Vector,
    derivative: Vector | None,
    structure: Choice,
    largest_written_out: int,
) -> RosenbrockStep:
    r"""Make one step. If `M` depends on time or state, the method is applied to the larger system
    $y' = z$, $0 = f(t, y) - M(t, y) z$, with $z$ eliminated from its linear systems: with $Z_i$ for
    $h z$ at a stage, $V_i$ for its increments, and $J, T$ the derivatives of $f - M z_0$,

    $$(M_0/\gamma - h J) U_i = h f_i - (M_i - M_0) Z_i + M_0 \sum_j C_{ij} U_j + d_i h^2 T, \qquad
      V_i = U_i / \gamma - Z_i - \sum_j C_{ij} U_j.$$

    Source: Hairer & Wanner, Solving ODEs II, VI.4 and VI.6; Lubich & Roche, Computing 43 (1990)
    325-342.
    """
    h = system.step.astype(x0.dtype)
    Z0 = None if derivative is None else h * derivative
    sparsity = system.sparsity(structure, x0, Z0)
    f0, J, T = system.linearized(x0, Z0, sparsity)
    M0 = system.mass_at(system.t0, x0)
    mass = jnp.ones((), x0.dtype) if M0 is None else M0
    if sparsity is None:
        A = as_matrix(mass, x0.size) / tableau.gamma - J
        factor = factorize_pivoted(A, largest_written_out)
    else:
        A = SparseMatrix.of_mass(mass, sparsity.pattern) / tableau.gamma - J
        factor = factorize_sparse(A, sparsity.method)
    stages = _Stages(tableau, system, factor, x0, Z0, M0, T)
    in_a_loop = sparsity is not None or stages.are_long
    U, V = stages.in_a_loop(f0) if in_a_loop else stages.written_out(f0)
    finite = [jnp.all(jnp.isfinite(value)) for value in (f0, *jtu.tree_leaves(J), T)]
    # A lane of a batch that has finished makes steps of length zero.
    after = None if Z0 is None else _plus(Z0, tableau.m, V) / jnp.where(h == 0, 1, h)
    return RosenbrockStep(
        _plus(x0, tableau.m, U),
        _plus(None, tableau.error, U),
        tuple(_plus(None, weights, U) for weights in tableau.dense),
        after,
        finite[0] & finite[1] & finite[2],
        factor.usable,
    )


class _Stages(NamedTuple):
    """The quantities that the stages of one step share."""

    tableau: RosenbrockTableau
    system: System
    factor: Factorization
    x0: Vector
    Z0: Vector | None
    M0: Float[Array, "..."] | None
    T: Vector

    @property
    def are_long(self) -> bool:
        increment = num_equations(self.system.increment, jnp.asarray(self.system.t0), self.x0)
        return increment * len(self.tableau.c) > LARGEST_UNROLLED

    def evaluate(self, t: Array, x: Vector) -> tuple[Vector, Any]:
        """Return `h f` and `M`."""
        constant = self.Z0 is None
        M = self.M0 if constant else self.system.mass_at(t, x)
        return self.system.increment(t, x), M

    def solve(
        self, f: Vector, M: Any, d: Any, coupling: Vector | None, Z: Vector | None
    ) -> tuple[Vector, Vector | None]:
        """Return `U_i` and `V_i`."""
        right = f if isinstance(d, float) and d == 0 else f + d * self.T
        if coupling is not None:
            right = right + (coupling if self.M0 is None else product(self.M0, coupling))
        if Z is None:
            return self.factor.solve(right), None
        U = self.factor.solve(right - product(M - self.M0, Z))  # pyright: ignore[reportOperatorIssue]
        return U, U / self.tableau.gamma - Z - (0 if coupling is None else coupling)

    def written_out(self, f0: Vector) -> tuple[list[Vector], list[Any]]:
        tableau = self.tableau
        U: list[Vector] = []
        V: list[Any] = []
        known: dict[tuple[Row, float], Any] = {((), 0.0): (f0, self.M0)}
        for i, c in enumerate(tableau.c):
            row = _without_zeros(tableau.a_lower[i - 1] if i > 0 else ())
            if (row, c) not in known:  # some methods have stages at the same point
                known[row, c] = self.evaluate(self.system.time(c), _plus(self.x0, row, U))
            coupling = _plus(None, tableau.c_lower[i - 1] if i > 0 else (), U)
            Z = None if self.Z0 is None else _plus(self.Z0, row, V)
            f, M = known[row, c]
            u, v = self.solve(f, M, tableau.d[i], coupling, Z)
            U.append(u)
            V.append(v)
        return U, V

    def in_a_loop(self, f0: Vector) -> tuple[list[Vector], list[Any]]:
        """Compute the same with the vector field compiled once, whatever the number of stages."""
        tableau, count = self.tableau, len(self.tableau.c)
        dtype = self.x0.dtype

        def stage(known: Any, xs: Any) -> tuple[Any, None]:
            i, t, row, couplings, d = xs
            f, M = self.evaluate(t, self.x0 + row @ known[0])
            Z = None if self.Z0 is None else self.Z0 + row @ known[1]
            new = self.solve(f, M, d, couplings @ known[0], Z)
            return jtu.tree_map(lambda values, value: values.at[i].set(value), known, new), None

        first = self.solve(f0, self.M0, tableau.d[0], None, self.Z0)
        start = jtu.tree_map(lambda u: jnp.zeros((count, *u.shape), dtype).at[0].set(u), first)
        padded = lambda rows: jnp.asarray(
            [(*row, *[0.0] * (count - len(row))) for row in rows], dtype
        )
        times = jnp.stack([self.system.time(c) for c in tableau.c[1:]])
        d = jnp.asarray(tableau.d[1:], dtype)
        xs = (jnp.arange(1, count), times, padded(tableau.a_lower), padded(tableau.c_lower), d)
        U, V = jax.lax.scan(stage, start, xs)[0]
        return list(U), [] if V is None else list(V)


def _without_zeros(row: Row) -> Row:
    """Drop zeros, also at the end, so that equal stages are recognized."""
    while row and row[-1] == 0:
        row = row[:-1]
    return row


def _plus(start: Vector | None, row: Row, vectors: list[Vector]) -> Any:
    """Return `start` plus the combination of those vectors whose coefficient is not zero."""
    total = start
    for c, v in zip(row, vectors, strict=False):
        if c != 0:
            part = v if c == 1 else c * v
            total = part if total is None else total + part
    return total
