"""Settings of corrections: the norm, the number of iterations and the tolerance."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike, Y


class NewtonProjection(eqx.Module):
    """Settings of the correction of a point `y` to `p = y + V z`, `V = W^-1 G(y)^T`, by a simplified Newton
    iteration on the `m` multipliers `z`.

    `V` is fixed at the point that is corrected, and `z` the root of the square system
    `g(t, y + V z, args) = 0`: the nearest point in the metric `W` up to second order in the size of
    the correction. One Jacobian and one factorization. Iterates until the residual is at the level
    of its own rounding errors or stops decreasing, and reports failure if the scaled residual
    `max_i |g_i| / scale_i`, `scale_i = max_j |G_ij| (|y_j| + 1)`, is then still above `tolerance`.

    Components smaller than 1 count as 1 there, as they may be displacements from something whose
    size the state does not show. A state of size `s < 1` is on the manifold to about `eps / s` of
    its own size, and below 50 `eps` (1e-14, in single precision 6e-6) any point counts as on it.
    Choose units in which states are not smaller than about 1e-6 (1e-2).

    The derivative is that of the implicit function, exact in forward and reverse mode and
    to any order, with respect to the point, the time, `args` and every parameter inside
    the constraint. It costs nothing unless a derivative is taken.

    **Arguments:**

    - `metric`: the norm in which the correction is orthogonal. By default, `None`, the mass matrix for
        the constraint of a [`MechanicalSystem`][]; otherwise the identity, or `"error"` if `atol` is
        below the rounding of a number of size one, so that far smaller components count, too.
        `"identity"` in any case; `"error"` for the norm of the step size controller,
        `w_j = 1 / (atol + rtol |y_j|)^2`; or a pytree like `y` of positive weights `w_j`, large for
        components that should hardly move.
    - `max_steps`: the largest number of Newton iterations before the projection fails. 1 is a method of
        its own, post-stabilization: one Newton step per step of the solver, successful if it
        lowers the residual; states are then near the manifold (the square of the local error),
        not on it to round-off.
    - `tolerance`: the largest scaled residual that counts as success. `None` is 50 rounding units of
        the state's type. Where a residual has larger rounding errors than that (large terms that
        cancel) corrections fail: write it without cancellation, or raise the tolerance.
    - `rtol`, `atol`: the tolerances of the step size controller, for `metric="error"`;
        `mj.diffeqsolve` fills them in.

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

    def tolerance_for(self, dtype: Any) -> RealScalarLike:
        """Return the largest scaled residual that counts as success."""
        return 50 * float(jnp.finfo(dtype).eps) if self.tolerance is None else self.tolerance

    @property
    def is_euclidean(self) -> bool:
        """Whether the nearest point is that in the plain norm, for constraints without masses."""
        return self.metric is None or (isinstance(self.metric, str) and self.metric == "identity")

    def inverse_metric(self, y: Y) -> Float[Array, " n"] | None:
        """Return the diagonal of `W^-1`, in the order of `ravel_pytree(y)`; `None` for the identity,
        and for the masses of a mechanical system unless `metric="identity"`."""
        if self.metric is None or isinstance(self.metric, str):
            return self._error_weights(y) if self.metric == "error" else None
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

    def inverse_metric_without_masses(self, y: Y) -> Float[Array, " n"] | None:
        """Return the diagonal of `W^-1` for constraints without masses, where `None` is the identity.
        In the identity a correction of rounding size of a large component moves a small one by as much:
        Robertson's reaction to 1e11 with `atol=1e-14` then has 6.0 digits instead of 7.2, and takes 857
        steps instead of 655."""
        atol = self.atol if isinstance(self.rtol, int | float) else None
        if (
            self.metric is None
            and isinstance(atol, int | float)
            and atol < _SMALLEST * _rounding(y)
        ):
            return self._error_weights(y)
        return self.inverse_metric(y)

    def _error_weights(self, y: Y) -> Float[Array, " n"]:
        if self.rtol is None or self.atol is None:
            raise ValueError(
                "`NewtonProjection(metric='error')` needs the tolerances: solve with `mj.diffeqsolve` and an "
                "adaptive controller, or pass `NewtonProjection(metric='error', rtol=..., atol=...)`."
            )
        return (self.atol + self.rtol * jnp.abs(jfu.ravel_pytree(y)[0])) ** 2


# In units of rounding.
_SMALLEST = 100


def _rounding(y: Y) -> float:
    return float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(y))).eps)


def _may_be_positive(number: Any) -> bool:
    """Whether weights are positive; true while tracing, when they are unknown."""
    return isinstance(number, jax.core.Tracer) or bool(np.all(np.asarray(number) > 0))
