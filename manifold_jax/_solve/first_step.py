"""The first step size of an adaptive solve."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.known_value import known_value
from .._base.types import BoolScalar, FloatScalar, Y
from .setup import ProblemData


class FirstStep(NamedTuple):
    """The step size, signed like `t1 - t0`, and the vector field at the start, as of `terms.vf`."""

    size: FloatScalar
    field: Any


def first_step(
    terms: Any, solver: dfx.AbstractSolver, data: ProblemData, controller: dfx.PIDController
) -> FirstStep:
    """Choose the first step size of an adaptive solve of an ODE.

    Diffrax has such an estimate but never uses it, and starts with 0.01 whatever the problem. Two
    evaluations of the vector field give its size `d1` and its rate of change `r = d2 / d1`, in the
    controller's norm; the step solves `d1 h (r h)^p = 1/100`, so that it does not depend on the unit of
    time.

    Source: after Hairer, Norsett & Wanner, Solving ODEs I, section II.4 (starting step size), whose
    last formula depends on that unit.
    """
    t0, t1, y0, args = data
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    order = solver.error_order(terms)
    direction = jnp.where(t1 < t0, -1.0, 1.0).astype(t0.dtype)
    start = jax.lax.stop_gradient(y0)
    scale = jtu.tree_map(lambda y: controller.atol + controller.rtol * jnp.abs(y), start)

    def norm(v: Y) -> FloatScalar:
        return jnp.asarray(controller.norm(jtu.tree_map(lambda a, s: a / s, v, scale)), t0.dtype)

    span = jnp.abs(t1 - t0)
    span = jnp.where(jnp.isfinite(span), span, 1.0)  # infinite if solved until an event
    d0 = norm(start)

    def trial(velocity: Y) -> tuple[BoolScalar, FloatScalar, FloatScalar]:
        """Return whether the velocity is too small for an estimate, else its size, and a trial step."""
        d1 = norm(velocity)
        small = (d0 < 1e-5) | (d1 < 1e-5)
        d1 = jnp.where(small, 1.0, d1)
        return small, d1, jnp.where(small, 1e-6 * span, 0.01 * d0 / d1)

    def evaluate(at: tuple[Array, Y], _: None) -> tuple[tuple[Array, Y], tuple[Any, Y]]:
        t, y = at
        field = jax.lax.stop_gradient(terms.vf(t, y, args))
        velocity = terms.prod(field, jnp.ones((), t0.dtype))
        step = direction * trial(velocity)[2]
        y = jtu.tree_map(lambda y, f: y + (step * f).astype(y.dtype), start, velocity)
        return (t0 + step, y), (field, velocity)

    # In a loop, so that the program contains one vector field instead of two.
    _, (fields, velocities) = jax.lax.scan(evaluate, (t0, start), None, length=2)
    v0, v1 = (jtu.tree_map(lambda v, i=i: v[i], velocities) for i in (0, 1))
    small, d1, h0 = trial(v0)
    rate = norm(jtu.tree_map(jnp.subtract, v1, v0)) / h0 / d1
    power = 1 / (order + 1)  # pyright: ignore[reportOptionalOperand]
    h1 = (0.01 / d1) ** power * rate ** (-order * power)  # pyright: ignore[reportOptionalOperand]
    h = jnp.where(small, h0, jnp.minimum(100 * h0, h1))
    # A vector field that is not finite near the start gives no estimate.
    h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-3 * span)
    h = jax.lax.stop_gradient(direction * jnp.minimum(h, span))
    first = jtu.tree_map(lambda f: f[0], fields)
    return FirstStep(h, known_value(lambda t, y: terms.vf(t, y, args), first, t0, y0))
