"""Correction of one point onto the manifold of any residual (the paper's perturbation approach).

The corrected point is `p = x + V z` with directions `V` (shape `(n, m)`, held as the rows of `V^T`),
fixed at the point `x` that is corrected, and the root `z` of `g(t, x + V z, args) = 0`.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.derivative_rule import ForwardRule
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from .._linalg.dense import DEPENDENCE_THRESHOLD, factorize_once, gram, pseudo_invert
from .._linalg.newton import AbstractEquations, chord, damped_newton, implicit_tangent
from .._linalg.rows import AbstractRows, combine, directions_of, InverseWeights, Rows
from .._linalg.sparse import SparseRows, Structure
from .residual import as_time, jacobian, residual_vector, row_scale
from .settings import NewtonProjection


class ConstraintNormals(NamedTuple):
    """The normals of a manifold at a point: the Jacobian `G`, and the directions, the rows of `V^T`,
    along which points nearby are corrected, by default `V = W^-1 G^T`. Both `(m, k)` for `k` components
    that are moved together, by default the `n` of the state."""

    jacobian: Rows
    directions: Rows


class FactoredGram(NamedTuple):
    """The normals at a point with `G V` factored: the linearization of a correction."""

    normals: ConstraintNormals
    factorization: Any  # Factorization, Inverse or BlockFactorization

    @staticmethod
    def of(
        normals: ConstraintNormals,
        redundant: bool,
        dependent: FloatScalar | float = DEPENDENCE_THRESHOLD,
    ) -> "FactoredGram":
        """Factor `G V`; `dependent` as in `pseudo_invert`, for `redundant` equations."""
        if isinstance(normals.jacobian, AbstractRows):
            return FactoredGram(normals, normals.jacobian.factorize(normals.directions))
        A = gram(*normals)
        if not redundant:
            return FactoredGram(normals, factorize_once(A))
        return FactoredGram(normals, pseudo_invert(A, dependent))

    def solve(self, b: Float[Array, " m"]) -> Float[Array, " m"]:
        return self.factorization.solve(b)


# Redundant equations depend on each other on the manifold. At a distance `d` from it (a scaled
# residual) their gradients differ from dependent ones by up to this many times `d`, and so do the
# entries of `G V` of two points that far apart: eigenvalues of `G V` that vanish on the manifold become
# O(d) of the largest. Those of the Gram matrix `G W^-1 G^T` of one point are squares of singular
# values, O(d^2).
_PERTURBATION = 1e3


def dependence_threshold(ratio: FloatScalar) -> FloatScalar:
    """Return the fraction of the largest eigenvalue below which others count as zero, where those of
    dependent equations reach `ratio` of it: above rounding, and at most the default of `pseudo_invert`."""
    smallest = 1e4 * jnp.finfo(ratio.dtype).eps
    return jax.lax.stop_gradient(jnp.clip(ratio, smallest, DEPENDENCE_THRESHOLD))


class CorrectionEquations(AbstractEquations):
    """`g(t, x + V z, args) = 0` in the multipliers `z`; `V = W^-1 G(x)^T` unless given. With a
    `structure`, `G` is not held as an array."""

    function: Any  # (t, x, args)
    t: Array
    x: Float[Array, " n"]
    args: Args
    inverse_metric: Float[Array, " n"] | None = None
    directions: Rows | None = None
    redundant: bool = eqx.field(static=True, default=False)
    structure: Structure | None = eqx.field(static=True, default=None)

    def residual(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.function(self.t, x, self.args)

    def point(self, z: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return `x + V z` without forming `V`, so that its derivative does not either."""
        if self.directions is not None:
            return self.x + combine(z, self.directions)
        _, pullback = jax.vjp(self.residual, self.x)
        (d,) = pullback(z)
        return self.x + (d if self.inverse_metric is None else self.inverse_metric * d)

    def place_after(
        self, place: Float[Array, " n"], z: Float[Array, " m"], dz: Float[Array, " m"]
    ) -> Float[Array, " n"]:
        """Return the displacement from `x`, increased by `V dz`. The terms of `V z` of light bodies may be larger by far
        than their sum: in `V dz`, which becomes small, their rounding does, too."""
        return place + combine(dz, self.directions)  # pyright: ignore[reportArgumentType]

    def point_at(self, place: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.x + place

    def linearize(self, x: Float[Array, " n"]) -> FactoredGram:
        if isinstance(self.directions, AbstractRows):
            rows = self.directions.of_other(self.function, self.t, x, self.args)
            return FactoredGram.of(ConstraintNormals(rows, self.directions), self.redundant)
        G = self._rows(x)
        if self.directions is not None:
            return FactoredGram.of(ConstraintNormals(G, self.directions), self.redundant)
        at_start = self.normals()
        normals = ConstraintNormals(G, at_start.directions)
        if not self.redundant:
            return FactoredGram.of(normals, False)
        dependent = dependence_threshold(_PERTURBATION * self.scaled_residual(at_start))
        return FactoredGram.of(normals, True, dependent)

    def factored(self) -> FactoredGram:
        """Factor the Gram matrix at the point that is corrected."""
        normals = self.normals()
        if not self.redundant:
            return FactoredGram.of(normals, False)
        dependent = dependence_threshold((_PERTURBATION * self.scaled_residual(normals)) ** 2)
        return FactoredGram.of(normals, True, dependent)

    def normals(self) -> ConstraintNormals:
        G = self._rows(self.x)
        if self.directions is not None:
            return ConstraintNormals(G, self.directions)
        if self.inverse_metric is None:
            return ConstraintNormals(G, G)
        return ConstraintNormals(G, directions_of(InverseWeights(self.inverse_metric), G))

    def _rows(self, x: Float[Array, " n"]) -> Rows:
        if self.structure is None:
            return jacobian(self.residual, x)[1]
        return SparseRows(self.function, self.t, x, self.args, self.structure)

    def scaled_residual(self, normals: ConstraintNormals) -> FloatScalar:
        """Return the largest component of the residual, relative to its typical size: to leading
        order the distance from the manifold as a fraction of the size of the state."""
        return jnp.max(
            jnp.abs(self.residual(self.x)) / row_scale(normals.jacobian, self.x, self.redundant)
        )

    def starting_at(self, x: Float[Array, " n"]) -> "CorrectionEquations":
        return dataclasses.replace(self, x=x)

    def along(self, directions: Rows) -> "CorrectionEquations":
        return dataclasses.replace(self, directions=directions)


class CorrectionRoot(NamedTuple):
    """The corrected point, its multipliers, and a report of the iteration."""

    p: Float[Array, " n"]
    z: Float[Array, " m"]
    iterations: IntScalar
    residual: FloatScalar
    full_rank: BoolScalar
    success: BoolScalar


def solve_correction(
    equations: CorrectionEquations,
    safe: Float[Array, " n"],
    projection: NewtonProjection,
    far: bool,
    factored: FactoredGram | None = None,
) -> CorrectionRoot:
    """Find the root with the settings in `projection`.

    The derivative of a failed correction is taken at `safe`. Corrections that share a Jacobian and its
    factorization pass them on as `factored`.
    """
    if projection.max_steps == 1 and not far:
        return _correct_once(equations, safe, factored)
    tolerance = projection.tolerance_for(equations.x.dtype)
    return _solve(equations, safe, projection.max_steps, tolerance, far, factored)


def _correct_once(
    equations: CorrectionEquations, safe: Float[Array, " n"], factored: FactoredGram | None
) -> CorrectionRoot:
    """Make one Newton step, `x - V (G V)^-1 g(x)`, successful if it lowers the residual.

    Differentiated as it stands: it is a map of its own, not an approximation of the root.
    """
    finite = jnp.all(jnp.isfinite(equations.x))
    equations = equations.starting_at(jnp.where(finite, equations.x, safe))
    if factored is None:
        factored = equations.factored()
    (G, directions), factorization = factored
    scale = row_scale(G, equations.x, equations.redundant)
    r = equations.residual(equations.x)
    z = -factorization.solve(r)
    p = equations.x + combine(z, directions)
    before, after = (jnp.max(jnp.abs(x) / scale) for x in (r, equations.residual(p)))
    rounding = 50 * jnp.finfo(r.dtype).eps
    success = finite & factorization.usable & (after <= jnp.maximum(before, rounding))
    p = jnp.where(success, p, equations.x)
    residual = jnp.where(finite, after, jnp.nan)
    one = jnp.ones((), jnp.int32)
    return CorrectionRoot(p, z, one, residual, factorization.usable, success)


@ForwardRule
def _solve(
    equations: CorrectionEquations,
    safe: Float[Array, " n"],
    max_steps: int,
    tolerance: Any,
    far: bool,
    factored: FactoredGram | None,
) -> CorrectionRoot:
    del safe
    if factored is None:
        factored = equations.factored()
    (G, directions), factorization = factored
    r = equations.residual(equations.x)
    fixed, scale, z = (
        equations.along(directions),
        row_scale(G, equations.x, equations.redundant),
        jnp.zeros_like(r),
    )
    still = jnp.zeros_like(equations.x)
    if far:
        root = damped_newton(fixed, z, still, r, scale, max_steps, tolerance)
    else:
        root = chord(fixed, factored, z, still, r, scale, max_steps)
    full_rank = factorization.usable
    success = (root.scaled_residual <= tolerance) & full_rank
    p = jnp.where(success, fixed.point_at(root.place), equations.x)
    return CorrectionRoot(p, root.z, root.iterations, root.scaled_residual, full_rank, success)


@_solve.define_jvp
def _solve_jvp(root, primals, tangents):
    equations, safe, *_ = primals
    # A failed projection may have met NaN. Move to a point where g is finite *before*
    # differentiating: selecting afterwards would leave 0 * NaN in reverse mode.
    equations = equations.starting_at(jnp.where(root.success, equations.x, safe))
    z = jnp.where(root.success, root.z, 0)
    dz, moved, factored = implicit_tangent(equations, tangents[0], z)
    p_dot = moved + combine(dz, factored.normals.directions)  # pyright: ignore[reportAttributeAccessIssue]
    return CorrectionRoot(p_dot, dz, None, jnp.zeros_like(root.residual), None, None)  # pyright: ignore[reportArgumentType]


def equations_of(
    function: Any,
    t: RealScalarLike,
    y: Y,
    args: Args,
    projection: NewtonProjection,
    redundant: bool,
    directions: Float[Array, "m n"] | None = None,
    structure: Structure | None = None,
) -> CorrectionEquations:
    """Return the equations for the residual `function(t, y, args)` of a whole state."""
    x, unravel = jfu.ravel_pytree(y)
    t = as_time(t, x.dtype)
    # Closed-over parameters of the residual become inputs, so that they are differentiated.
    residual = convert_closure(
        lambda t, x, args: residual_vector(function, t, unravel(x), args), t, x, args
    )
    metric = projection.inverse_metric_without_masses(y)
    return CorrectionEquations(residual, t, x, args, metric, directions, redundant, structure)


def without_normal_part(
    normals: ConstraintNormals,
    e: Float[Array, " k"],
    rate: Float[Array, " m"],
    redundant: bool = False,
) -> Float[Array, " k"]:
    """Return `e - V (G V)^-1 rate`, which is tangent if `rate = G e`."""
    return e - combine(FactoredGram.of(normals, redundant).solve(rate), normals.directions)
