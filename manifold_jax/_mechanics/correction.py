"""The correction of mechanical states: first the positions, then the velocities.

    phi(t, q_hat + V_q z) = 0,        C (v_hat + V zeta) = b,        V = M^-1 C^T at (q_hat, v_hat)

with `C` the Jacobian of all constraints with respect to the velocities, whose first rows are
`J = dphi/dq`, and one factorization of `C V` for both. The velocities are corrected at the
corrected positions. Neither needs the derivative of `J v`, half of the full Jacobian.

Source: Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482; Lubich, Nowak, Poehle & Engstler, MEXX (1992).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.types import BoolScalar, Y
from .._constraint.correction import (
    ConstraintNormals,
    CorrectionEquations,
    CorrectionRoot,
    FactoredGram,
    solve_correction,
)
from .._constraint.settings import NewtonProjection
from .._linalg.rows import directions_of, InverseWeights
from .._linalg.sparse import SparseRows
from .kinematics import flat, Kinematics


class InverseMetrics(NamedTuple):
    """Diagonals of `W^-1` for positions and velocities, if it is not the inverse mass matrix."""

    positions: Float[Array, " k"]
    velocities: Float[Array, " k"]

    @staticmethod
    def of(projection: NewtonProjection, y: Y) -> "InverseMetrics | None":
        diagonal = projection.inverse_metric(y)
        if diagonal is None and projection.metric != "identity":
            return None
        k = sum(leaf.size for leaf in jax.tree_util.tree_leaves(y[0]))
        if diagonal is None:
            diagonal = jnp.ones(2 * k, jnp.result_type(*jax.tree_util.tree_leaves(y)))
        return InverseMetrics(diagonal[:k], diagonal[k:])


class PositionVelocityCorrection(NamedTuple):
    """The correction of a state; `directions` are `V^T` if they are not those of the state itself."""

    here: Kinematics
    projection: NewtonProjection
    metrics: InverseMetrics | None
    directions: Float[Array, "m k"] | None

    def correct(self, fallback: Y, far: bool) -> tuple[Y, tuple[CorrectionRoot, CorrectionRoot]]:
        """Return the corrected state, and the roots for the positions and the velocities."""
        x, w = self.here.x, self.here.w
        safe_x, safe_w = jax.lax.stop_gradient(flat(fallback))
        # Replaced before any function is evaluated there: the derivative of a NaN is never zero.
        finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(w))
        x, w = jnp.where(finite, x, safe_x), jnp.where(finite, w, safe_w)

        factored, p = self._factored(x, w)
        positions = self._positions(x, safe_x, factored, p, far)
        if far:  # with the matrix at the corrected positions velocities move to the nearest ones
            factored, _ = self._factored(positions.p, w)
        # One iteration gives the velocities, unless a constraint on velocities is the user's.
        far = far and self.here.nonholonomic is not None
        context = positions.p, self.here.args
        velocities = self._solve(self.here.velocity, w, context, safe_w, factored, far)
        corrected = tuple(
            self.here.unravel(jnp.where(finite, root.p, jnp.nan))
            for root in (positions, velocities)
        )
        return corrected, (_failed_unless(finite, positions), _failed_unless(finite, velocities))

    def normals(self, x: Float[Array, " k"], w: Float[Array, " k"]) -> "MechanicalNormals":
        here = self.here._replace(x=x, w=w)
        C, p = here.rows()
        directions, valid = self.directions, jnp.asarray(True)
        if directions is None and self.metrics is not None:
            directions = directions_of(InverseWeights(self.metrics.velocities), C)
        elif directions is None:
            mass = here.mass(C)
            directions, valid = directions_of(mass, C), mass.valid
        return MechanicalNormals(ConstraintNormals(C, directions), p, valid)

    def _factored(self, x: Float[Array, " k"], w: Float[Array, " k"]) -> tuple[FactoredGram, int]:
        normals, p, valid = self.normals(x, w)
        factored = FactoredGram.of(normals, self.here.system.redundant)
        usable = factored.factorization.usable & valid
        factorization = dataclasses.replace(factored.factorization, usable=usable)
        return FactoredGram(normals, factorization), p

    def _positions(self, x, safe, factored: FactoredGram, p: int, far: bool) -> CorrectionRoot:
        if p == 0:
            return _nothing_to_do(x)
        if self.here.nonholonomic is not None or self.metrics is not None:
            normals = self._position_normals(x, factored.normals, p)
            factored = FactoredGram.of(normals, self.here.system.redundant)
        return self._solve(self.here.position, x, self.here.args, safe, factored, far)

    def _position_normals(self, x, normals: ConstraintNormals, p: int) -> ConstraintNormals:
        (C, directions), metrics = normals, self.metrics
        J = self.here._replace(x=x, w=x).position_rows(C, p)
        if metrics is not None:  # positions have a metric of their own
            return ConstraintNormals(J, directions_of(InverseWeights(metrics.positions), J))
        if isinstance(directions, SparseRows):  # `J` may have too few rows to be sparse
            return ConstraintNormals(J, directions_of(directions.metric, J))  # pyright: ignore[reportArgumentType]
        return ConstraintNormals(J, directions[:p])

    def _solve(self, residual, x, args, safe, factored: FactoredGram, far: bool) -> CorrectionRoot:
        t, directions = self.here.t, factored.normals.directions
        residual = convert_closure(residual, t, x, args)
        redundant = self.here.system.redundant
        equations = CorrectionEquations(residual, t, x, args, None, directions, redundant)
        return solve_correction(equations, safe, self.projection, far, factored)


class MechanicalNormals(NamedTuple):
    """The constraint normals with respect to the velocities, the number of their rows that belong to
    positions, and whether the mass matrix can be used."""

    normals: ConstraintNormals
    num_positions: int
    valid: BoolScalar


def _nothing_to_do(x: Float[Array, " k"]) -> CorrectionRoot:
    yes, zero = jnp.asarray(True), jnp.zeros((), x.dtype)
    return CorrectionRoot(x, jnp.zeros((0,), x.dtype), jnp.zeros((), jnp.int32), zero, yes, yes)


def _failed_unless(finite: BoolScalar, root: CorrectionRoot) -> CorrectionRoot:
    residual = jnp.where(finite, root.residual, jnp.nan)
    return root._replace(residual=residual, success=root.success & finite)
