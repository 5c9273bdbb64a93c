"""The correction of mechanical states: first the positions, then the velocities.

    phi(t, q_hat + V_p z) = 0,        C (v_hat + V zeta) = b,        V = M^-1 C^T at (q_hat, v_hat)

with `C` the Jacobian of all constraints with respect to the velocities, whose first rows are
`J = dphi/dq`, and one factorization of `C V` for both. The velocities are corrected at the
corrected positions. Neither needs the derivative of `J v`, half of the full Jacobian.

Source: Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482; Lubich, Nowak, Poehle & Engstler,
MEXX (1992).
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import Args, BoolScalar, Y
from ._linear import factorize, gram
from ._mechanics import MechanicalConstraint
from ._mechanics.constraint import Kinematics
from ._newton import (
    correct_once,
    CorrectionProblem,
    CorrectionRoot,
    Linearization,
    solve_correction,
)


class Settings(NamedTuple):
    """How to correct; `directions` are `V^T` if they are not those of the state itself."""

    inverse_metric: tuple[Float[Array, " n"], Float[Array, " n"]] | None
    directions: Float[Array, "m n"] | None
    max_steps: int
    tolerance: Any
    far: bool


def correct_in_two_stages(
    constraint: MechanicalConstraint, t: Array, y: Y, args: Args, fallback: Y, settings: Settings
) -> tuple[Y, CorrectionRoot, CorrectionRoot]:
    """The corrected state, and the roots for the positions and the velocities."""
    equations = Kinematics(constraint, y)
    x, w = equations.flat(y)
    safe_x, safe_w = jax.lax.stop_gradient(equations.flat(fallback))
    # Replaced before anything is evaluated there: the derivative of a NaN is never zero.
    finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(w))
    x, w = jnp.where(finite, x, safe_x), jnp.where(finite, w, safe_w)

    solve = _Stages(equations, t, args, settings, constraint.redundant)
    rows, linearization, p = solve.linearize(x, w)
    positions = solve.positions(x, safe_x, rows, linearization, p)
    if settings.far:  # the matrix at the corrected positions: the nearest velocities
        rows, linearization, p = solve.linearize(positions.p, w)
    velocities = solve.velocities(positions.p, w, safe_w, rows, linearization)
    corrected = tuple(
        equations.unravel(jnp.where(finite, root.p, jnp.nan)) for root in (positions, velocities)
    )
    return corrected, _failed_unless(finite, positions), _failed_unless(finite, velocities)


class _Stages(NamedTuple):
    equations: Kinematics
    t: Array
    args: Args
    settings: Settings
    redundant: bool

    def linearize(
        self, x: Float[Array, " n"], w: Float[Array, " n"]
    ) -> tuple[Float[Array, "m n"], Linearization, int]:
        """`V^T`, and the Jacobian `C` with `C V` factored, for positions and velocities."""
        C, p = self.equations.rows(self.t, x, w, self.args)
        rows, valid = self.settings.directions, True
        if rows is None and self.settings.inverse_metric is None:
            mass = self.equations.mass(self.t, x, w, self.args, C)
            rows, valid = mass.solve(C), mass.valid
        elif rows is None:
            rows = C * self.settings.inverse_metric[1]
        factorization = factorize(gram(C, rows), self.redundant)
        full_rank = factorization.full_rank & valid
        return rows, Linearization(C, dataclasses.replace(factorization, full_rank=full_rank)), p

    def positions(self, x, safe, rows, linearization, p: int) -> CorrectionRoot:
        if p == 0:
            return _nothing_to_do(x)
        rows, J = rows[:p], linearization.G[:p]
        if self.settings.inverse_metric is not None:
            rows = J * self.settings.inverse_metric[0]
        same = p == linearization.G.shape[0] and self.settings.inverse_metric is None
        factorization = (
            linearization.factorization if same else factorize(gram(J, rows), self.redundant)
        )
        residual = eqx.filter_closure_convert(self.equations.position, self.t, x, self.args)
        problem = CorrectionProblem(
            residual, self.t, x, self.args, rows=rows, redundant=self.redundant
        )
        return self._solve(problem, safe, Linearization(J, factorization))

    def velocities(self, x, w, safe, rows, linearization) -> CorrectionRoot:
        context = (x, self.args)
        residual = eqx.filter_closure_convert(self.equations.velocity, self.t, w, context)
        problem = CorrectionProblem(
            residual, self.t, w, context, rows=rows, redundant=self.redundant
        )
        return self._solve(problem, safe, linearization)

    def _solve(self, problem, safe, linearization) -> CorrectionRoot:
        settings = self.settings
        if settings.max_steps == 1 and not settings.far:
            return correct_once(problem, safe, linearization)
        return solve_correction(
            problem, safe, settings.max_steps, settings.tolerance, settings.far, linearization
        )


def _nothing_to_do(x: Float[Array, " n"]) -> CorrectionRoot:
    yes, zero = jnp.asarray(True), jnp.zeros((), x.dtype)
    return CorrectionRoot(x, jnp.zeros((0,), x.dtype), jnp.zeros((), jnp.int32), zero, yes, yes)


def _failed_unless(finite: BoolScalar, root: CorrectionRoot) -> CorrectionRoot:
    residual = jnp.where(finite, root.residual, jnp.nan)
    return root._replace(residual=residual, success=root.success & finite)
