"""Distance of states from the manifold."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, FloatScalar, Y
from .checks import check_constraint, check_constraint_type, check_state
from .constraint import AbstractConstraint
from .correction import equations_of
from .settings import NewtonProjection


@clear_errors
@numbers_as_arrays("y", "args", times=("t",))
@eqx.filter_jit
def constraint_violation(
    constraint: AbstractConstraint, t: Any, y: Y, args: Args = None
) -> FloatScalar:
    """Distance from the manifold: `max_i |g_i| / scale_i`, `scale_i = max_j |G_ij| (|y_j| + 1)`.

    **Arguments:**

    - `constraint`: the constraint.
    - `t`: a time, or the times of a saved trajectory, shape `(times,)`.
    - `y`: the state, or the saved states with a leading axis of length `times`.
    - `args`: as for the constraint.

    **Returns:**

    One number, the largest over the residuals and over all finite times (the unused end of a
    `SaveAt(steps=True)` buffer is skipped). Round-off is about `1e-16` in double precision. For
    absolute residuals call the constraint itself.

    The scale is not smaller for states smaller than 1: a point that is off by all of the size `s` of a
    state has a violation of about `s`. Rescale states below 1e-6, see [`NewtonProjection`][].
    """
    check_constraint_type(constraint, "constraint_violation(constraint, t, y, args)")
    check_state(y, "y")
    t = jnp.asarray(t)
    if t.ndim > 1:
        raise ValueError(f"`t` must be a scalar or of shape (times,), got shape {t.shape}.")
    if t.ndim == 0:
        return _violation(constraint, t, y, args)
    for leaf in jtu.tree_leaves(y):
        if jnp.shape(leaf)[:1] != t.shape:
            raise ValueError(
                f"`y` must have a leading axis of length {t.shape[0]} as `t` has, got a leaf of shape {jnp.shape(leaf)}."
            )
    violations = jax.vmap(lambda t, y: _violation(constraint, t, y, args))(t, y)
    return jnp.max(jnp.where(jnp.isfinite(t), violations, 0.0), initial=0.0)


def _violation(constraint: AbstractConstraint, t: Array, y: Y, args: Args) -> FloatScalar:
    check_constraint(constraint, t, y, args)
    structure = constraint.structure_at(t, y, args)
    equations = equations_of(
        constraint, t, y, args, NewtonProjection(), constraint.redundant, structure=structure
    )
    return equations.scaled_residual(equations.normals())
