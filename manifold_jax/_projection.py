"""Correction of one point onto the manifold (the paper's perturbation approach).

The corrected point is `p = x + V z` with the direction matrix `V = W^-1 G(x)^T` fixed
at the point `x` that is corrected, and `z` the root of the square system
`g(t, x + V z, args) = 0`. This is the nearest point in the metric `W` up to second order
in the size of the correction.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ._constraint import (
    AbstractConstraint,
    check_constraint,
    check_state,
    jacobian,
    residual_vector,
    row_scale,
)
from ._custom_types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from ._linear import combine, Factorization, factorize, gram


class ProjectionInfo(eqx.Module):
    """What a projection did.

    - `multipliers`: `lambda` of shape `(m,)` in `W (p - y) + G(y)^T lambda = 0`.
    - `iterations`: Newton iterations that were taken.
    - `residual`: the scaled residual at the returned point, `max_i |g_i| / scale_i`.
    - `correction`: the distance moved, `max_j |p_j - y_j| / (|y_j| + 1)`.
    - `full_rank`: whether the rows of the Jacobian at `y` were linearly independent.
    - `success`: whether the returned point is on the manifold. If not, it is `y` itself.
    """

    multipliers: Float[Array, " m"]
    iterations: IntScalar
    residual: FloatScalar
    correction: FloatScalar
    full_rank: BoolScalar
    success: BoolScalar


class NewtonProjection(eqx.Module):
    """Projects by a simplified Newton iteration on the `m` multipliers.

    Solves `g(t, y + V z, args) = 0` for `z`, `V = W^-1 G(y)^T`, with one Jacobian and one
    factorization. Iterates until the residual is at the level of its own rounding errors or
    stops decreasing, and reports failure if the scaled residual `max_i |g_i| / scale_i`,
    `scale_i = max_j |G_ij| (|y_j| + 1)`, is then still above `tolerance`.

    The derivative is that of the implicit function, exact in forward and reverse mode and
    to any order, with respect to the point, the time, `args` and every parameter inside
    the constraint. It costs nothing unless a derivative is taken.

    **Arguments:**

    - `metric`: the norm in which the correction is orthogonal. `"identity"`; `"error"` for
        the norm of the step size controller, `w_j = 1 / (atol + rtol |y_j|)^2`; or a pytree
        like `y` of positive weights `w_j`, large for components that should stay put.
    - `max_steps`: the most Newton iterations before the projection fails.
    - `tolerance`: the largest scaled residual that counts as success. `None` is 50
        rounding units of the state's type.
    - `rtol`, `atol`: the tolerances of the step size controller; `mj.diffeqsolve` fills
        them in. With them, `Projected` raises the error estimate of a step where the
        correction is larger: the correction is a lower bound of the local error.

    Prefer a metric other than the identity when components have different units.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, section 3.1 (scaled
    residual test); Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482 (coordinate projection).
    """

    metric: Literal["identity", "error"] | Any = "identity"
    max_steps: int = eqx.field(static=True, default=20)
    tolerance: float | None = None
    rtol: RealScalarLike | None = None
    atol: RealScalarLike | None = None

    def __check_init__(self):
        if isinstance(self.metric, str) and self.metric not in ("identity", "error"):
            raise ValueError(
                f"`metric` must be 'identity', 'error' or a pytree of positive weights, got {self.metric!r}."
            )
        if not isinstance(self.max_steps, int) or self.max_steps < 1:
            raise ValueError(f"`max_steps` must be a positive integer, got {self.max_steps!r}.")

    def __call__(
        self,
        constraint: AbstractConstraint,
        t: RealScalarLike,
        y: Y,
        args: Args = None,
        *,
        fallback: Y | None = None,
        far: bool = False,
    ) -> tuple[Y, ProjectionInfo]:
        """Correct one point; see [`project`][] for arguments and return values.

        `fallback` is a state at which `g` is finite; the derivative of a failed projection
        is taken there, so that the zero cotangent of a rejected step stays zero. `far`
        is for points that are not the result of a small step: every iteration gets a new
        Jacobian, and shorter steps while the residual does not decrease.
        """
        x, unravel = jfu.ravel_pytree(y)
        safe = x if fallback is None else jfu.ravel_pytree(fallback)[0]
        t = jnp.asarray(t)

        def residual(t, x, args):
            return residual_vector(constraint, t, unravel(x), args)

        # Parameters that `g` closes over become inputs, so that they are differentiated.
        residual = eqx.filter_closure_convert(residual, t, x, args)
        inverse_metric = self._inverse_metric(y, x)
        problem = _Problem(residual, t, x, args, inverse_metric)
        tolerance = self.tolerance_for(x.dtype)
        root = _solve(problem, jax.lax.stop_gradient(safe), self.max_steps, tolerance, far)
        correction = jax.lax.stop_gradient(jnp.max(jnp.abs(root.p - x) / (jnp.abs(x) + 1)))
        info = ProjectionInfo(
            -root.z, root.iterations, root.residual, correction, root.full_rank, root.success
        )
        return unravel(root.p), info

    def tolerance_for(self, dtype: Any) -> RealScalarLike:
        """The largest scaled residual that counts as success."""
        return 50 * float(jnp.finfo(dtype).eps) if self.tolerance is None else self.tolerance

    def _inverse_metric(self, y: Y, x: Float[Array, " n"]) -> Float[Array, " n"] | None:
        """Diagonal of `W^-1`, or `None` for the identity."""
        if isinstance(self.metric, str):
            if self.metric == "identity":
                return None
            if self.rtol is None or self.atol is None:
                raise ValueError(
                    "`NewtonProjection(metric='error')` needs the tolerances: solve with `mj.diffeqsolve` and an "
                    "adaptive controller, or pass `NewtonProjection(metric='error', rtol=..., atol=...)`."
                )
            return (self.atol + self.rtol * jnp.abs(x)) ** 2
        if jtu.tree_structure(self.metric) != jtu.tree_structure(y):
            raise ValueError(
                "`metric` must have the structure of the state, "
                f"{jtu.tree_structure(y)}, got {jtu.tree_structure(self.metric)}."
            )
        weights = jtu.tree_map(lambda w, leaf: jnp.broadcast_to(jnp.asarray(w, leaf.dtype), leaf.shape), self.metric, y)
        return 1 / jfu.ravel_pytree(weights)[0]


class _Problem(NamedTuple):
    """Everything the root depends on differentiably."""

    residual: Callable
    t: Array
    x: Float[Array, " n"]
    args: Args
    inverse_metric: Float[Array, " n"] | None

    def g(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.residual(self.t, x, self.args)

    def weighted(self, G: Float[Array, "m n"]) -> Float[Array, "m n"]:
        """`V^T = G W^-1`, the directions as rows."""
        return G if self.inverse_metric is None else G * self.inverse_metric[None, :]

    def displaced(self, z: Float[Array, " m"]) -> Float[Array, " n"]:
        """`x + V z` without forming `V`."""
        _, pullback = jax.vjp(self.g, self.x)
        (d,) = pullback(z)
        return self.x + (d if self.inverse_metric is None else self.inverse_metric * d)


class _Root(NamedTuple):
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

    problem: _Problem
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
    equations: _Equations, r: Float[Array, " m"], factorization: Factorization, max_steps: int
) -> _Iterate:
    """Simplified Newton: one factorization throughout. Two iterations are nearly always
    enough, and are written out so that they fuse with the step around them."""
    z = jnp.zeros_like(r)
    for _ in range(min(2, max_steps)):
        z = z - factorization.solve(r)
        r, level = equations.at(z)
    return jax.lax.while_loop(
        lambda s: (s.level > _ROUNDING * jnp.finfo(r.dtype).eps) & s.progress & (s.iterations < max_steps),
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
        dz = factorize(gram(G, equations.directions)).solve(s.r)
        s = equations.lowered(s, damping * dz)
        return s, jnp.where(s.progress, jnp.ones_like(damping), damping / 4)

    level = equations.level(r)
    start = _Iterate(jnp.zeros_like(r), r, level, jnp.zeros((), jnp.int32), jnp.asarray(True))
    return jax.lax.while_loop(unfinished, advance, (start, jnp.ones_like(level)))[0]


@eqx.filter_custom_jvp
def _solve(
    problem: _Problem, safe: Float[Array, " n"], max_steps: int, tolerance: Any, far: bool
) -> _Root:
    del safe
    r, G = jacobian(problem.g, problem.x)
    directions = problem.weighted(G)
    factorization = factorize(gram(G, directions))
    equations = _Equations(problem, directions, row_scale(G, problem.x))
    if far:
        root = _damped_newton(equations, r, max_steps, tolerance)
    else:
        root = _chord(equations, r, factorization, max_steps)
    success = (root.level <= tolerance) & factorization.full_rank
    p = jnp.where(success, equations.point(root.z), problem.x)
    return _Root(p, root.z, root.iterations, root.level, factorization.full_rank, success)


# Differentiate g(p, theta) = 0 with p = x + V(x, theta) z:
#     G(p) (dx + d[V] z + V dz) + g_theta dtheta = 0
#     dz = -(G(p) V)^-1 (G(p) (dx + d[V] z) + g_theta dtheta),   dp = dx + d[V] z + V dz.
# `d[V] z` is the curvature term: the derivative of `V z` at fixed `z`. Everything is written
# in terms of the output root, so that the rule can itself be differentiated.
@_solve.def_jvp
def _solve_jvp(primals, tangents):
    problem, safe, max_steps, tolerance, far = primals
    problem_dot, *_ = tangents
    root = _solve(problem, safe, max_steps, tolerance, far)
    # A failed projection may have met NaN. Move to a point where g is finite *before*
    # differentiating: selecting afterwards would leave 0 * NaN in reverse mode.
    problem = problem._replace(x=jnp.where(root.success, problem.x, safe))
    p = jnp.where(root.success, root.p, safe)
    z = jnp.where(root.success, root.z, 0)

    _, moved = eqx.filter_jvp(lambda q: q.displaced(z), (problem,), (problem_dot,))
    zero = jnp.zeros_like(problem.x)
    moved = zero if moved is None else moved
    _, slope = eqx.filter_jvp(
        lambda q, p: q.g(p), (problem, p), (problem_dot, moved)
    )
    directions = problem.weighted(jacobian(problem.g, problem.x)[1])
    B = gram(jacobian(problem.g, p)[1], directions)
    dz = -factorize(B).solve(slope)
    p_dot = moved + combine(dz, directions)
    root_dot = _Root(p_dot, dz, None, jnp.zeros_like(root.residual), None, None)
    return root, root_dot


@eqx.filter_jit
def project(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args = None,
    *,
    projection: NewtonProjection | None = None,
) -> tuple[Y, ProjectionInfo]:
    """Move one point onto the manifold, `p = y + W^-1 G(y)^T z` with `g(t, p, args) = 0`.

    **Arguments:**

    - `constraint`: the manifold.
    - `t`: the time.
    - `y`: the point, any pytree of real floating-point arrays (`n` numbers).
    - `args`: passed to the constraint.
    - `projection`: metric, iteration limit and tolerance, [`NewtonProjection`][].

    **Returns:**

    `(p, info)`: the corrected point and a [`ProjectionInfo`][]. Where `info.success` is
    false, `p` is `y` unchanged. The point may be far from the manifold: every Newton
    iteration uses a new Jacobian, and a shorter step while the residual grows. Works under `jit`, `vmap`, `jvp` and `grad`.

    **Raises:**

    `TypeError` or `ValueError` for states or residuals of the wrong type or shape.

    Use [`consistent_state`][] for initial values: it raises if it cannot succeed.
    """
    check_state(y, "y")
    y = jtu.tree_map(jnp.asarray, y)
    check_constraint(constraint, t, y, args)
    projection = NewtonProjection(max_steps=50) if projection is None else projection
    return projection(constraint, t, y, args, far=True)
