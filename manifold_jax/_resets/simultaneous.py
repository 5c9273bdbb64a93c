"""Times that are the same up to rounding."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.types import FloatScalar
from .samples import SampledConditions, SearchedStep


def rounding_of_times(step: SearchedStep) -> FloatScalar:
    """Return the rounding of the times of a step."""
    return jnp.finfo(step.t1.dtype).eps * jnp.maximum(jnp.abs(step.t0), jnp.abs(step.t1))


def rounding_of_events(
    step: SearchedStep, samples: SampledConditions, noise: Array, is_boolean: Array
) -> Float[Array, " resets"]:
    """Return by how much rounding may move events; `noise` is how much it may change the conditions."""
    rate = jnp.abs(samples.end - samples.before_end) * samples.inside.shape[0]  # per step
    noise = noise / jnp.maximum(rate, 1e3 * noise + jnp.finfo(rate.dtype).tiny)
    noise = jnp.where(is_boolean, 1e-12, noise)
    return 16 * rounding_of_times(step) + jnp.abs(step.length) * noise


def is_same_time(
    step: SearchedStep, roots: Array, known: FloatScalar, tolerance: Array
) -> Bool[Array, " resets"]:
    """Return which roots are the time `known`, infinite for none, up to a `tolerance`. Zeros without slope, whose
    tolerance is large, are not."""
    # Stricter for other steps, so that none ends at the known time in vain, again and again.
    near = jnp.where(step.t1 == end_of_step(known, step.t0), 4, 1) * tolerance
    is_same = (roots >= known - near) & (roots <= known + near) & jnp.isfinite(known)
    most = 1e-9 * jnp.abs(step.length) + 32 * rounding_of_times(step)
    return is_same & (tolerance <= most)


def end_of_step(event: Array, t0: FloatScalar) -> Array:
    """Return where a step from `t0` has to end for an event just after it."""
    return jnp.maximum(_time_before(event), time_after(t0))


def _time_before(t: Array) -> Array:
    return jnp.nextafter(t, jnp.asarray(-jnp.inf, t.dtype))


def time_after(t: FloatScalar) -> FloatScalar:
    return jnp.nextafter(t, jnp.asarray(jnp.inf, t.dtype))
