"""Simplified Newton iterations for the stages, and when they end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .stages import SimplifiedNewton, StageEquations, Stages


# The error of stages that count as solved, in units of the tolerance.
_KAPPA = 1e-2


def size_in_tolerances(tolerances: Any, change: Y, y0: Y, y1: Y) -> FloatScalar:
    """Return the size of a change in units of the tolerance, that of the larger of the states at the beginning
    and at the end, as for the error of the step: a component may begin at zero. Where nothing changes the size
    is zero, also without any tolerance."""

    def scaled(dx: Array, x0: Array, x1: Array) -> Array:
        largest = jnp.maximum(jnp.abs(x0), jnp.abs(x1))
        tolerance = tolerances.atol + tolerances.rtol * largest
        return jnp.where(dx == 0, 0, dx / jnp.where(dx == 0, 1, tolerance))

    with jax.numpy_dtype_promotion("standard"):
        return jnp.asarray(tolerances.norm(jtu.tree_map(scaled, change, y0, y1)))


class StageIterate(NamedTuple):
    """`size` and `previous` are those of the last two changes, in units of the tolerance."""

    Z: Stages
    size: FloatScalar
    previous: FloatScalar
    iterations: IntScalar
    status: IntScalar


_GOES_ON, _SOLVED, _FAILED = 0, 1, 2


def solve_stages(
    equations: StageEquations,
    newton: SimplifiedNewton,
    guess: Stages,
    size: Callable[[Stages, Stages], FloatScalar],
    rounding: FloatScalar,
    most: int,
) -> tuple[Stages, BoolScalar]:
    r"""Iterate to round-off, without derivatives: until the error, estimated from the rate $\theta$ of
    convergence as $|\Delta Z| \theta / (1 - \theta)$, has at most the size `rounding`, or changes below
    `_KAPPA` no longer shrink. `size` is that of a change that led to these stages.

    Where iterations end before, stages are solved if their error is below `_KAPPA`.
    """

    def advance(i: StageIterate) -> StageIterate:
        change = newton.step(equations.residual(i.Z))
        Z = i.Z + change
        new = size(change, Z)
        status = _status(new, i, rounding, most)
        return StageIterate(Z, new, i.size, i.iterations + 1, status)

    zero = jnp.zeros((), rounding.dtype)
    first = StageIterate(guess, zero, zero, jnp.asarray(0), jnp.asarray(_GOES_ON))
    end = jax.lax.while_loop(lambda i: i.status == _GOES_ON, advance, first)
    return end.Z, end.status == _SOLVED


def _status(new: FloatScalar, i: StageIterate, rounding: FloatScalar, most: int) -> IntScalar:
    """Return the status after a change of the size `new`.

    Source: Hairer & Wanner, Solving ODEs II, IV.8 (8.10, 8.11).
    """
    twice = i.iterations >= 1
    rate = jnp.where(twice, new / jnp.where(twice, i.size, 1), jnp.inf)
    near = new < _KAPPA
    error = jnp.where(rate < 1, new * rate / (1 - rate), jnp.inf)
    finished = (jnp.minimum(new, error) <= rounding) | twice & near & (rate > 0.3)
    last = i.iterations + 1 >= most
    accurate = near | (error < _KAPPA)
    failed = ~jnp.isfinite(new) | twice & (rate > 2) & ~near | last & ~accurate
    done = jnp.where(finished | last, _SOLVED, _GOES_ON)
    return jnp.where(failed & ~finished, _FAILED, done)
