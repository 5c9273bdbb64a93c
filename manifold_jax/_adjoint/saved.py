"""The reverse sweep through saved values: to the states, steps and times that they depend on."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._base.types import FloatScalar, IntScalar, RealScalarLike, Y
from .gradient import add, Ends, Gradient, RecordedStep, replaced
from .replay import Replay


class Functions(eqx.Module):
    """A [`Replay`][] in two parts, with and without derivatives."""

    leaves: Any
    rest: Any

    @property
    def replay(self) -> Replay:
        return self.at(self.leaves)

    def at(self, leaves: Any) -> Replay:
        return eqx.combine(leaves, self.rest)

    def vjp(self, function: Callable, x: Any, times: Any, timed: bool) -> tuple[Any, Callable]:
        """Return the real numbers of `function(replay, x, times)`, and their pullback to the leaves, to
        `x` and, if `timed`, to `times`."""

        def value(leaves: Any, x: Any, moved: Any) -> Any:
            out = function(self.at(leaves), x, times if moved is None else moved)
            return eqx.filter(out, eqx.is_inexact_array)

        return jax.vjp(value, self.leaves, x, times if timed else None)


class Rows(NamedTuple):
    """The rows of one saving: times, how many precede that of the end, cotangents of times and values."""

    times: Float[Array, " rows"]
    count: IntScalar
    times_bar: Float[Array, " rows"]
    values_bar: Any  # leading axis: rows


class SavedValues(eqx.Module):
    """The rows of all savings."""

    functions: Functions
    ends: Ends
    rows: list[Rows]

    @property
    def _savings(self) -> Any:
        return self.functions.rest.savings

    def through_end(self, gradient: Gradient) -> Gradient:
        for k, saving in enumerate(self._savings):
            if saving.end:
                unsaved = saving.steps == 0 or self.ends.num_accepted % saving.steps != 0
                # Without any step (`t0 == t1`) it comes after the copies of the start for `ts`.
                copies = jnp.where(self.ends.num_steps == 0, saving.num_times, 0)
                row = jnp.arange(len(self.rows[k].times))
                used = (row == self.rows[k].count + copies) & unsaved
                gradient = self._through_copies(gradient, k, used, self.ends.last, self.ends.y)
        return gradient

    def through_start(self, gradient: Gradient, first: Y) -> Gradient:
        """Transpose the row of `t0`; without any step (`t0 == t1`) the rows of `ts` are copies of it."""
        for k, saving in enumerate(self._savings):
            if saving.offset or saving.num_times:
                copies = jnp.where(self.ends.num_steps == 0, saving.num_times, 0)
                used = jnp.arange(len(self.rows[k].times)) < saving.offset + copies
                gradient = self._through_copies(gradient, k, used, self.ends.t0, first)
        return gradient

    def _through_copies(
        self, gradient: Gradient, k: int, used: Bool[Array, " rows"], t: RealScalarLike, y: Y
    ) -> Gradient:
        """Transpose the rows of saving `k` that are the same function of one state."""
        rows = self.rows[k]
        bar = jtu.tree_map(lambda b: jnp.sum(_only(used, b), axis=0), rows.values_bar)
        return self._through_value(gradient, k, t, y, bar, jnp.sum(_only(used, rows.times_bar)))

    def _through_value(
        self, gradient: Gradient, k: int, t: Any, y: Y, bar: Any, t_bar: FloatScalar
    ) -> Gradient:
        """Transpose the value that saving `k` saves of a state."""
        saved, times = lambda replay, y, t: replay.savings[k].at_state(t, y), gradient.times
        _, pullback = self.functions.vjp(saved, y, t, gradient.is_timed)
        leaves_bar, y_bar, more = pullback(bar)
        start = gradient.start
        if times is not None:
            times = times.at_saved_state(self.ends, t, t_bar + more)
        if start is not None:  # the time may be that of an event
            start += t_bar + more
        state = gradient.state._replace(y=add(gradient.state.y, y_bar))
        leaves = add(gradient.leaves, leaves_bar)
        return gradient._replace(state=state, leaves=leaves, times=times, start=start)

    def after_step(self, gradient: Gradient, k: int, step: RecordedStep, y: Y) -> Gradient:
        """Transpose the row of the state after a step, if it was saved."""
        saving, rows, row = self._savings[k], self.rows[k], gradient.rows[k]
        if not saving.steps:
            return gradient
        saved = (gradient.number % saving.steps == 0) & (row >= saving.offset)
        # The time that was saved is the one after a jump at which the step ended.
        t = jnp.where(saved, rows.times[row], step.end)
        bar = jtu.tree_map(lambda b: jnp.where(saved, b[row], 0), rows.values_bar)
        t_bar = jnp.where(saved, rows.times_bar[row], 0)
        gradient = self._through_value(gradient, k, t, y, bar, t_bar)
        return gradient._replace(rows=replaced(gradient.rows, k, row - jnp.where(saved, 1, 0)))

    def inside_step(
        self, gradient: Gradient, k: int, step: RecordedStep, dense_info: Any, bar: Any
    ) -> tuple[Gradient, Any, FloatScalar]:
        """Transpose the rows interpolated in a step; return the cotangents of `dense_info` and of the
        start of the step, too."""
        saving, rows = self._savings[k], self.rows[k]
        zero = jnp.zeros_like(self.ends.t0)
        if not saving.num_times:
            return gradient, bar, zero
        first = gradient.number == 1

        def is_inside(carry):
            gradient, *_ = carry
            row = gradient.rows[k]
            t = rows.times[row]
            # A time at the start of a step is saved at the end of the one before, unless a jump is
            # between; none is saved in a step of negative length.
            inside = first | (t > step.start) | ((t == step.start) & step.begins_anew)
            inside &= step.end >= step.start
            return step.accepted & (row >= saving.offset) & inside

        def through_row(carry):
            gradient, dense_bar, start_bar = carry
            row = gradient.rows[k]

            saved = lambda replay, info, times: replay.savings[k].in_step(*times, info)
            times, of_times = gradient.times, (rows.times[row], step.start, step.end)
            bar = jtu.tree_map(lambda b: b[row], rows.values_bar)
            _, pullback = self.functions.vjp(saved, dense_info, of_times, gradient.is_timed)
            leaves_bar, more, times_bar = pullback(bar)
            if gradient.is_timed:
                start_bar += times_bar[1]
            if times is not None:
                t_bar, *ends_bar = times_bar
                of_steps = (gradient.number - 1) // saving.steps if saving.steps else 0
                i = row - saving.offset - of_steps
                times = times.at_saved_time(k, i, t_bar + rows.times_bar[row])
                times = times.at_ends_of_step(self.ends, step, *ends_bar)
            following = replaced(gradient.rows, k, row - 1)
            leaves = add(gradient.leaves, leaves_bar)
            gradient = gradient._replace(rows=following, leaves=leaves, times=times)
            return gradient, add(dense_bar, more), start_bar

        return lax.while_loop(is_inside, through_row, (gradient, bar, zero))


def _only(used: Bool[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    """Return the rows that are used, and zeros for the others, whatever they hold."""
    return jnp.where(used.reshape(used.shape + (1,) * (x.ndim - 1)), x, 0)
