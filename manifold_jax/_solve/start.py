"""The initial value: moved onto the manifold, checked, or trusted."""

from typing import Literal, NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.rejection import is_finite
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.diagnosis import Diagnosis, NOT_THERE
from .._constraint.project import consistent_state
from .._constraint.settings import NewtonProjection
from .._constraint.violation import constraint_violation


Consistent: TypeAlias = Literal["project", "check", "assume"]


class StartInfo(NamedTuple):
    """How an initial value was treated: the change made, and whether the value can be used."""

    correction: FloatScalar
    success: BoolScalar


def start_state(
    constraint: AbstractConstraint,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    projection: NewtonProjection,
    consistent: Consistent,
    throw: bool,
) -> tuple[Y, StartInfo]:
    """The state to start from. With `throw` the error that names the cause is attached to it."""
    if consistent == "assume":
        dtype = jnp.result_type(*jtu.tree_leaves(y0))
        return y0, StartInfo(jnp.zeros((), dtype), jnp.asarray(True))
    start, info = consistent_state(constraint, t0, y0, args, projection=projection, throw=False)
    success, correction = info.success, info.correction
    if consistent == "check":
        violation = constraint_violation(constraint, t0, y0, args)
        satisfied = violation <= projection.tolerance_for(violation.dtype)
        success = satisfied & info.full_rank & is_finite(y0)
        start, correction = y0, jnp.zeros_like(correction)
    if throw:
        diagnosis = Diagnosis.of_start(constraint, t0, y0, args, info)
        if consistent == "check":
            cause = jnp.where(info.success, NOT_THERE, diagnosis.cause)
            diagnosis = diagnosis._replace(cause=cause)
        start = diagnosis.raise_unless(success, start, "y0")
    return start, StartInfo(correction, success)
