"""Projection of a single point: any point, and initial values."""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.rejection import is_finite
from .._base.types import Args, RealScalarLike, Y
from .checks import check_constraint, check_constraint_type, check_state
from .constraint import AbstractConstraint
from .diagnosis import Diagnosis
from .projection_info import ProjectionInfo
from .settings import NewtonProjection


State = TypeVar("State")  # the result has the same structure as the argument


@clear_errors
@numbers_as_arrays("y", "args", times=("t",))
@eqx.filter_jit
def project(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: State,
    args: Args = None,
    *,
    projection: NewtonProjection | None = None,
    throw: bool = True,
) -> tuple[State, ProjectionInfo]:
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

    `TypeError` or `ValueError` for states or residuals of the wrong type or shape. With `throw=True` a
    `RuntimeError` (under `jit` too, and for a batch if one of its points fails) that says whether the
    constraint was not finite, its Jacobian rank deficient, or the equations could not be satisfied.

    [`consistent_state`][] is the same for initial values.
    """
    check_constraint_type(constraint, "project(constraint, t, y, args)")
    projection = NewtonProjection(max_steps=50) if projection is None else projection
    return moved(projection, constraint, t, y, args, "y", throw)


@clear_errors
@numbers_as_arrays("y", "args", times=("t",))
@eqx.filter_jit
def consistent_state(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: State,
    args: Args = None,
    *,
    projection: NewtonProjection | None = None,
    throw: bool = True,
) -> tuple[State, ProjectionInfo]:
    """Make an initial value consistent: move it onto the manifold, or say why that failed.

    **Arguments:**

    - `constraint`, `t`, `y`, `args`: as for [`project`][].
    - `projection`: metric and tolerance; its `max_steps` is raised to 50, as a start may be
        far from the manifold.
    - `throw`: raise if the state cannot be made consistent. With `throw=False` look at
        `info.success`; there is then no host callback in the compiled function.

    **Returns:**

    `(y, info)` with `info.correction`, the largest `|change| / (|y| + 1)`. A consistent
    state is returned unchanged.

    **Raises:**

    A `RuntimeError` (under `jit` too) that says whether the state or the constraint was not finite, its
    Jacobian rank deficient, or the equations could not be satisfied.
    """
    check_constraint_type(constraint, "consistent_state(constraint, t, y, args)")
    projection = NewtonProjection() if projection is None else projection
    patient = dataclasses.replace(projection, max_steps=max(50, projection.max_steps))
    return moved(patient, constraint, t, y, args, "y0", throw)


def moved(
    projection: NewtonProjection,
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args,
    name: str,
    throw: bool,
) -> tuple[Y, ProjectionInfo]:
    """Move one point that may be far from the manifold; `name` is its name in messages."""
    check_state(y, name)
    y = jtu.tree_map(jnp.asarray, y)
    check_constraint(constraint, t, y, args)
    p, info = constraint.correct(projection, t, y, args, far=True)
    # NaN in components that the constraint does not depend on is a failure, too.
    info = dataclasses.replace(info, success=info.success & is_finite(y))
    if throw:
        diagnosis = Diagnosis.of_start(constraint, t, y, args, info)
        p = diagnosis.raise_unless(info.success, p, name)
    return p, info
