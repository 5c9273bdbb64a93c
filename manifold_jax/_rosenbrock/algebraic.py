r"""The algebraic equations in `M y' = f`, its derivative `y'`, and consistent states.

Let `D` scale the rows of `M` to size one and `P` project onto the left null space of `D M`. The
algebraic equations are $P D f(t, y) = 0$. Differentiated once, with $\hat z = (D M)^+ D f$, they are
$P D (f_y - \partial_y (M \hat z))\, y' = -P D (f_t - \partial_t M\, \hat z)$, and together with
$M y' = f$ they determine $y'$ if the index is 1:

$$A y' = D M \hat z - s P D (f_t - \partial_t M\, \hat z), \qquad
  A = D M + s P D (f_y - \partial_y (M \hat z)),$$

for any $s > 0$, because the two parts of the sum lie in complementary spaces. The same matrix gives
Newton's step $-A^{-1} s P D f$ for the algebraic equations, which leaves $M y$ as it is.
(For constant null spaces this is Hairer & Wanner, Solving ODEs II, VI.1; otherwise $u^T M = 0$ for a
null vector $u(t, y)$, differentiated, replaces the derivative of $u$ by that of $M$.)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.types import BoolScalar, FloatScalar, IntScalar, RealScalarLike
from .._constraint.projection_info import ProjectionInfo
from .._linalg.lapack import singular_values
from .._linalg.newton import root_of_step
from .._linalg.pivoted import factorize_pivoted
from .._linalg.sparse import Choice, Sparsity
from .linearized import LinearizedEquations as LinearizedEquations, relative_residual
from .sparse_equations import linearize_sparse
from .sparsity import choose_sparsity


_MOST_ITERATIONS = 50

_FAULTS = (
    "`terms` is not finite at the time and state given. Start from a state at which f(t, {y}, args) and its mass matrix "
    "are defined.",
    "The index of M y' = f is above 1 at `{y}`, or the equations do not determine y' at all: the algebraic equations "
    "(the null space of `mass`) do not determine the part of y that `mass` does not see. Reduce the index first, for "
    "example with `mj.reduce_dae`, or remove what is redundant.",
    "`{y}` could not be made consistent with the algebraic equations of M y' = f (those that `mass` leaves without y'): "
    "no nearby state satisfies them. Start closer, or check that they can hold.",
    "`{y}` does not satisfy the algebraic equations of M y' = f (those that `mass` leaves without y'). Write "
    '`consistent="project"` to have it corrected, or correct it first with `terms.consistent_state(t, y, args)`.',
)
INCONSISTENT = 3


class MassMatrixEquations(NamedTuple):
    """`field(t, x)` and `mass(t, x)`, a scalar, a diagonal or a matrix, which numbers of a diagonal are known
    to be zero, and whether the linear systems are sparse."""

    field: Callable[[RealScalarLike, Float[Array, " n"]], Float[Array, " n"]]
    mass: Callable[[RealScalarLike, Float[Array, " n"]], Float[Array, "..."]]
    massless: np.ndarray | None = None
    sparsity: Sparsity | None = None

    def with_sparsity(
        self, choice: Choice, t: RealScalarLike, x: Float[Array, " n"]
    ) -> "MassMatrixEquations":
        """Return the equations with sparse linear systems if the choice and their structure allow it."""
        field, mass = lambda x: self.field(t, x), self.mass(t, x)
        return self._replace(sparsity=choose_sparsity(choice, field, x, mass, self.massless))

    def at(self, t: RealScalarLike, x: Float[Array, " n"]) -> LinearizedEquations:
        """Linearize the equations at one time and state."""
        if self.sparsity is None:
            return self._dense(t, x)
        return linearize_sparse(self.field, self.mass(t, x), self.sparsity, t, x)

    def _dense(self, t: RealScalarLike, x: Float[Array, " n"]) -> LinearizedEquations:
        f, M = self.field(t, x), as_matrix(self.mass(t, x), x.size)
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(M), axis=1))
        D = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
        M = D[:, None] * M
        inverse, P = _null_space(M, self.mass(t, x).ndim < 2)
        z = inverse @ (D * f)

        def rest(t: RealScalarLike, x: Float[Array, " n"]) -> Float[Array, " n"]:
            return D * (self.field(t, x) - as_matrix(self.mass(t, x), x.size) @ z)

        t = jnp.asarray(t, jnp.result_type(float, t))
        K = P @ jax.jacfwd(rest, argnums=1)(t, x)
        Kt = P @ jax.jvp(lambda t: rest(t, x), (t,), (jnp.ones_like(t),))[1]
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(K), initial=0.0))
        s = jnp.where(largest > 0, 1 / jnp.where(largest > 0, largest, 1), 1)
        A = M + s * K
        finite = jnp.all(jnp.isfinite(A)) & jnp.all(jnp.isfinite(f)) & jnp.all(jnp.isfinite(Kt))
        nonsingular = finite & _is_nonsingular(jax.lax.stop_gradient(A))
        factor = factorize_pivoted(jnp.where(nonsingular, A, jnp.eye(x.size, dtype=A.dtype)))
        nan = jnp.where(nonsingular, 0.0, jnp.nan).astype(x.dtype)
        r = P @ (D * f)
        return LinearizedEquations(
            factor.solve(M @ z - s * Kt) + nan,
            -factor.solve(s * r) + nan,
            lambda change: factor.solve(M @ change),
            relative_residual(*jax.lax.stop_gradient((r, jnp.abs(K) @ (jnp.abs(x) + 1)))) + nan,
            finite,
            nonsingular,
        )


def as_matrix(mass: Float[Array, "..."], n: int) -> Float[Array, "n n"]:
    """Return a mass in any of its forms as a matrix."""
    return mass if mass.ndim == 2 else jnp.diag(jnp.broadcast_to(mass, (n,)))


def _null_space(
    M: Float[Array, "n n"], diagonal: bool
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Return `M^+`, and the projector onto the left null space of `M`, whose rows have size one."""
    n = M.shape[0]
    unit = n * jnp.finfo(M.dtype).eps
    if diagonal:
        d = jnp.diagonal(M)
        zero = d == 0
        inverse = jnp.diag(jnp.where(zero, 0, 1 / jnp.where(zero, 1, d)))
        return inverse, jnp.diag(zero.astype(M.dtype))
    M = jnp.where(jnp.all(jnp.isfinite(M)), M, jnp.eye(n, dtype=M.dtype))
    inverse = jnp.linalg.pinv(M, rtol=10 * unit)
    P = jnp.eye(n, dtype=M.dtype) - M @ inverse
    # Entries at rounding level would let large differential equations into the algebraic ones.
    return inverse, jnp.where(jnp.abs(P) > 100 * unit, P, 0)


def _is_nonsingular(A: Float[Array, "n n"]) -> BoolScalar:
    """Whether `A` is nonsingular, whatever the units of equations and unknowns."""
    A = jnp.where(jnp.all(jnp.isfinite(A)), A, 0)
    for axis in (1, 0):
        size = jnp.max(jnp.abs(A), axis=axis, keepdims=True)
        A = A / jnp.where(size > 0, size, 1)
    values = singular_values(jax.lax.stop_gradient(A))
    return values[-1] > 100 * A.shape[0] * jnp.finfo(A.dtype).eps * values[0]


def relative_size(change: Float[Array, " n"], x: Float[Array, " n"]) -> FloatScalar:
    return jnp.max(jnp.abs(change) / (jnp.abs(x) + 1), initial=0.0)


def is_consistent(x: Float[Array, " n"], linearized: LinearizedEquations) -> BoolScalar:
    return linearized.nonsingular & is_small(relative_size(linearized.newton, x))


def is_small(correction: FloatScalar) -> BoolScalar:
    """Whether a correction is small, to half of the digits: anything larger is a mistake in the state."""
    return correction <= jnp.sqrt(jnp.finfo(correction.dtype).eps)


class _Iterate(NamedTuple):
    x: Float[Array, " n"]
    step: Float[Array, " n"]  # from the start; unknown before the first iteration
    size: FloatScalar  # size of the step
    previous: FloatScalar
    residual: FloatScalar
    iterations: IntScalar
    finite: BoolScalar  # whether the equations are defined at the start
    nonsingular: BoolScalar


def consistent(
    equations: MassMatrixEquations, t: RealScalarLike, x: Float[Array, " n"]
) -> tuple[Float[Array, " n"], ProjectionInfo]:
    """Return `x` with the part corrected that `M` does not determine; `x` itself if that fails.

    Iterated without derivatives; those of the root are those of Newton's step there.
    """
    unit = 4 * jnp.finfo(x.dtype).eps
    fixed, t_fixed = jax.lax.stop_gradient((x, t))

    def unfinished(i: _Iterate):
        shrinking = (i.size < i.previous) | (i.iterations < 10)
        return (i.size > unit) & shrinking & (i.iterations < _MOST_ITERATIONS)

    def advance(i: _Iterate):
        x, at_start = i.x + i.step, i.iterations < 0
        linearized = equations.at(t_fixed, x)
        return _Iterate(
            x,
            linearized.newton,
            relative_size(linearized.newton, x),
            i.size,
            linearized.residual,
            i.iterations + 1,
            jnp.where(at_start, linearized.finite, i.finite),
            jnp.where(at_start, linearized.nonsingular, i.nonsingular),
        )

    unknown, yes = jnp.asarray(jnp.inf, x.dtype), jnp.asarray(True)
    # The start is evaluated in the loop, too, so that the equations are compiled once.
    none, first = jnp.zeros_like(fixed), jnp.asarray(-1, jnp.int32)
    before = _Iterate(fixed, none, unknown, unknown, unknown, first, yes, yes)
    end = jax.lax.while_loop(unfinished, advance, before)
    # Where equations are badly conditioned, steps end at many units of rounding.
    success = (end.size <= 1e3 * unit) | (end.residual <= 10 * unit)
    moved = jax.lax.stop_gradient(jnp.where(success, end.x, fixed))

    def step(moved):
        there = equations.at(t, moved)
        return there.newton + there.kept(x - moved)

    out = jnp.where(success, root_of_step(convert_closure(step, moved), moved), x)
    info = ProjectionInfo(
        multipliers=jnp.zeros((0,), x.dtype),
        iterations=end.iterations,
        residual=jnp.where(end.finite, jnp.where(jnp.isnan(end.size), jnp.inf, end.size), jnp.nan),
        correction=relative_size(moved - fixed, fixed),
        full_rank=end.nonsingular,
        success=success,
    )
    return out, info


def faults_of_start(info: ProjectionInfo) -> tuple[IntScalar, tuple[str, ...]]:
    """Return the number of the message that applies, and all messages."""
    cause = jnp.where(info.full_rank, 2, 1)
    return jnp.where(jnp.isnan(info.residual), 0, cause), _FAULTS
