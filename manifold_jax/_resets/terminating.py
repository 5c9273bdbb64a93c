"""Events that end a solve with resets: those before a reset are seen, whatever the jump does."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.types import Args, BoolScalar
from .samples import SearchedStep


class TerminatingEvents(eqx.Module):
    """The events that end a solve.

    Diffrax compares their signs at the ends of steps, where a reset has made its jump already. An event that
    happened in the step and that the jump has undone would be missed.
    """

    event: dfx.Event  # whose functions need the time of Diffrax, a state and `args` alone
    args: Args

    def happen_in(self, step: SearchedStep) -> BoolScalar:
        """Whether one of them happens in a step, before its end."""
        # One at the same time as the reset is compared with the state after it.
        fraction = 1 - jnp.sqrt(jnp.finfo(step.t0.dtype).eps)
        before_end = step.t0 + fraction * step.length, step.path(fraction)
        each = zip(
            jtu.tree_leaves(self.event.cond_fn, is_leaf=callable),
            jtu.tree_leaves(self.event.direction, is_leaf=lambda x: x is None),
            strict=True,
        )
        happened = jnp.asarray(False)
        for condition, direction in each:
            value = lambda t, y, of=condition: jnp.asarray(of(t, y, self.args))
            start = value(step.t0, step.y0)
            ends = value(*before_end), value(step.t1, step.y1)
            inside, at_end = (has_happened(start, end, direction) for end in ends)
            happened |= inside & at_end
        # A step of negative length only says what is at its start.
        return happened & ~step.is_negative


def has_happened(before: Array, after: Array, direction: bool | None) -> BoolScalar:
    """Whether an event happens between two values of its function, as Diffrax defines it."""
    if after.dtype == bool:
        return after
    before, after = jnp.sign(before), jnp.sign(after)
    if direction is None:
        return before != after
    return (before <= 0) & (after > 0) if direction else (before > 0) & (after <= 0)
