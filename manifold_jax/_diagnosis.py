"""Why a point could not be moved onto the manifold."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ._constraint import AbstractConstraint
from ._custom_types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from ._mechanics import MechanicalConstraint


NOT_THERE = 3

_MESSAGES = (
    "`constraint` is not finite at the time and state given. Start from a state at which g(t, {y}, args) is "
    "defined.",
    "The Jacobian dg/dy of `constraint` does not have full rank at `{y}`: an equation ignores y, depends on the "
    "others (redundant), or `{y}` is a singular point. Remove dependent equations (or, for an "
    "`mj.MechanicalSystem`, pass `redundant=True`), or start elsewhere.",
    "`{y}` could not be made consistent with `constraint`: no nearby state satisfies g(t, y, args) = 0. Start "
    "closer to the manifold, or check that the equations can hold at the same time.",
    '`{y}` is not on the manifold. Write `consistent="project"` to have it moved there, or correct it first with '
    "`mj.consistent_state`.",
    "`mass_matrix` is not symmetric at `{y}`. Return `(M + M.T) / 2`, or check its formula.",
    "`mass_matrix` is not positive definite at `{y}` (a matrix may be singular, but not for motions that the "
    "constraints allow; a scalar or a diagonal must be positive). Check its signs and that no mass is missing.",
)


def failure_cause(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args,
    residual: FloatScalar,
    full_rank: BoolScalar,
) -> IntScalar:
    """Which of the messages applies if a correction of `y` failed with this outcome."""
    cause = jnp.where(jnp.isfinite(residual), jnp.where(full_rank, 2, 1), 0)
    if not isinstance(constraint, MechanicalConstraint):
        return cause
    symmetric, positive = constraint.check_mass(t, y, args)
    return jnp.where(symmetric, jnp.where(positive, cause, 5), 4)


def raise_unless(success: BoolScalar, cause: IntScalar, value: Any, name: str) -> Any:
    """Attach the error that names the cause of a failure to `value`; `name` is that of the state.

    Of a batch the largest number is reported, so that points without fault must have the least.
    """
    messages = [message.format(y=name) for message in _MESSAGES]
    return eqx.branched_error_if(value, ~success, jnp.where(success, 0, cause), messages)
