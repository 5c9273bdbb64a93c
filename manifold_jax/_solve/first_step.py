"""A sensible first step of an adaptive solve."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._custom_types import Args, FloatScalar, RealScalarLike, Y


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
