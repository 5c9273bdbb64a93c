"""Where to start: a consistent initial value and a sensible first step."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._constraint import AbstractConstraint
from ._custom_types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from ._diagnosis import failure_cause, NOT_THERE
from ._errors import clear_errors
from ._projection import moved, NewtonProjection
from ._projection_info import ProjectionInfo
from ._violation import constraint_violation


@clear_errors
@eqx.filter_jit
def consistent_state(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args = None,
    *,
    projection: NewtonProjection | None = None,
    throw: bool = True,
) -> tuple[Y, ProjectionInfo]:
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

    A `RuntimeError` (under `jit` too) that says whether the constraint was not finite, its
    Jacobian rank deficient, or the equations could not be satisfied.
    """
    projection = NewtonProjection() if projection is None else projection
    patient = dataclasses.replace(projection, max_steps=max(50, projection.max_steps))
    return moved(patient, constraint, t, y, args, "y0", throw)


class StartInfo(eqx.Module):
    """How an initial value was treated: the change made, whether the value can be used, and if not,
    the cause, a number of `_diagnosis.py`."""

    correction: FloatScalar
    success: BoolScalar
    cause: IntScalar


def start_state(
    constraint: AbstractConstraint,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    projection: NewtonProjection,
    consistent: str,
) -> tuple[Y, StartInfo]:
    """The state to start from, for `consistent` one of "project", "check" and "assume"."""
    if consistent == "assume":
        dtype = jnp.result_type(*jtu.tree_leaves(y0))
        return y0, StartInfo(jnp.zeros((), dtype), jnp.asarray(True), jnp.asarray(0))
    start, info = consistent_state(constraint, t0, y0, args, projection=projection, throw=False)
    cause = failure_cause(constraint, t0, y0, args, info.residual, info.full_rank)
    if consistent == "project":
        return start, StartInfo(info.correction, info.success, cause)
    violation = constraint_violation(constraint, t0, y0, args)
    tolerance = projection.tolerance_for(violation.dtype)
    satisfied = violation <= tolerance
    cause = jnp.where(info.success, NOT_THERE, cause)
    return y0, StartInfo(jnp.zeros_like(info.correction), satisfied & info.full_rank, cause)


def initial_step(
    terms: Any,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    controller: dfx.PIDController,
) -> FloatScalar:
    """First step of an adaptive solve of an ODE, signed like `t1 - t0`.

    Diffrax has such an estimate but never reaches it and starts with 0.01 whatever the
    problem. Two evaluations of the vector field give its size `d1` and its rate of change
    `r = d2 / d1`, in the controller's norm; the step solves `d1 h (r h)^p = 1/100`, so that
    it does not depend on the unit of time.

    Source: after Hairer, Norsett & Wanner, Solving ODEs I, section II.4 (starting step
    size), whose last formula depends on that unit.
    """
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    order = solver.error_order(terms)
    direction = jnp.where(t1 < t0, -1.0, 1.0).astype(t0.dtype)
    scale = jtu.tree_map(lambda y: controller.atol + controller.rtol * jnp.abs(y), y0)

    def norm(v: Y) -> FloatScalar:
        return jnp.asarray(controller.norm(jtu.tree_map(lambda a, s: a / s, v, scale)), t0.dtype)

    unit = jnp.ones((), t0.dtype)
    vector_field = lambda t, y: terms.vf_prod(t, y, args, unit)
    f0 = vector_field(t0, y0)
    d0, d1 = norm(y0), norm(f0)
    small = (d0 < 1e-5) | (d1 < 1e-5)
    span = jnp.abs(t1 - t0)
    span = jnp.where(jnp.isfinite(span), span, 1.0)  # solved until an event
    h0 = jnp.where(small, 1e-6 * span, 0.01 * d0 / jnp.where(small, 1.0, d1))
    step = direction * h0
    y1 = jtu.tree_map(lambda y, f: y + (step * f).astype(y.dtype), y0, f0)
    f1 = vector_field(t0 + step, y1)
    rate = norm(jtu.tree_map(jnp.subtract, f1, f0)) / h0 / jnp.where(small, 1.0, d1)
    power = 1 / (order + 1)
    h1 = (0.01 / jnp.where(small, 1.0, d1)) ** power * rate ** (-order * power)
    h = jnp.where(small, h0, jnp.minimum(100 * h0, h1))
    # A vector field that is not finite near the start says nothing about the step.
    h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-3 * span)
    h = jnp.minimum(h, span)
    return jax.lax.stop_gradient(direction * h)


def controller_tolerances(controller: Any) -> dfx.PIDController | None:
    """The controller that holds `rtol`, `atol` and `norm`, inside any wrappers around it."""
    while hasattr(controller, "controller"):
        controller = controller.controller
    return controller if isinstance(controller, dfx.PIDController) else None
