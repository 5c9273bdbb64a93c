"""The values of conditions at samples of the dense output of a step."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar, Y
from .._jaxpr.small_products import with_sums


# Beyond its end a step is searched for this part of its length: the event at which it was meant to end
# may come a little later.
BEYOND = 0.01


class SearchedStep(NamedTuple):
    """An attempted step in the time of Diffrax, its dense output at a fraction of the step, and the vector
    field."""

    t0: FloatScalar
    t1: FloatScalar
    y0: Y
    y1: Y
    path: Callable[[FloatScalar], Y]
    field: Callable[[FloatScalar, Y], Y]

    @property
    def length(self) -> FloatScalar:
        return self.t1 - self.t0

    @property
    def is_negative(self) -> BoolScalar:
        return self.t1 < self.t0


class SampledConditions(NamedTuple):
    """The values of the conditions at fractions of a step: at the ends of equal parts, and a little beyond
    the end."""

    fractions: np.ndarray
    values: Float[Array, "samples resets"]

    @property
    def inside(self) -> Float[Array, "parts resets"]:
        return self.values[1:-1]

    @property
    def before_end(self) -> Float[Array, " resets"]:
        return self.values[-3]

    @property
    def end(self) -> Float[Array, " resets"]:
        return self.values[-2]

    @property
    def beyond(self) -> Float[Array, " resets"]:
        return self.values[-1]

    @staticmethod
    def of(
        conditions: Callable[[FloatScalar, Y], Float[Array, " resets"]],
        parts: int,
        step: SearchedStep,
    ) -> "SampledConditions":
        inside = np.arange(parts + 1) / parts
        fractions = np.append(inside, 1 + BEYOND)
        where = fractions.astype(step.t0.dtype)
        states = [with_sums(jax.vmap(step.path), part) for part in _split(where, step.y0)]
        states = jtu.tree_map(lambda *parts: jnp.concatenate(parts), *states)
        n = parts
        join = lambda ys, y0, y1: jnp.concatenate([y0[None], ys[1:n], y1[None], ys[n + 1 :]])
        states = jtu.tree_map(join, states, step.y0, step.y1)
        times = step.t0 + step.length * where
        values = jax.vmap(conditions)(times, states)
        # One that touches zero only just has no other sign near by.
        size = jnp.max(jnp.abs(values[1:n]), axis=0) if n > 1 else jnp.abs(values[0])
        nothing = 4 * jnp.finfo(values.dtype).eps * size
        end = jnp.where(jnp.abs(values[n]) <= nothing, 0, values[n])
        return SampledConditions(
            fractions, jnp.concatenate([values[:n], end[None], values[n + 1 :]])
        )


def _split(fractions: np.ndarray, y: Y) -> list[np.ndarray]:
    """Split the samples where the arrays of each part then have at most 512 bytes: XLA for CPUs runs the
    operations of a loop on such arrays one after the other instead of handing them to threads."""
    size = sum(leaf.size for leaf in jtu.tree_leaves(y))
    return np.array_split(fractions, 2) if size <= 9 else [fractions]
