"""Correction of one point onto the manifold (the paper's perturbation approach).

The corrected point is `p = x + V z` with the direction matrix `V = W^-1 G(x)^T` fixed
at the point `x` that is corrected, and `z` the root of the square system
`g(t, x + V z, args) = 0`. This is the nearest point in the metric `W` up to second order
in the size of the correction.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from ._constraint import (
    AbstractConstraint,
    as_time,
    check_constraint,
    check_constraint_type,
    check_state,
    jacobian,
    residual_vector,
)
from ._custom_types import Args, RealScalarLike, Y
from ._diagnosis import failure_cause, raise_unless
from ._errors import clear_errors
from ._mechanics import MechanicalConstraint
from ._mechanics.constraint import Kinematics
from ._newton import correct_once, CorrectionProblem, solve_correction
from ._projection_info import ProjectionInfo
from ._two_stage import correct_in_two_stages, Settings


class NewtonProjection(eqx.Module):
    """Projects by a simplified Newton iteration on the `m` multipliers.

    Solves `g(t, y + V z, args) = 0` for `z`, `V = W^-1 G(y)^T`, with one Jacobian and one
    factorization. Iterates until the residual is at the level of its own rounding errors or
    stops decreasing, and reports failure if the scaled residual `max_i |g_i| / scale_i`,
    `scale_i = max_j |G_ij| (|y_j| + 1)`, is then still above `tolerance`.

    Components smaller than 1 count as 1 there, as they may be displacements from something whose
    size the state does not show. A state of size `s < 1` is on the manifold to about `eps / s` of
    its own size, and below 50 `eps` (1e-14, in single precision 6e-6) any point counts as on it.
    Choose units in which states are not smaller than about 1e-6 (1e-2).

    The derivative is that of the implicit function, exact in forward and reverse mode and
    to any order, with respect to the point, the time, `args` and every parameter inside
    the constraint. It costs nothing unless a derivative is taken.

    **Arguments:**

    - `metric`: the norm in which the correction is orthogonal. `None` is the identity, and
        the mass matrix for the constraint of a [`MechanicalSystem`][]; `"identity"` in any case; `"error"` for
        the norm of the step size controller, `w_j = 1 / (atol + rtol |y_j|)^2`; or a pytree
        like `y` of positive weights `w_j`, large for components that should stay put.
    - `max_steps`: the most Newton iterations before the projection fails. 1 is a method of
        its own, post-stabilization: one Newton step per step of the solver, successful if it
        lowers the residual; states are then near the manifold (the square of the local error),
        not on it to round-off.
    - `tolerance`: the largest scaled residual that counts as success. `None` is 50
        rounding units of the state's type. Where a residual has larger rounding errors than
        that (large terms that cancel) corrections fail: write it without cancellation, or
        raise the tolerance.
    - `rtol`, `atol`: the tolerances of the step size controller; `mj.diffeqsolve` fills
        them in. With them, `Projected` raises the error estimate of a step where the
        correction is larger: the correction is a lower bound of the local error.

    Prefer a metric other than the identity when components have different units.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, section 3.1 (scaled
    residual test); Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482 (coordinate projection);
    Ascher, Chin, Petzold & Reich, Mech. Struct. Mach. 23 (1995) 135-157 (post-stabilization).
    """

    metric: Literal["identity", "error"] | Any | None = None
    max_steps: int = eqx.field(static=True, default=20)
    tolerance: float | None = None
    rtol: RealScalarLike | None = None
    atol: RealScalarLike | None = None

    def __check_init__(self):
        if isinstance(self.metric, str) and self.metric not in ("identity", "error"):
            raise ValueError(
                f"`metric` must be 'identity', 'error' or a pytree of positive weights, got {self.metric!r}."
            )
        if not isinstance(self.metric, str) and not all(
            map(_may_be_positive, jtu.tree_leaves(self.metric))
        ):
            raise ValueError(
                f"`metric` must have positive weights only, got {self.metric}: the larger one is, the less the "
                "component is moved."
            )
        if not all(map(_may_be_positive, jtu.tree_leaves(self.tolerance))):
            raise ValueError(
                f"`tolerance` must be positive, got {self.tolerance}: it is the largest scaled residual that counts as "
                "success. None is 50 rounding units."
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
        directions: Float[Array, "m n"] | None = None,
    ) -> tuple[Y, ProjectionInfo]:
        """Correct one point; see [`project`][] for arguments and return values.

        `fallback` is a state at which `g` is finite; the derivative of a failed projection
        is taken there, so that the zero cotangent of a rejected step stays zero. `far`
        is for points that are not the result of a small step: every iteration gets a new
        Jacobian, and shorter steps while the residual does not decrease. `directions` are the
        rows of `V^T` to correct along, if not those at `y`, from [`correction_directions`][].
        """
        fallback = y if fallback is None else fallback
        x, unravel = jfu.ravel_pytree(y)
        t = as_time(t, x.dtype)
        if isinstance(constraint, MechanicalConstraint):
            return self._correct_mechanics(constraint, t, y, args, fallback, far, directions)
        safe = jax.lax.stop_gradient(jfu.ravel_pytree(fallback)[0])

        def residual(t, x, args):
            return residual_vector(constraint, t, unravel(x), args)

        # Parameters that `g` closes over become inputs, so that they are differentiated.
        residual = eqx.filter_closure_convert(residual, t, x, args)
        inverse_metric = self._inverse_metric(y, x)
        problem = CorrectionProblem(
            residual, t, x, args, inverse_metric, directions, constraint.redundant
        )
        tolerance = self.tolerance_for(x.dtype)
        if self.max_steps == 1 and not far:
            root = correct_once(problem, safe)
        else:
            root = solve_correction(problem, safe, self.max_steps, tolerance, far)
        return unravel(root.p), ProjectionInfo.of_correction(x, root)

    def _correct_mechanics(
        self,
        constraint: MechanicalConstraint,
        t: Array,
        y: Y,
        args: Args,
        fallback: Y,
        far: bool,
        directions: Float[Array, "m n"] | None,
    ) -> tuple[Y, ProjectionInfo]:
        x, _ = jfu.ravel_pytree(y)
        inverse_metric = self._inverse_metric(y, x)
        if inverse_metric is None and self.metric == "identity":
            inverse_metric = jnp.ones_like(x)
        halves = None if inverse_metric is None else tuple(jnp.split(inverse_metric, 2))
        settings = Settings(halves, directions, self.max_steps, self.tolerance_for(x.dtype), far)
        corrected, *roots = correct_in_two_stages(constraint, t, y, args, fallback, settings)
        return corrected, ProjectionInfo.of_correction(x, *roots)

    def correction_directions(
        self, constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n"]]:
        """The Jacobian at `y` and the rows of `V^T`, along which points near `y` are
        corrected.

        For mechanics with respect to the velocities only, `n` being half of the state.
        """
        x, unravel = jfu.ravel_pytree(y)
        t = as_time(t, x.dtype)
        inverse_metric = self._inverse_metric(y, x)
        if not isinstance(constraint, MechanicalConstraint):
            _, G = jacobian(lambda x: residual_vector(constraint, t, unravel(x), args), x)
            return G, self.weighted(G, y)
        equations = Kinematics(constraint, y)
        q, v = equations.flat(y)
        C, _ = equations.rows(t, q, v, args)
        if inverse_metric is not None:
            return C, C * jnp.split(inverse_metric, 2)[1][None, :]
        if self.metric == "identity":
            return C, C
        return C, equations.mass(t, q, v, args, C).solve(C)

    def weighted(self, G: Float[Array, "m n"], y: Y) -> Float[Array, "m n"]:
        """`G W^-1`; the identity instead of a mass matrix."""
        inverse_metric = self._inverse_metric(y, jfu.ravel_pytree(y)[0])
        return G if inverse_metric is None else G * inverse_metric[None, :]

    def tolerance_for(self, dtype: Any) -> RealScalarLike:
        """The largest scaled residual that counts as success."""
        return 50 * float(jnp.finfo(dtype).eps) if self.tolerance is None else self.tolerance

    def _inverse_metric(self, y: Y, x: Float[Array, " n"]) -> Float[Array, " n"] | None:
        """Diagonal of `W^-1`, or `None` for the identity."""
        if self.metric is None or isinstance(self.metric, str):
            if self.metric != "error":
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

        def spread(weight: Any, leaf: Array) -> Array:
            if jnp.shape(weight) not in ((), jnp.shape(leaf)):
                raise ValueError(
                    "`metric` must have for each leaf of the state one weight or as many as it has numbers: shape "
                    f"{jnp.shape(leaf)} or (), got {jnp.shape(weight)}."
                )
            return jnp.broadcast_to(jnp.asarray(weight, leaf.dtype), leaf.shape)

        return 1 / jfu.ravel_pytree(jtu.tree_map(spread, self.metric, y))[0]


def _may_be_positive(number: Any) -> bool:
    """Unknown while tracing."""
    return isinstance(number, jax.core.Tracer) or bool(np.all(np.asarray(number) > 0))


@clear_errors
@eqx.filter_jit
def project(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args = None,
    *,
    projection: NewtonProjection | None = None,
    throw: bool = True,
) -> tuple[Y, ProjectionInfo]:
    """Move one point onto the manifold, `p = y + W^-1 G(y)^T z` with `g(t, p, args) = 0`.

    **Arguments:**

    - `constraint`: the manifold.
    - `t`: the time.
    - `y`: the point, any pytree of real floating-point arrays (`n` numbers), in units in which it
        is not smaller than about 1e-6, see [`NewtonProjection`][].
    - `args`: passed to the constraint.
    - `projection`: metric, iteration limit and tolerance, [`NewtonProjection`][].
    - `throw`: raise if the point cannot be moved onto the manifold. With `throw=False` look at
        `info.success`: where it is false, `p` is `y` unchanged. There is then no host callback in
        the compiled function.

    **Returns:**

    `(p, info)`: the corrected point and a [`ProjectionInfo`][]. The point may be far from the
    manifold: every Newton iteration uses a new Jacobian, and a shorter step while the residual
    grows. Works under `jit`, `vmap`, `jvp` and `grad`.

    **Raises:**

    `TypeError` or `ValueError` for states or residuals of the wrong type or shape. With `throw=True`
    a `RuntimeError` (under `jit` too, and for a batch if one of its points fails) that says whether
    the constraint was not finite, its Jacobian rank deficient, or the equations could not be
    satisfied.

    [`consistent_state`][] is the same for initial values.
    """
    projection = NewtonProjection(max_steps=50) if projection is None else projection
    return moved(projection, constraint, t, y, args, "y", throw)


def moved(
    projection: NewtonProjection,
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args,
    name: str,
    throw: bool,
) -> tuple[Y, ProjectionInfo]:
    """One point that may be far from the manifold, `name` in messages."""
    check_constraint_type(constraint)
    check_state(y, name)
    y = jtu.tree_map(jnp.asarray, y)
    check_constraint(constraint, t, y, args)
    p, info = projection(constraint, t, y, args, far=True)
    if throw:
        cause = failure_cause(constraint, t, y, args, info.residual, info.full_rank)
        p = raise_unless(info.success, cause, p, name)
    return p, info
