"""The root of the correction: `z` in `g(t, x + V z, args) = 0`, and its derivative.

Vectors only; states as pytrees are the business of `_projection.py`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ._constraint import jacobian, row_scale
from ._custom_types import Args, BoolScalar, FloatScalar, IntScalar
from ._linear import combine, Factorization, factorize, gram, PseudoInverse


class CorrectionProblem(NamedTuple):
    """Everything the root depends on differentiably."""

    residual: Callable
    t: Array
    x: Float[Array, " n"]
    args: Args
    inverse_metric: Float[Array, " n"] | None = None
    rows: Float[Array, "m n"] | None = None  # `V^T` where it does not depend on `x`
    redundant: bool = False

    def g(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.residual(self.t, x, self.args)

    def weighted(self, G: Float[Array, "m n"]) -> Float[Array, "m n"]:
        """`V^T = G W^-1`, the directions as rows, unless they are given."""
        if self.rows is not None:
            return self.rows
        return G if self.inverse_metric is None else G * self.inverse_metric[None, :]

    def displaced(self, z: Float[Array, " m"]) -> Float[Array, " n"]:
        """`x + V z` without forming `V`."""
        if self.rows is not None:
            return self.x + combine(z, self.rows)
        _, pullback = jax.vjp(self.g, self.x)
        (d,) = pullback(z)
        return self.x + (d if self.inverse_metric is None else self.inverse_metric * d)


class CorrectionRoot(NamedTuple):
    """The corrected point, its multipliers, and how it went."""

    p: Float[Array, " n"]
    z: Float[Array, " m"]
    iterations: IntScalar
    residual: FloatScalar
    full_rank: BoolScalar
    success: BoolScalar


# Scaled residual, in rounding units, at which nothing more can be gained. At 4 units the
# circle of the paper's Example 2.1 is left by up to 1.8e-15, at half a unit by 4.4e-16.
_ROUNDING = 0.5


class _Iterate(NamedTuple):
    z: Float[Array, " m"]
    r: Float[Array, " m"]
    level: FloatScalar  # max_i |r_i| / scale_i
    iterations: IntScalar
    progress: BoolScalar  # whether the last iteration lowered the residual


class _Equations(NamedTuple):
    """The `m` equations `g(t, x + V z, args) = 0` in the multipliers `z`."""

    problem: CorrectionProblem
    directions: Float[Array, "m n"]
    scale: Float[Array, " m"]

    def point(self, z: Float[Array, " m"]) -> Float[Array, " n"]:
        return self.problem.x + combine(z, self.directions)

    def at(self, z: Float[Array, " m"]) -> tuple[Float[Array, " m"], FloatScalar]:
        r = self.problem.g(self.point(z))
        return r, self.level(r)

    def level(self, r: Float[Array, " m"]) -> FloatScalar:
        return jnp.max(jnp.abs(r) / self.scale)

    def lowered(self, state: _Iterate, dz: Float[Array, " m"]) -> _Iterate:
        """The step `z - dz` if it lowers the residual, else the state as it was."""
        z = state.z - dz
        r, level = self.at(z)
        progress = level < state.level
        kept = jtu.tree_map(
            lambda new, old: jnp.where(progress, new, old), (z, r, level), state[:3]
        )
        return _Iterate(*kept, state.iterations + 1, progress)


def _chord(
    equations: _Equations,
    r: Float[Array, " m"],
    factorization: Factorization | PseudoInverse,
    max_steps: int,
) -> _Iterate:
    """Simplified Newton: one factorization throughout. Two iterations are nearly always
    enough, and are written out so that they fuse with the step around them.

    A point that is on the manifold to rounding stays where it is: a correction of that size is
    large for a component that is small."""
    z, level = jnp.zeros_like(r), equations.level(r)
    needed = level > _ROUNDING * jnp.finfo(r.dtype).eps
    for _ in range(min(2, max_steps)):
        z = jnp.where(needed, z - factorization.solve(r), z)
        r, level = equations.at(z)
    return jax.lax.while_loop(
        lambda s: (
            (s.level > _ROUNDING * jnp.finfo(r.dtype).eps) & s.progress & (s.iterations < max_steps)
        ),
        lambda s: equations.lowered(s, factorization.solve(s.r)),
        _Iterate(z, r, level, jnp.asarray(min(2, max_steps), jnp.int32), jnp.asarray(True)),
    )


def _damped_newton(
    equations: _Equations, r: Float[Array, " m"], max_steps: int, tolerance: Any
) -> _Iterate:
    """A new Jacobian in every iteration, and a quarter of the step while the residual grows."""

    def unfinished(carry: tuple[_Iterate, FloatScalar]) -> BoolScalar:
        s, _ = carry
        stalled = ~s.progress & (s.level <= tolerance)
        rounded = s.level <= _ROUNDING * jnp.finfo(r.dtype).eps
        return ~rounded & ~stalled & (s.iterations < max_steps)

    def advance(carry: tuple[_Iterate, FloatScalar]) -> tuple[_Iterate, FloatScalar]:
        s, damping = carry
        _, G = jacobian(equations.problem.g, equations.point(s.z))
        redundant = equations.problem.redundant
        dz = factorize(gram(G, equations.directions), redundant).solve(s.r)
        s = equations.lowered(s, damping * dz)
        return s, jnp.where(s.progress, jnp.ones_like(damping), damping / 4)

    level = equations.level(r)
    start = _Iterate(jnp.zeros_like(r), r, level, jnp.zeros((), jnp.int32), jnp.asarray(True))
    return jax.lax.while_loop(unfinished, advance, (start, jnp.ones_like(level)))[0]


class Linearization(NamedTuple):
    """The Jacobian at the point that is corrected, and `G V`, factored."""

    G: Float[Array, "m n"]
    factorization: Factorization | PseudoInverse


def linearize(problem: CorrectionProblem) -> Linearization:
    _, G = jacobian(problem.g, problem.x)
    return Linearization(G, factorize(gram(G, problem.weighted(G)), problem.redundant))


def correct_once(
    problem: CorrectionProblem,
    safe: Float[Array, " n"],
    linearization: Linearization | None = None,
) -> CorrectionRoot:
    """One Newton step, `x - V (G V)^-1 g(x)`, successful if it lowers the residual.

    Differentiated as it stands: it is a map of its own, not an approximation of the root.
    """
    finite = jnp.all(jnp.isfinite(problem.x))
    problem = problem._replace(x=jnp.where(finite, problem.x, safe))
    G, factorization = linearize(problem) if linearization is None else linearization
    equations = _Equations(problem, problem.weighted(G), row_scale(G, problem.x))
    r = problem.g(problem.x)
    z = -factorization.solve(r)
    before, (_, after) = equations.level(r), equations.at(z)
    rounding = 50 * jnp.finfo(r.dtype).eps
    success = finite & factorization.full_rank & (after <= jnp.maximum(before, rounding))
    p = jnp.where(success, equations.point(z), problem.x)
    residual = jnp.where(finite, after, jnp.nan)
    iterations = jnp.ones((), jnp.int32)
    return CorrectionRoot(p, z, iterations, residual, factorization.full_rank, success)


@eqx.filter_custom_jvp
def solve_correction(
    problem: CorrectionProblem,
    safe: Float[Array, " n"],
    max_steps: int,
    tolerance: Any,
    far: bool,
    linearization: Linearization | None = None,
) -> CorrectionRoot:
    """Solve `g(t, x + V z, args) = 0` for `z`.

    The derivative of a failed correction is taken at `safe`. Corrections that share a
    Jacobian and its factorization pass them on as `linearization`.
    """
    del safe
    G, factorization = linearize(problem) if linearization is None else linearization
    r = problem.g(problem.x)
    equations = _Equations(problem, problem.weighted(G), row_scale(G, problem.x))
    if far:
        root = _damped_newton(equations, r, max_steps, tolerance)
    else:
        root = _chord(equations, r, factorization, max_steps)
    success = (root.level <= tolerance) & factorization.full_rank
    p = jnp.where(success, equations.point(root.z), problem.x)
    return CorrectionRoot(p, root.z, root.iterations, root.level, factorization.full_rank, success)


# Differentiate g(p, theta) = 0 with p = x + V(x, theta) z:
#     G(p) (dx + d[V] z + V dz) + g_theta dtheta = 0
#     dz = -(G(p) V)^-1 (G(p) (dx + d[V] z) + g_theta dtheta),   dp = dx + d[V] z + V dz.
# `d[V] z` is the curvature term: the derivative of `V z` at fixed `z`. Everything is written
# in terms of the output root, so that the rule can itself be differentiated.
@solve_correction.def_jvp
def _derivative(primals, tangents):
    problem, safe, *_ = primals
    problem_dot, *_ = tangents
    root = solve_correction(*primals)
    # A failed projection may have met NaN. Move to a point where g is finite *before*
    # differentiating: selecting afterwards would leave 0 * NaN in reverse mode.
    problem = problem._replace(x=jnp.where(root.success, problem.x, safe))
    p = jnp.where(root.success, root.p, safe)
    z = jnp.where(root.success, root.z, 0)

    _, moved = eqx.filter_jvp(lambda q: q.displaced(z), (problem,), (problem_dot,))
    zero = jnp.zeros_like(problem.x)
    moved = zero if moved is None else moved
    _, slope = eqx.filter_jvp(lambda q, p: q.g(p), (problem, p), (problem_dot, moved))
    directions = problem.weighted(jacobian(problem.g, problem.x)[1])
    B = gram(jacobian(problem.g, p)[1], directions)
    dz = -factorize(B, problem.redundant).solve(slope)
    p_dot = moved + combine(dz, directions)
    root_dot = CorrectionRoot(p_dot, dz, None, jnp.zeros_like(root.residual), None, None)
    return root, root_dot
