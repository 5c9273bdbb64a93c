"""How conditions depend on rounding, and how fast they change: what their values do not tell near zero."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from .._base.types import FloatScalar, Y
from .samples import SearchedStep


_PERTURBATIONS = 4


def _most(dtype: Any) -> float:
    """Return up to how many units of its rounding a change of a condition is taken from its rate of change:
    where the error of that, of third order, is about as large as rounding."""
    return float(jnp.finfo(dtype).eps) ** -0.2


def _soon(dtype: Any) -> float:
    """Return after which part of a long step rates of change are compared with those at its start, such that
    rounding spoils the difference as little as curvature does."""
    return float(jnp.finfo(dtype).eps) ** 0.375


class Sensitivity(NamedTuple):
    """How much rounding may change the conditions at the end of a step, and their rates of change at its
    start, 0 if that may be rounding, soon after the start, and at the end."""

    noise: Float[Array, " resets"]
    rate: Float[Array, " resets"]
    soon: Float[Array, " resets"]
    at_end: Float[Array, " resets"]

    @staticmethod
    def of(
        values: Callable[[FloatScalar, Y], Float[Array, " resets"]],
        is_boolean: Bool[Array, " resets"],
        step: SearchedStep,
    ) -> "Sensitivity":
        start, end = (step.t0, step.y0), (step.t1, step.y1)
        moving = lambda t, y: (jnp.ones_like(t), step.field(t, y))
        motion, soon_after = moving(*start), _soon(step.t0.dtype)
        ahead = lambda x, dx: x + (soon_after * step.length * dx).astype(x.dtype)
        soon = jtu.tree_map(ahead, start, motion)
        later = jax.vmap(moving)(*jtu.tree_map(lambda *x: jnp.stack(x), soon, end))
        motions = jtu.tree_map(lambda x, xs: jnp.concatenate([x[None], xs]), motion, later)
        tiny = jtu.tree_map(lambda x: 16 * jnp.finfo(x.dtype).eps * x, end)
        parts = _with_signs(tiny), _with_signs(jtu.tree_map(_uncertainty, motion)), motions
        along = jtu.tree_map(lambda *x: jnp.concatenate(x), *parts)
        n = _PERTURBATIONS
        join = lambda start, soon, end: jnp.stack([end] * n + [start] * (n + 1) + [soon, end])
        at = jtu.tree_map(join, start, soon, end)
        changes = jax.vmap(lambda at, along: jax.jvp(values, at, along)[1])(at, along)
        largest = lambda x: jnp.max(jnp.abs(x), axis=0)
        rate, *others = changes[2 * n :]
        rate = jnp.where(jnp.abs(rate) <= largest(changes[n : 2 * n]), 0, rate)
        return Sensitivity(jnp.where(is_boolean, 0, largest(changes[:n])), rate, *others)

    def hop(
        self, length: FloatScalar, largest: Float[Array, " resets"]
    ) -> tuple[Float[Array, " resets"], Bool[Array, " resets"]]:
        """Return for conditions that are zero at the start of a step after what time they are zero again,
        infinity if they go on in their direction; and which of them change by little more than rounding
        until then, as between the last bounces of a ball. The values of these do not say when that is.

        `largest` are the largest absolute values in the step. While they are small, the rate of change is
        as good as linear in time.
        """
        most = _most(length.dtype)
        is_step_short = largest <= most * self.noise
        later = jnp.where(is_step_short, self.at_end, self.soon)
        time = jnp.where(is_step_short, length, _soon(length.dtype) * length)
        slows = self.rate * (later - self.rate) < 0
        time = 2 * self.rate * time / jnp.where(slows, self.rate - later, 1)
        hop = jnp.where(slows, time, jnp.inf)
        return hop, jnp.abs(self.rate) * hop <= most * self.noise


def _uncertainty(velocity: Array) -> Array:
    """Return how large velocities are that may be rounding, also of others that a jump has taken away."""
    size = jnp.abs(velocity)
    return 1e-10 * size + 64 * jnp.finfo(velocity.dtype).eps * jnp.max(size, initial=0)


def _with_signs(tree: Any) -> Any:
    """Return several copies of a tree, whose numbers have random signs."""
    random = np.random.default_rng(0)

    def signed(x: Array) -> Array:
        signs = random.choice([-1.0, 1.0], (_PERTURBATIONS, *x.shape))
        return x[None] * jnp.asarray(signs, x.dtype)

    return jtu.tree_map(signed, tree)
