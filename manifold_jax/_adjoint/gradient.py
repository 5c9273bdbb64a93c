"""A gradient in the reverse sweep of a solve, and what it passes."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._base.types import FloatScalar, IntScalar, Y
from .record import Vectors
from .replay import State


class Ends(NamedTuple):
    """Where a solve began and ended, its numbers of steps, and the state at its end."""

    t0: FloatScalar
    t1: FloatScalar  # where it was to end
    last: FloatScalar
    num_steps: IntScalar
    num_accepted: IntScalar
    y: Y


class Step(NamedTuple):
    """One recorded step, or several along leading axes."""

    start: Float[Array, "*steps"]
    end: Float[Array, "*steps"]
    jumped: Bool[Array, "*steps"] | bool
    accepted: Bool[Array, "*steps"]
    state: Vectors  # from which it was made


class TimesBar(NamedTuple):
    """Cotangents with respect to the ends of the solve and to the times of `SaveAt(ts=...)`. The
    ends of all
    other steps are what they are."""

    t0: FloatScalar
    t1: FloatScalar
    ts: list[Float[Array, " times"] | None]


class Gradient(NamedTuple):
    """Cotangents with respect to the state behind accepted step `number`, to the leaves of the
    functions and
    to times so far; `rows` are the last rows of each saving still to come."""

    number: IntScalar
    rows: list[IntScalar]
    state: State
    leaves: Any
    times: TimesBar | None  # if they have derivatives

    def at_ends_of_step(self, ends: Ends, step: Step, times_bar: Any) -> "Gradient":
        if times_bar is None:
            return self
        start_bar, end_bar = times_bar
        bars = self.times
        assert bars is not None
        t0 = bars.t0 + jnp.where(step.start == ends.t0, start_bar, 0)
        t1 = bars.t1 + jnp.where(step.end == ends.t1, end_bar, 0)
        return self._replace(times=bars._replace(t0=t0, t1=t1))

    def at_end_of_solve(self, ends: Ends, t: Any, bar: FloatScalar) -> "Gradient":
        """A value saved at `t`, if that is one of the ends."""
        bars = self.times
        assert bars is not None
        at_start = t == ends.t0
        t0 = bars.t0 + jnp.where(at_start, bar, 0)
        t1 = bars.t1 + jnp.where((t == ends.t1) & ~at_start, bar, 0)
        return self._replace(times=bars._replace(t0=t0, t1=t1))

    def at_saved_time(self, k: int, i: IntScalar, bar: FloatScalar) -> "Gradient":
        bars = self.times
        assert bars is not None
        of_saving = bars.ts[k]
        assert of_saving is not None
        ts = replaced(bars.ts, k, of_saving.at[i].add(bar))
        return self._replace(times=bars._replace(ts=ts))


def add(a: Any, b: Any) -> Any:
    return jtu.tree_map(jnp.add, a, b)


def replaced(items: list, k: int, item: Any) -> list:
    return [*items[:k], item, *items[k + 1 :]]
