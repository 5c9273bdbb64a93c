"""The quantities that the reverse sweep of a solve carries."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from .._base.types import FloatScalar, IntScalar, Y
from .prescribed import which_prescribed
from .record import Vectors
from .replay import State


class Ends(NamedTuple):
    """The ends of a solve, its numbers of steps, and the state at its end."""

    t0: FloatScalar
    t1: FloatScalar  # where it was supposed to end
    last: FloatScalar
    num_steps: IntScalar
    num_accepted: IntScalar
    y: Y
    # Times of the step size controller; None unless they have derivatives.
    prescribed: Float[Array, " prescribed"] | None


class RecordedStep(NamedTuple):
    """One recorded step, or several along leading axes."""

    start: Float[Array, "*steps"]
    end: Float[Array, "*steps"]
    jumped: Bool[Array, "*steps"] | None  # None if no steps begin after jumps
    reset: Int[Array, "*steps"] | None  # which reset is at its end, or -1; None without resets
    begins_at_reset: Bool[Array, "*steps"] | None
    accepted: Bool[Array, "*steps"]
    state: Vectors  # from which the step was made

    @property
    def begins_anew(self) -> Bool[Array, "*steps"] | bool:
        """Whether the state at its start is not the one at the end of the step before."""
        at_reset = False if self.begins_at_reset is None else self.begins_at_reset
        return self.begins_at_jump | at_reset

    @property
    def begins_at_jump(self) -> Bool[Array, "*steps"] | bool:
        return False if self.jumped is None else self.jumped


class TimesBar(NamedTuple):
    """Cotangents of the ends of the solve, of the times of `SaveAt(ts=...)` and of those that the step size
    controller prescribes; other steps are fixed."""

    t0: FloatScalar
    t1: FloatScalar
    ts: list[Float[Array, " times"] | None]
    prescribed: Float[Array, " prescribed"] | None

    def at_ends_of_step(
        self, ends: Ends, step: RecordedStep, start_bar: Any, end_bar: Any
    ) -> "TimesBar":
        at_t0, at_t1 = step.start == ends.t0, step.end == ends.t1
        t0 = self.t0 + jnp.where(at_t0, start_bar, 0)
        times = self._replace(t0=t0, t1=self.t1 + jnp.where(at_t1, end_bar, 0))
        times = times._at_prescribed(ends, step.start, jnp.where(at_t0, 0, start_bar))
        return times._at_prescribed(ends, step.end, jnp.where(at_t1, 0, end_bar))

    def at_saved_state(self, ends: Ends, t: Any, bar: FloatScalar) -> "TimesBar":
        """Add the cotangent of a value saved at `t`, where a step ends or the first one begins."""
        at_t0 = t == ends.t0
        at_t1 = (t == ends.t1) & ~at_t0
        t0 = self.t0 + jnp.where(at_t0, bar, 0)
        times = self._replace(t0=t0, t1=self.t1 + jnp.where(at_t1, bar, 0))
        return times._at_prescribed(ends, t, jnp.where(at_t0 | at_t1, 0, bar))

    def at_dense_times(self, ends: Ends, t: Any, bar: Any) -> "TimesBar":
        """Add the cotangents of the ends of the steps of a dense solution, along a leading axis."""
        at = lambda time: jnp.sum(jnp.where(t == time, bar, 0))
        times = self._replace(t0=self.t0 + at(ends.t0), t1=self.t1 + at(ends.t1))
        if self.prescribed is None or ends.prescribed is None:
            return times
        others = jnp.where((t == ends.t0) | (t == ends.t1), 0, bar)
        is_one, i = jax.vmap(which_prescribed, in_axes=(None, 0))(ends.prescribed, t)
        return times._replace(prescribed=self.prescribed.at[i].add(jnp.where(is_one, others, 0)))

    def _at_prescribed(self, ends: Ends, t: Any, bar: FloatScalar) -> "TimesBar":
        if self.prescribed is None or ends.prescribed is None:
            return self
        is_one, i = which_prescribed(ends.prescribed, t)
        return self._replace(prescribed=self.prescribed.at[i].add(jnp.where(is_one, bar, 0)))

    def at_saved_time(self, k: int, i: IntScalar, bar: FloatScalar) -> "TimesBar":
        of_saving = self.ts[k]
        assert of_saving is not None
        return self._replace(ts=replaced(self.ts, k, of_saving.at[i].add(bar)))


class Gradient(NamedTuple):
    """Cotangents of the state after accepted step `number`, and so far of the leaves of the functions
    and of times; `rows` are the last rows of each saving that are still to come."""

    number: IntScalar
    rows: list[IntScalar]
    state: State
    leaves: Any
    times: TimesBar | None  # None if they have no derivatives
    # With resets, of the time at which that step ends and the next one begins, which may be that of an
    # event; and the number of resets that are still to come.
    start: FloatScalar | None
    resets: IntScalar | None

    @property
    def is_timed(self) -> bool:
        return self.times is not None or self.start is not None


def add(a: Any, b: Any) -> Any:
    return jtu.tree_map(jnp.add, a, b)


def replaced(items: list, k: int, item: Any) -> list:
    return [*items[:k], item, *items[k + 1 :]]


def with_zeros(values: Any, bars: Any) -> Any:
    """Return the cotangents of `values`, with zeros instead of `None`."""
    return jtu.tree_map(lambda x, bar: jnp.zeros_like(x) if bar is None else bar, values, bars)
