"""Failed steps: repeated with a smaller step size, or the end of the solve."""

import functools

import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS

from .types import BoolScalar, FloatScalar, RealScalarLike, Y


def is_finite(y: Y) -> BoolScalar:
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jtu.tree_leaves(y)]
    return functools.reduce(jnp.logical_and, finite)


def result_of_state(y: Y) -> RESULTS:
    return RESULTS.where(is_finite(y), RESULTS.successful, RESULTS.nonfinite)  # pyright: ignore[reportArgumentType]


def is_repeatable(t0: RealScalarLike, t1: RealScalarLike, first_step: FloatScalar) -> BoolScalar:
    """Whether a smaller step is possible at all within the precision of the time."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    scale = jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), first_step)
    smallest = 100 * jnp.finfo(t1.dtype).eps * scale
    return jnp.abs(t1 - t0) > smallest


def rejecting(error: Y, success: BoolScalar, repeatable: BoolScalar) -> Y:
    """Return the error estimate of a step that may have failed.

    An infinite error makes an adaptive controller reject the step and try a smaller one. Without an
    error estimate the step is accepted, and its result code ends the solve.
    """
    verdict = jnp.where(repeatable, jnp.inf, 0.0)
    return jtu.tree_map(lambda e: jnp.where(success, e, verdict.astype(e.dtype)), error)
