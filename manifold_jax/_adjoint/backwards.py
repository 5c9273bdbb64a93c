"""The way back: the recorded steps in reverse order, each computed once more and transposed."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._compat import unvmap_max
from .._custom_types import FloatScalar, IntScalar, RealScalarLike, Y
from .record import Record, Vectors
from .replay import Replay, State


class Rows(NamedTuple):
    """What one of the savings has saved: times, how many rows come before that of the end, and
    the cotangents of times and values."""

    times: Float[Array, " rows"]
    count: IntScalar
    times_bar: Float[Array, " rows"]
    values_bar: Any  # leading axis: rows


class Ends(NamedTuple):
    """Where a solve began and ended, its numbers of steps, and the state at its end."""

    t0: FloatScalar
    t1: FloatScalar  # where it was to end
    last: FloatScalar
    num_steps: IntScalar
    num_accepted: IntScalar
    y: Y


class DenseBars(NamedTuple):
    """Cotangents of the interpolation data of all accepted steps, and of that of the last one."""

    all: Any  # leading axis: accepted steps
    last: Any

    def of(self, number: IntScalar, num_accepted: IntScalar, zero: Any) -> Any:
        bar = zero
        if self.all is not None:
            bar = jtu.tree_map(lambda b, x: b + x[number - 1], bar, self.all)
        if self.last is not None:
            is_last = number == num_accepted
            bar = jtu.tree_map(lambda b, x: b + jnp.where(is_last, x, 0), bar, self.last)
        return bar


class TimesBar(NamedTuple):
    """With respect to the ends of the solve and to the times of `SaveAt(ts=...)`. The ends of all
    other steps are what they are."""

    t0: FloatScalar
    t1: FloatScalar
    ts: list[Float[Array, " times"] | None]


class Step(NamedTuple):
    """One recorded step, or several along leading axes."""

    start: Float[Array, "*steps"]
    end: Float[Array, "*steps"]
    jumped: Bool[Array, "*steps"] | bool
    accepted: Bool[Array, "*steps"]
    state: Vectors  # from which it was made


class Gradient(NamedTuple):
    """With respect to the state behind accepted step `number`, to the leaves of the functions and
    to times so far; `rows` are the last rows of each saving still to come."""

    number: IntScalar
    rows: list[IntScalar]
    state: State
    leaves: Any
    times: TimesBar | None  # if they have derivatives


class Backwards(eqx.Module):
    """Transposed steps of a recorded solve."""

    leaves: Any  # of a `Replay`, with respect to which it is differentiated
    rest: Any
    record: Record
    first: State
    ends: Ends
    rows: list[Rows]
    dense: DenseBars

    def _replay(self, leaves: Any) -> Replay:
        return eqx.combine(leaves, self.rest)

    def run(self, last_bar: State, timed: bool) -> Gradient:
        """From the cotangent of the last state."""
        gradient = Gradient(
            self.ends.num_accepted,
            [rows.count - 1 for rows in self.rows],
            last_bar,
            jtu.tree_map(jnp.zeros_like, self.leaves),
            self._no_times() if timed else None,
        )
        gradient = self._through_end(gradient)
        total = unvmap_max(self.ends.num_steps)

        def through_segment(carry):
            i, gradient = carry
            return i - 1, self._through_segment(gradient, i - 1, total)

        sizes = self.record.sizes
        start = -(-total // (sizes.segment * sizes.block)), gradient
        _, gradient = lax.while_loop(lambda carry: carry[0] > 0, through_segment, start)
        return self._through_start(gradient)

    def _no_times(self) -> TimesBar:
        zero = jnp.zeros_like(self.ends.t0)
        savings = self.rest.savings
        of = lambda saving: jnp.zeros(saving.num_times, zero.dtype) if saving.num_times else None
        return TimesBar(zero, zero, [of(saving) for saving in savings])

    # The ends of a solve: rows that are functions of its first and last state alone.

    def _through_end(self, gradient: Gradient) -> Gradient:
        for k, saving in enumerate(self.rest.savings):
            if saving.end:
                unsaved = saving.steps == 0 or self.ends.num_accepted % saving.steps != 0
                row = jnp.arange(len(self.rows[k].times))
                used = (row == self.rows[k].count) & unsaved
                gradient = self._through_copies(gradient, k, used, self.ends.last, self.ends.y)
        return gradient

    def _through_start(self, gradient: Gradient) -> Gradient:
        """The row of `t0`; without any step (`t0 == t1`) those of `ts` are copies of it."""
        for k, saving in enumerate(self.rest.savings):
            if saving.offset or saving.num_times:
                copies = jnp.where(self.ends.num_steps == 0, saving.num_times, 0)
                used = jnp.arange(len(self.rows[k].times)) < saving.offset + copies
                gradient = self._through_copies(gradient, k, used, self.ends.t0, self.first.y)
        return gradient

    def _through_copies(
        self, gradient: Gradient, k: int, used: Bool[Array, " rows"], t: RealScalarLike, y: Y
    ) -> Gradient:
        """The rows of saving `k` that are the same function of one state."""
        rows = self.rows[k]
        bar = jtu.tree_map(lambda b: jnp.sum(_only(used, b), axis=0), rows.values_bar)
        return self._through_value(gradient, k, t, y, bar, jnp.sum(_only(used, rows.times_bar)))

    def _through_value(
        self, gradient: Gradient, k: int, t: Any, y: Y, bar: Any, t_bar: FloatScalar
    ) -> Gradient:
        """What saving `k` saves of a state."""

        def value(leaves: Any, y: Y, time: Any) -> Any:
            saved = self._replay(leaves).savings[k].at_state(t if time is None else time, y)
            return eqx.filter(saved, eqx.is_inexact_array)

        _, pullback = jax.vjp(value, self.leaves, y, None if gradient.times is None else t)
        leaves_bar, y_bar, more = pullback(bar)
        state = gradient.state._replace(y=_add(gradient.state.y, y_bar))
        gradient = gradient._replace(state=state, leaves=_add(gradient.leaves, leaves_bar))
        return gradient if more is None else self._at_end_of_solve(gradient, t, t_bar + more)

    # The steps between.

    def _steps_of_segment(self, i: IntScalar) -> Step:
        """Leading axes: blocks, steps."""
        record, sizes = self.record, self.record.sizes
        part = lambda x, i: lax.dynamic_slice_in_dim(x, i * sizes.segment, sizes.segment)
        times = part(record.times, i)
        accepted = times[..., 1] > -jnp.inf
        # Rows of no accepted step hold one of no length from the first state: functions may refuse
        # what is not a state or time.
        start, end = (jnp.where(accepted, times[..., i], self.ends.t0) for i in range(2))
        jumped = accepted & (times[..., 2] > 0) if record.jumps else False
        times = start, end, jumped, accepted
        last = max(sizes.kept // sizes.segment - 1, 0)
        kept = lambda: {k: part(x, jnp.minimum(i, last)) for k, x in record.states.items()}
        again = lambda: self._states_again(i, Step(*times, {}))
        if not record.firsts:
            states = kept()
        elif not record.states:
            states = again()
        else:
            states = lax.cond(i <= last, kept, again)
        first = record.packing.pack(self.first)
        used = lambda x, first: jnp.where(accepted[..., None], x, first)
        return Step(*times, {k: used(x, first[k]) for k, x in states.items()})

    def _states_again(self, i: IntScalar, steps: Step) -> Vectors:
        """The states of a segment, computed from its first one."""
        record, packing = self.record, self.record.packing
        arrays, static = eqx.partition(steps, eqx.is_array)

        def advance(x, step):
            step = eqx.combine(step, static)
            state = packing.unpack(x)
            new, _ = self._replay(self.leaves).step(step.start, step.end, step.jumped, state)
            new = packing.pack(new)
            return {k: jnp.where(step.accepted, new[k], x[k]) for k in x}, x

        begun = i * (record.sizes.segment * record.sizes.block) < self.ends.num_steps
        first = packing.pack(self.first)
        first = {k: jnp.where(begun, x[i], first[k]) for k, x in record.firsts.items()}
        states = lax.scan(advance, first, jtu.tree_map(jnp.ravel, arrays))[1]
        return {k: x.reshape(*steps.start.shape, -1) for k, x in states.items()}

    def _through_segment(self, gradient: Gradient, i: IntScalar, total: IntScalar) -> Gradient:
        sizes = self.record.sizes
        blocks, static = eqx.partition(self._steps_of_segment(i), eqx.is_array)
        begun = total - i * (sizes.segment * sizes.block)  # steps

        def through_block(carry):
            j, gradient = carry
            steps = eqx.combine(jtu.tree_map(lambda x: x[j - 1], blocks), static)
            num_steps = jnp.minimum(begun - (j - 1) * sizes.block, sizes.block)
            return j - 1, self._through_block(gradient, steps, num_steps)

        start = jnp.minimum(-(-begun // sizes.block), sizes.segment), gradient
        return lax.while_loop(lambda carry: carry[0] > 0, through_block, start)[1]

    def _through_block(self, gradient: Gradient, steps: Step, num_steps: IntScalar) -> Gradient:
        # Fetched one step ahead: XLA would copy the slices into every kernel that needs them.
        arrays, static = eqx.partition(steps, eqx.is_array)
        fetched = lambda j: jtu.tree_map(lambda x: x[jnp.maximum(j, 0)], arrays)

        def through_step(carry):
            j, gradient, step = carry
            return j - 1, self._through_step(gradient, eqx.combine(step, static)), fetched(j - 1)

        start = num_steps - 1, gradient, fetched(num_steps - 1)
        return lax.while_loop(lambda carry: carry[0] >= 0, through_step, start)[1]

    def _through_step(self, gradient: Gradient, step: Step) -> Gradient:
        state = self.record.packing.unpack(step.state)
        smooth, discrete = eqx.partition(state, eqx.is_inexact_array)

        def value(leaves: Any, smooth: State, times: Any) -> tuple[State, Any]:
            start, end = (step.start, step.end) if times is None else times
            x = eqx.combine(smooth, discrete)
            out = self._replay(leaves).step(start, end, step.jumped, x)
            return eqx.filter(out, eqx.is_inexact_array)

        times = None if gradient.times is None else (step.start, step.end)
        (after, dense_info), pullback = jax.vjp(value, self.leaves, smooth, times)
        new = gradient
        for k in range(len(self.rest.savings)):
            new = self._saved_behind(new, k, step, after.y)
        zero = jtu.tree_map(jnp.zeros_like, dense_info)
        bar = self.dense.of(gradient.number, self.ends.num_accepted, zero)
        for k in range(len(self.rest.savings)):
            new, bar = self._saved_inside(new, k, step, dense_info, bar)
        leaves_bar, state_bar, times_bar = pullback((new.state, bar))
        new = self._at_ends_of_step(new, step, times_bar)
        leaves = _add(new.leaves, leaves_bar)
        new = new._replace(number=new.number - 1, state=state_bar, leaves=leaves)
        return jtu.tree_map(lambda a, b: jnp.where(step.accepted, a, b), new, gradient)

    def _saved_behind(self, gradient: Gradient, k: int, step: Step, y: Y) -> Gradient:
        """The row of the state behind a step, if it was saved."""
        saving, rows, row = self.rest.savings[k], self.rows[k], gradient.rows[k]
        if not saving.steps:
            return gradient
        saved = (gradient.number % saving.steps == 0) & (row >= saving.offset)
        # The time that was saved is that behind a jump at which the step ended.
        t = jnp.where(saved, rows.times[row], step.end)
        bar = jtu.tree_map(lambda b: jnp.where(saved, b[row], 0), rows.values_bar)
        gradient = self._through_value(
            gradient, k, t, y, bar, jnp.where(saved, rows.times_bar[row], 0)
        )
        return gradient._replace(rows=_replaced(gradient.rows, k, row - jnp.where(saved, 1, 0)))

    def _saved_inside(
        self, gradient: Gradient, k: int, step: Step, dense_info: Any, bar: Any
    ) -> tuple[Gradient, Any]:
        """The rows interpolated in a step, and the cotangent of `dense_info`."""
        saving, rows = self.rest.savings[k], self.rows[k]
        if not saving.num_times:
            return gradient, bar
        first = gradient.number == 1

        def is_inside(carry):
            gradient, _ = carry
            row = gradient.rows[k]
            t = rows.times[row]
            # A time at the start of a step is saved at the end of the one before, from which only
            # a jump separates it.
            inside = first | (t > step.start) | ((t == step.start) & step.jumped)
            return step.accepted & (row >= saving.offset) & inside

        def through_row(carry):
            gradient, dense_bar = carry
            row = gradient.rows[k]

            def value(leaves: Any, dense_info: Any, times: Any) -> Any:
                t, start, end = times or (rows.times[row], step.start, step.end)
                saved = self._replay(leaves).savings[k].in_step(t, start, end, dense_info)
                return eqx.filter(saved, eqx.is_inexact_array)

            times = (rows.times[row], step.start, step.end)
            times = None if gradient.times is None else times
            bar = jtu.tree_map(lambda b: b[row], rows.values_bar)
            leaves_bar, more, times_bar = jax.vjp(value, self.leaves, dense_info, times)[1](bar)
            gradient = gradient._replace(
                rows=_replaced(gradient.rows, k, row - 1), leaves=_add(gradient.leaves, leaves_bar)
            )
            if times_bar is not None:
                t_bar, *times_bar = times_bar
                t_bar = t_bar + rows.times_bar[row]
                of_steps = (gradient.number - 1) // saving.steps if saving.steps else 0
                i = row - saving.offset - of_steps
                gradient = self._at_saved_time(gradient, k, i, t_bar)
                gradient = self._at_ends_of_step(gradient, step, times_bar)
            return gradient, _add(dense_bar, more)

        return lax.while_loop(is_inside, through_row, (gradient, bar))

    # Times, if they have derivatives.

    def _at_ends_of_step(self, gradient: Gradient, step: Step, times_bar: Any) -> Gradient:
        if times_bar is None:
            return gradient
        start_bar, end_bar = times_bar
        bars, ends = gradient.times, self.ends
        t0 = bars.t0 + jnp.where(step.start == ends.t0, start_bar, 0)
        t1 = bars.t1 + jnp.where(step.end == ends.t1, end_bar, 0)
        return gradient._replace(times=bars._replace(t0=t0, t1=t1))

    def _at_end_of_solve(self, gradient: Gradient, t: Any, bar: FloatScalar) -> Gradient:
        """A value saved at `t`, if that is one of the ends."""
        bars, ends = gradient.times, self.ends
        at_start = t == ends.t0
        t0 = bars.t0 + jnp.where(at_start, bar, 0)
        t1 = bars.t1 + jnp.where((t == ends.t1) & ~at_start, bar, 0)
        return gradient._replace(times=bars._replace(t0=t0, t1=t1))

    def _at_saved_time(
        self, gradient: Gradient, k: int, i: IntScalar, bar: FloatScalar
    ) -> Gradient:
        ts = _replaced(gradient.times.ts, k, gradient.times.ts[k].at[i].add(bar))
        return gradient._replace(times=gradient.times._replace(ts=ts))


def _add(a: Any, b: Any) -> Any:
    return jtu.tree_map(jnp.add, a, b)


def _replaced(items: list, k: int, item: Any) -> list:
    return [*items[:k], item, *items[k + 1 :]]


def _only(used: Bool[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    """The rows that are used, zeros for the others, whatever they hold."""
    return jnp.where(used.reshape(used.shape + (1,) * (x.ndim - 1)), x, 0)
