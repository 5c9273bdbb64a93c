"""Reverse mode of many trajectories in lanes: forwards once more, then back step by step.

Lanes are not refilled here: the trajectories are sorted by their number of steps, and each group of
them goes back together. Their steps are divided into segments. The states of one segment are recorded
at a time; of the others only the first state is kept.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from ..._adjoint.record import rows_backwards
from ..._adjoint.replay import State
from ..._jaxpr.lane_arrays import Lanes
from ..._jaxpr.lane_interpreter import call_in_lanes
from ..._jaxpr.lane_value import ColumnLayout, Columns, LaneValue, where
from .columns import added, read, Stacked, taken
from .functions import begin, interpolate, save, smooth_part, step, step_state
from .parts import Parts
from .records import Bars, Group, InputBars, LaneEnds, LaneRecord
from .trajectory import LaneEquations


# Largest size of the record of a segment.
_BYTES = 2**22


class LaneReverseSweep:
    """Cotangents of the inputs of `N` trajectories from those of their outputs, in [`LaneEnds`][].

    - `each`, `rest`, `starts`: the data that each trajectory has of its own, differentiated and not,
        and its start. `firsts`, `first_bar`, `last_bar`: its first state, and the cotangents of that and
        of the last one. Columns of shape `(N,)`.
    - `values_bar`: the cotangents of the values at `ts`, columns of shape `(N * times,)`.
    - `common`, `no_common`: the common data; zeros like their cotangents, which are summed
        in each lane, columns of shape `(lanes,)`.
    - `solver_state`: zeros, for the part of a solver's state that steps do not depend on.
    - `smooth_layout`: the layout of the differentiable part of the state that a step depends on.
    - `rows`: the number of steps in a segment. `needed`: see `_needed`.
    """

    def __init__(self, parts: Parts, ends: LaneEnds, limit: int):
        self.parts, self.ends = parts, ends
        equations = parts.rest.equations
        self.max_steps, self.ts = equations.max_steps, equations.saveat.subs.ts
        self.size = ends.num_steps.size
        self.lanes = Lanes(min(equations.lanes, self.size), limit)
        self.solver_state = jtu.tree_map(lambda x: jnp.zeros_like(x[0]), ends.start.solver_state)
        of = Columns.of_arrays
        self.each, self.rest, self.starts = of(parts.each), of(parts.rest_each), of(ends.start)
        self.firsts, self.first_bar, self.last_bar = (
            of(x) for x in (ends.start.y, ends.first_bar, ends.last_bar)
        )
        self.common = jtu.tree_map(LaneValue.of_constant, parts.common)
        common = Columns.of_values(self.common, self.lanes)  # not inside a loop
        self.no_common = jtu.tree_map(jnp.zeros_like, common)
        self.values_bar = of(jtu.tree_map(lambda x: x.reshape(-1, *x.shape[2:]), ends.values_bar))
        self.smooth_layout = ColumnLayout.of_one(smooth_part(step_state(ends.start)))
        self.needed = self._needed()

    def run(self) -> tuple[Any, Any]:
        """Return the cotangents of `parts.each` and of `parts.common`."""
        count = self.lanes.count
        groups = -(-self.size // count)
        order = jnp.argsort(self.ends.num_steps)
        index = jnp.full(groups * count, self.size).at[: self.size].set(order)
        start = self._empty_record(), self.no_common
        (_, common), each = lax.scan(self._through_group, start, index.reshape(groups, count))
        empty = lambda x: jnp.zeros_like(x, shape=self.size)
        in_order = lambda x: empty(x).at[order].set(x.ravel()[: self.size])
        total = jtu.tree_map(lambda x: jnp.sum(x, keepdims=True), common).arrays()
        return jtu.tree_map(in_order, each).arrays(), jtu.tree_map(lambda x: x[0], total)

    def _needed(self) -> Array:
        """Return which trajectories have a cotangent other than zero, shape `(N,)`. The steps of one
        that failed may have no derivative."""
        bars = self.ends.first_bar, self.ends.last_bar, self.ends.values_bar
        used = [jnp.any(x.reshape(self.size, -1) != 0, axis=1) for x in jtu.tree_leaves(bars)]
        return jnp.any(jnp.stack(used), axis=0)

    def _empty_record(self) -> LaneRecord:
        start = self.ends.start
        layout = ColumnLayout.of_one((start.tprev, start.tnext, step_state(start)))
        one = Stacked.of(Columns.zeros(layout, self.lanes.count))
        rows = max(_BYTES // sum(x.nbytes for x in jtu.tree_leaves(one)), 1)
        self.rows = min(rows, self.max_steps)
        steps = jtu.tree_map(lambda x: jnp.zeros((self.rows, *x.shape), x.dtype), one)
        return LaneRecord(steps, jnp.zeros((self.rows, self.lanes.count), bool))

    def _through_group(self, carry: Any, index: Array) -> tuple[Any, Columns]:
        record, common = carry
        present, index = index < self.size, jnp.minimum(index, self.size - 1)
        with self.lanes.inside(self.starts.columns[0][index]):
            each, rest = taken((self.each, self.rest), index)
            group = Group(index, present & self.needed[index], each, rest, None)
            group, bars = self._through_values(group, common)
            bars, record = self._through_segments(group, bars, record)
            first_bar = self._state_bar(taken(self.first_bar, index))
            bar = jtu.tree_map(jnp.add, bars.state, first_bar)
            inputs_bar, _ = self._transposed(begin, group, None, bar.values())
            bars = self._including(bars, group.present, inputs_bar)
            return (record, bars.common), bars.each

    def _state_bar(self, y_bar: Columns) -> Columns:
        """Extend the cotangent of a state by zeros for the solver's memory."""
        zeros = Columns.zeros(self.smooth_layout, self.lanes.count)
        columns = [*y_bar.columns, *zeros.columns[len(y_bar.columns) :]]
        return Columns(columns, self.smooth_layout)

    def _through_values(self, group: Group, common: Columns) -> tuple[Group, Bars]:
        """Begin the sweep: transpose the saved values of the states at `ts`, time by time."""
        index, none = group.index, jtu.tree_map(jnp.zeros_like, group.each)
        rows = self.ends.rows[index]
        last_bar = self._state_bar(taken(self.last_bar, index))
        bars = Bars(last_bar, none, common, rows - 1)
        states = self.ends.states
        if states is None:
            return group, bars
        first = taken(self.firsts, index)

        def at_time(bars: Bars, row: Array) -> tuple[Bars, Stacked]:
            place, reached = index * self.ts.size + row, row < rows
            with self.lanes.inside(first.columns[0]):
                y = where(reached, read(states, place), first).values()
                bar = taken(self.values_bar, place).values()
                t = LaneValue.of_column(jnp.broadcast_to(self.ts[row], reached.shape))
                inputs_bar, y_bar = self._transposed(save, group, y, bar, t)
                bars = self._including(bars, group.present & reached, inputs_bar)
                return bars, Stacked.of(Columns.of_values(y_bar, self.lanes))

        bars, at_times = lax.scan(at_time, bars, jnp.arange(self.ts.size))
        return group._replace(at_times=at_times), bars

    def _through_segments(
        self, group: Group, bars: Bars, record: LaneRecord
    ) -> tuple[Bars, LaneRecord]:
        """Make the steps again, segment by segment, and go back through them.

        One loop does both, so that the program contains a step and its transpose once. `firsts[k]` is
        the state with which segment `k` begins. While `onwards`, an iteration makes the steps of segment
        `k`, stores where the next one begins, and goes on to `k + 1`. The last segment ends that: from
        there every iteration makes the steps of segment `k` (again), goes back through their
        record, and on to `k - 1`. All segments but the last are made twice."""
        segments = -(-self.max_steps // self.rows)
        room = lambda x: jnp.zeros((segments, *x.shape), x.dtype).at[0].set(x)
        firsts = jtu.tree_map(room, Stacked.of(taken(self.starts, group.index)))

        def through_segment(carry: Any) -> Any:
            k, onwards, firsts, record, bars = carry
            with self.lanes.inside():
                state = taken(firsts, k).columns()
                num_rows, unfinished, state, record = self._forwards(group, state, record)
                onwards = onwards & unfinished
                num_rows = jnp.where(onwards, 0, num_rows)
                through = lambda bars, step: self._through_step(group, step, bars)
                bars = rows_backwards(record, num_rows, through, bars)
                write = lambda x, new: x.at[k + 1].set(new, mode="drop")
                # The state after the last segment is dropped.
                firsts = jtu.tree_map(write, firsts, Stacked.of(state))
                return jnp.where(onwards, k + 1, k - 1), onwards, firsts, record, bars

        start = jnp.asarray(0), jnp.asarray(True), firsts, record, bars
        *_, record, bars = lax.while_loop(lambda carry: carry[0] >= 0, through_segment, start)
        return bars, record

    def _forwards(self, group: Group, state: Columns, record: LaneRecord) -> tuple[Any, ...]:
        """Make and record the steps of a segment; return how many there are, whether some lane goes
        on after it, the states there, and the record."""

        def goes_on(state: Columns) -> Array:
            return self._column(LaneEquations.goes_on, group, state.values()) & group.present

        def onwards(carry: Any) -> Any:
            row, active, state, record = carry
            with self.lanes.inside(state.columns[0]):
                before = state.values()
                tried = self._of_one(LaneEquations.attempt, group, before)
                made = before.tprev, before.tnext, step_state(before)
                steps = Stacked.of(Columns.of_values(made, self.lanes))
                new = LaneRecord(steps, active & tried.kept.columns(self.lanes)[0])
                record = jtu.tree_map(lambda x, new: x.at[row].set(new), record, new)
                after = Columns.of_values(tried.trajectory, self.lanes)
                state = where(active, after, state)
                return row + 1, goes_on(state), state, record

        with self.lanes.inside():
            start = jnp.asarray(0), goes_on(state), state, record
        unfinished = lambda carry: (carry[0] < self.rows) & jnp.any(carry[1])
        row, active, state, record = lax.while_loop(unfinished, onwards, start)
        return row, jnp.any(active), state, record

    def _through_step(self, group: Group, step: LaneRecord, bars: Bars) -> Bars:
        columns = step.steps.columns()
        with self.lanes.inside(columns.columns[0]):
            dense_info, pullback = self._call(self._step, group, *columns.values())
            bars, dense_bar = self._through_rows(group, step.accepted, columns, dense_info, bars)
            transpose = lambda pullback, *bar: pullback(bar)
            bar = bars.state.values(), dense_bar
            *inputs_bar, state_bar = call_in_lanes(self.lanes, transpose, pullback, *bar)
            state_bar = Columns.of_values(state_bar, self.lanes)
            bars = self._including(bars, step.accepted, InputBars(*inputs_bar))
            return bars._replace(state=where(step.accepted, state_bar, bars.state))

    def _step(self, given: Any, start: Any, end: Any, state: State) -> tuple[Any, Callable]:
        """Return the data of the interpolation in a step, and its pullback: from the cotangents of the
        smooth part of the state after it and of these data to those of `each`, `common`, `state`."""
        each, common, rest = given
        smooth, discrete = eqx.partition(state, eqx.is_inexact_array)
        value = self.parts.smooth(step, rest, discrete, self.solver_state, start, end)
        _, pullback, dense_info = jax.vjp(value, each, common, smooth, has_aux=True)
        return dense_info, pullback

    def _through_rows(
        self, group: Group, accepted: Array, step: Columns, dense_info: Any, bars: Bars
    ) -> tuple[Bars, Any]:
        """Transpose the interpolations in a step: return the cotangent of their data."""
        if group.at_times is None:
            zero = lambda value: LaneValue.of_constant(jnp.zeros(value.shape, value.dtype))
            return bars, jtu.tree_map(zero, dense_info)
        info, (start, end) = Columns.of_values(dense_info, self.lanes), step.columns[:2]
        direction = self._column(lambda equations, given: given.direction, group)
        at = lambda row: self.ts.astype(start.dtype)[jnp.maximum(row, 0)] * direction
        due = lambda row: accepted & (row >= 0) & (at(row) > start)
        lane = jnp.arange(group.index.size)

        def through_row(carry: Any) -> Any:
            row, info_bar = carry
            here, place = due(row), jnp.maximum(row, 0)
            with self.lanes.inside():
                bar = jtu.tree_map(lambda x: x[place, :, lane].T, group.at_times).columns().values()
                times = map(LaneValue.of_column, (at(row), start, end))
                _, more = self._transposed(interpolate, group, info.values(), bar, *times)
                more = Columns.of_values(more, self.lanes)
                return row - here.astype(row.dtype), added(info_bar, more, here)

        none = jtu.tree_map(jnp.zeros_like, info)
        row, bar = lax.while_loop(lambda c: jnp.any(due(c[0])), through_row, (bars.row, none))
        return bars._replace(row=row), bar.values()

    def _including(self, bars: Bars, active: Array, more: InputBars) -> Bars:
        """Add cotangents of the inputs in the lanes that are active."""
        each, common = (Columns.of_values(x, self.lanes) for x in more)
        each, common = added((bars.each, bars.common), (each, common), active)
        return bars._replace(each=each, common=common)

    def _call(self, function: Callable, group: Group, *args: Any) -> Any:
        given = group.each.values(), self.common, group.rest.values()
        return call_in_lanes(self.lanes, function, given, *args)

    def _of_one(self, function: Callable, group: Group, *args: Any) -> Any:
        """`function(equations, given, *args)` of every trajectory in the group."""
        call = lambda given, *args: function(*self.parts.one(*given), *args)
        return self._call(call, group, *args)

    def _column(self, function: Callable, group: Group, *args: Any) -> Array:
        return self._of_one(function, group, *args).columns(self.lanes)[0]

    def _transposed(
        self, function: Callable, group: Group, x: Any, bar: Any, *args: Any
    ) -> tuple[InputBars, Any]:
        """Return the cotangents of the inputs and of `x`, for a function of `functions.py`."""

        def transposed(given: Any, x: Any, bar: Any, *args: Any) -> tuple[InputBars, Any]:
            each, common, rest = given
            value = self.parts.smooth(function, rest, *args)
            each_bar, common_bar, x_bar = jax.vjp(value, each, common, x, has_aux=True)[1](bar)
            return InputBars(each_bar, common_bar), x_bar

        return self._call(transposed, group, x, bar, *args)
