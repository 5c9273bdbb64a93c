"""The initial value: moved onto the manifold, checked, or trusted."""

from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.rejection import is_finite
from .._base.types import BoolScalar, FloatScalar, Y
from .._constraint.diagnosis import Diagnosis, NOT_THERE
from .._constraint.project import consistent_state
from .._constraint.violation import constraint_violation
from .setup import ProblemData, Setup


class StartInfo(NamedTuple):
    """Report of the treatment of an initial value: the change made, and whether the value can be used."""

    correction: FloatScalar
    success: BoolScalar


def start_state(setup: Setup, data: ProblemData) -> tuple[Y, StartInfo]:
    """Return the state to start from. With `throw` the error that names the cause is attached to it."""
    (t0, _, y0, args), consistent = data, setup.consistent
    constraint, projection = setup.solver.constraint, setup.solver.projection
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
    if setup.throw:
        diagnosis = Diagnosis.of_start(constraint, t0, y0, args, info)
        if consistent == "check":
            cause = jnp.where(info.success, NOT_THERE, diagnosis.cause)
            diagnosis = diagnosis._replace(cause=cause)
        start = diagnosis.raise_unless(success, start, "y0")
    return start, StartInfo(correction, success)
