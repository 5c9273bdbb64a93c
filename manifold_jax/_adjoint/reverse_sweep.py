"""The reverse sweep: the recorded steps in reverse order, each computed again and transposed."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.compat import unvmap_max
from .._base.types import IntScalar
from .gradient import add, Ends, Gradient, RecordedStep, TimesBar
from .record import counted_down, Record, rows_backwards, Vectors
from .replay import Event, Replay, State
from .saved import Functions, SavedValues


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


class ResetBars(NamedTuple):
    """The number of resets, and the cotangents of their times and of the states before and after them;
    of the times at which steps of the dense solution begin, and of that of the last step."""

    number: IntScalar
    rows: Any  # leading axis: resets
    dense_ts: Any
    last_start: Any


class ReverseSweep(eqx.Module):
    """Transposed steps of a recorded solve."""

    functions: Functions
    record: Record
    first: State
    ends: Ends
    saved: SavedValues
    dense: DenseBars
    resets: ResetBars | None

    def run(self, last_bar: State, timed: bool) -> Gradient:
        """Return the gradient from the cotangent of the last state."""
        gradient = Gradient(
            self.ends.num_accepted,
            [rows.count - 1 for rows in self.saved.rows],
            last_bar,
            jtu.tree_map(jnp.zeros_like, self.functions.leaves),
            self._no_times() if timed else None,
            None if self.resets is None else jnp.zeros_like(self.ends.t0),
            None if self.resets is None else self.resets.number,
        )
        gradient = self.saved.through_end(gradient)
        total, sizes = unvmap_max(self.ends.num_steps), self.record.sizes
        segments = -(-total // (sizes.segment * sizes.block))
        through = lambda gradient, i: self._through_segment(gradient, i, total)
        gradient = counted_down(segments, through, gradient)
        return self.saved.through_start(gradient, self.first.y)

    def _no_times(self) -> TimesBar:
        zero = jnp.zeros_like(self.ends.t0)
        counts = (saving.num_times for saving in self.functions.rest.savings)
        ts = [jnp.zeros(n, zero.dtype) if n else None for n in counts]
        prescribed = jtu.tree_map(jnp.zeros_like, self.ends.prescribed)
        return TimesBar(zero, zero, ts, prescribed)

    def _steps_of_segment(self, i: IntScalar) -> RecordedStep:
        """Return the steps of a segment, with leading axes for blocks and steps."""
        record, sizes = self.record, self.record.sizes
        part = lambda x, i: lax.dynamic_slice_in_dim(x, i * sizes.segment, sizes.segment)
        times = part(record.times, i)
        accepted = times[..., 1] > -jnp.inf
        # Rows that are not of an accepted step hold a step of length zero from the first state:
        # functions may refuse anything that is not a state or a time.
        start, end = (jnp.where(accepted, times[..., i], self.ends.t0) for i in range(2))
        if record.noise:
            start, end = lax.stop_gradient((start, end))
        jumped = accepted & (times[..., 2] > 0) if record.jumps else None
        reset = begins_at_reset = None
        if record.resets:
            code = jnp.where(accepted, times[..., -1], -2).astype(jnp.int32)
            reset, begins_at_reset = code // 2, code % 2 == 1
        times = start, end, jumped, reset, begins_at_reset, accepted
        last = max(sizes.kept // sizes.segment - 1, 0)
        kept = lambda: {k: part(x, jnp.minimum(i, last)) for k, x in record.states.items()}
        again = lambda: self._states_again(i, RecordedStep(*times, {}))
        if not record.firsts:
            states = kept()
        elif not record.states:
            states = again()
        else:
            states = lax.cond(i <= last, kept, again)
        first = record.packing.pack(self.first)
        used = lambda x, first: jnp.where(accepted[..., None], x, first)
        return RecordedStep(*times, {k: used(x, first[k]) for k, x in states.items()})

    def _states_again(self, i: IntScalar, steps: RecordedStep) -> Vectors:
        """Compute the states of a segment again from its first one."""
        record, packing = self.record, self.record.packing

        def advance(x, step):
            of = step.start, step.end, step.begins_at_jump, step.reset, packing.unpack(x)
            new, *_ = self.functions.replay.step(*of)
            new = packing.pack(new)
            return {k: jnp.where(step.accepted, new[k], x[k]) for k in x}, x

        begun = i * (record.sizes.segment * record.sizes.block) < self.ends.num_steps
        first = packing.pack(self.first)
        first = {k: jnp.where(begun, x[i], first[k]) for k, x in record.firsts.items()}
        states = lax.scan(advance, first, jtu.tree_map(jnp.ravel, steps))[1]
        return {k: x.reshape(*steps.start.shape, -1) for k, x in states.items()}

    def _through_segment(self, gradient: Gradient, i: IntScalar, total: IntScalar) -> Gradient:
        sizes, blocks = self.record.sizes, self._steps_of_segment(i)
        begun = total - i * (sizes.segment * sizes.block)  # steps

        def through_block(gradient: Gradient, j: IntScalar) -> Gradient:
            steps = jtu.tree_map(lambda x: x[j], blocks)
            num_steps = jnp.minimum(begun - j * sizes.block, sizes.block)
            return rows_backwards(steps, num_steps, self._through_step, gradient)

        count = jnp.minimum(-(-begun // sizes.block), sizes.segment)
        return counted_down(count, through_block, gradient)

    def _through_step(self, gradient: Gradient, step: RecordedStep) -> Gradient:
        state = self.record.packing.unpack(step.state)
        smooth, discrete = eqx.partition(state, eqx.is_inexact_array)

        def out(replay: Replay, smooth: State, ends: Any) -> tuple[State, Any, Event | None]:
            state = eqx.combine(smooth, discrete)
            return replay.step(*ends, step.begins_at_jump, step.reset, state)

        times, ends = gradient.times, (step.start, step.end)
        (after, dense_info, _), pullback = self.functions.vjp(out, smooth, ends, gradient.is_timed)
        new = gradient
        for k in range(len(self.functions.rest.savings)):
            new = self.saved.after_step(new, k, step, after.y)
        zero = jtu.tree_map(jnp.zeros_like, dense_info)
        bar = self.dense.of(gradient.number, self.ends.num_accepted, zero)
        start_bars = []
        for k in range(len(self.functions.rest.savings)):
            new, bar, start_bar = self.saved.inside_step(new, k, step, dense_info, bar)
            start_bars.append(start_bar)
        event_bar, resets = self._of_event(new, step)
        leaves_bar, state_bar, ends_bar = pullback((new.state, bar, event_bar))
        times, start = new.times, None
        if self.resets is not None:
            start = sum(start_bars, ends_bar[0])
            if self.resets.last_start is not None:
                is_last = gradient.number == self.ends.num_accepted
                start += jnp.where(is_last, self.resets.last_start, 0)
        if times is not None:
            times = times.at_ends_of_step(self.ends, step, *ends_bar)
        leaves = add(new.leaves, leaves_bar)
        new = Gradient(new.number - 1, new.rows, state_bar, leaves, times, start, resets)
        return jtu.tree_map(lambda a, b: jnp.where(step.accepted, a, b), new, gradient)

    def _of_event(self, gradient: Gradient, step: RecordedStep) -> tuple[Any, IntScalar | None]:
        """Return the cotangents of the event at the end of a step, which is the start of the step
        after it, and the number of resets before it."""
        if self.resets is None or step.reset is None:
            return None, None
        assert gradient.start is not None
        assert gradient.resets is not None
        is_event, row = step.reset >= 0, gradient.resets - 1
        of_row = lambda b: jnp.where(is_event, b[jnp.maximum(row, 0)], 0)
        time, before, after = jtu.tree_map(of_row, self.resets.rows)
        time += jnp.where(is_event, gradient.start, 0)
        if self.resets.dense_ts is not None:
            time += jnp.where(is_event, self.resets.dense_ts[gradient.number], 0)
        return Event(time, before, after), jnp.where(is_event, row, gradient.resets)
