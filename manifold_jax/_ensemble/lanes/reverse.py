"""Reverse mode of many trajectories in lanes: forwards once more, then back step by step.

Lanes go together and are not refilled, but hold trajectories of about as many steps. States are
recorded for one segment of the steps at a time; of the others there is the first state.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from ..._jaxpr.lane_arrays import Lanes
from ..._jaxpr.lane_interpreter import call_in_lanes
from ..._jaxpr.lane_value import columns_of_values, Layout, Value
from .columns import (
    added,
    columns_of_arrays,
    read,
    stacked,
    taken,
    unstacked,
    where,
)
from .functions import Functions, smooth_part, step_state
from .parts import Parts
from .records import Bars, Ends, Group, Record


# Of the record of a segment.
_BYTES = 2**22


class ReverseSweep:
    def __init__(self, parts: Parts, ends: Ends, lanes: int, limit: int):
        self.parts, self.ends = parts, ends
        self.functions = Functions(parts, jtu.tree_map(lambda x: x[0], ends.start.solver_state))
        self.size = ends.num_steps.size
        self.lanes = Lanes(min(lanes, self.size), limit)
        self.each, self.rest = (columns_of_arrays(x) for x in (parts.each, parts.rest_each))
        self.each_layout, self.rest_layout = (
            Layout.of_one(x) for x in (parts.each, parts.rest_each)
        )
        self.starts, self.state_layout = columns_of_arrays(ends.start), Layout.of_one(ends.start)
        remembered = step_state(ends.start)
        self.step_layout = Layout.of_one(remembered)
        self.smooth_layout = Layout.of_one(smooth_part(remembered))
        self.y_layout = Layout.of_one(ends.start.y)
        self.firsts, self.first_bar, self.last_bar = (
            columns_of_arrays(x) for x in (ends.start.y, ends.first_bar, ends.last_bar)
        )
        self.common = jtu.tree_map(Value.of_constant, parts.common)
        self.common_columns = columns_of_values(self.common, self.lanes)  # not in a loop first
        equations = parts.rest[0]
        self.max_steps, self.ts = equations.max_steps, equations.saveat.subs.ts
        rows = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[2:]), ends.values_bar)
        self.values_bar, self.values_layout = columns_of_arrays(rows), Layout.of_one(rows)
        self.needed = self._needed()

    def run(self) -> tuple[Any, Any]:
        """Cotangents of `parts.each` and of `parts.common`."""
        count = self.lanes.count
        groups = -(-self.size // count)
        order = jnp.argsort(self.ends.num_steps)
        index = jnp.full(groups * count, self.size).at[: self.size].set(order)
        start = self._empty_record(), [jnp.zeros_like(x) for x in self.common_columns]
        (_, common), each = lax.scan(self._through_group, start, index.reshape(groups, count))
        each = [
            jnp.zeros_like(x, shape=self.size).at[order].set(x.ravel()[: self.size]) for x in each
        ]
        total = Layout.of(self.parts.common).arrays([jnp.sum(x, keepdims=True) for x in common])
        return self.each_layout.arrays(each), jtu.tree_map(lambda x: x[0], total)

    def _needed(self) -> Array:
        """Which trajectories anything depends on. The steps of one that failed may have no
        derivative."""
        bars = self.ends.first_bar, self.ends.last_bar, self.ends.values_bar
        used = [jnp.any(x.reshape(self.size, -1) != 0, axis=1) for x in jtu.tree_leaves(bars)]
        return jnp.any(jnp.stack(used), axis=0)

    def _empty_record(self) -> Record:
        time = self.ends.start.tprev.dtype
        self.record_dtypes = [time, time, *self.step_layout.dtypes_of_columns()]
        one = stacked([jnp.zeros(self.lanes.count, dtype) for dtype in self.record_dtypes])
        rows = max(_BYTES // sum(x.nbytes for x in one.values()), 1)
        self.rows = min(rows, self.max_steps)
        steps = {k: jnp.zeros((self.rows, *x.shape), x.dtype) for k, x in one.items()}
        return Record(steps, jnp.zeros((self.rows, self.lanes.count), bool))

    def _through_group(self, carry: Any, index: Array) -> tuple[Any, list[Array]]:
        record, common = carry
        present, index = index < self.size, jnp.minimum(index, self.size - 1)
        with self.lanes.inside(self.starts[0][index]):
            each, rest = taken(self.each, index), taken(self.rest, index)
            group = Group(index, present & self.needed[index], each, rest, {})
            group, bars = self._through_values(group, common)
            bars, record = self._through_segments(group, bars, record)
            first = taken(self.first_bar, index)
            y_bar = [x + y for x, y in zip(bars.state, first, strict=False)]
            bar = self.smooth_layout.values(y_bar + bars.state[len(first) :])
            through = self._call(self.functions.through_start, group, bar)
            bars = self._including(bars, group.present, *through)
            return (record, bars.common), bars.each

    def _through_values(self, group: Group, common: list[Array]) -> tuple[Group, Bars]:
        """What is returned at `ts`, time by time, to begin with."""
        index, last = group.index, taken(self.last_bar, group.index)
        zeros = [jnp.zeros(index.size, d) for d in self.smooth_layout.dtypes_of_columns()]
        none = [jnp.zeros_like(x) for x in group.each]
        rows = self.ends.rows[index]
        bars = Bars([*last, *zeros[len(last) :]], none, common, rows - 1)
        if self.ts is None:
            return group, bars
        first, dtypes = taken(self.firsts, index), self.y_layout.dtypes_of_columns()

        def at_time(bars: Bars, row: Array) -> tuple[Bars, dict[str, Array]]:
            place, reached = index * self.ts.size + row, row < rows
            with self.lanes.inside(first[0]):
                y = where(reached, read(self.ends.states, place, dtypes), first)
                bar = self.values_layout.values(taken(self.values_bar, place))
                t = Layout.of(self.ts[0]).values([jnp.broadcast_to(self.ts[row], reached.shape)])
                *through, y_bar = self._call(
                    self.functions.through_handed_out, group, t, self.y_layout.values(y), bar
                )
                bars = self._including(bars, group.present & reached, *through)
                return bars, stacked(columns_of_values(y_bar, self.lanes))

        bars, at_times = lax.scan(at_time, bars, jnp.arange(self.ts.size))
        return group._replace(at_times=at_times), bars

    def _through_segments(self, group: Group, bars: Bars, record: Record) -> tuple[Bars, Record]:
        """Go forwards to the last segment, storing where each begins, and back."""
        state, dtypes = taken(self.starts, group.index), self.state_layout.dtypes_of_columns()
        segments = -(-self.max_steps // self.rows)
        room = lambda x: jnp.zeros((segments, *x.shape), x.dtype).at[0].set(x)
        firsts = {k: room(x) for k, x in stacked(state).items()}

        def through_segment(carry: Any) -> Any:
            k, onwards, firsts, record, bars = carry
            with self.lanes.inside():
                state = unstacked({d: x[k] for d, x in firsts.items()}, dtypes)
                num_rows, unfinished, state, record = self._forwards(group, state, record)
                onwards = onwards & unfinished
                bars = self._backwards(group, jnp.where(onwards, 0, num_rows), record, bars)
                after = stacked(state)  # is not read again in the reverse sweep
                firsts = {d: x.at[k + 1].set(after[d], mode="drop") for d, x in firsts.items()}
                return jnp.where(onwards, k + 1, k - 1), onwards, firsts, record, bars

        start = jnp.asarray(0), jnp.asarray(True), firsts, record, bars
        *_, record, bars = lax.while_loop(lambda carry: carry[0] >= 0, through_segment, start)
        return bars, record

    def _forwards(self, group: Group, state: list[Array], record: Record) -> tuple[Any, ...]:
        """The steps of a segment, which are recorded; whether some lane goes on behind it."""

        def goes_on(state: list[Array]) -> Array:
            trajectory = self.state_layout.values(state)
            goes_on = self._call(self.functions.goes_on, group, trajectory)
            return self._column(goes_on) & group.present

        def step(carry: Any) -> Any:
            row, active, state, record = carry
            with self.lanes.inside(state[0]):
                before = self.state_layout.values(state)
                tried = self._call(self.functions.attempt, group, before)
                x = columns_of_values((before.tprev, before.tnext, step_state(before)), self.lanes)
                accepted = active & self._column(tried.kept)
                record = record.with_row(row, x, accepted)
                state = where(active, columns_of_values(tried.trajectory, self.lanes), state)
                return row + 1, goes_on(state), state, record

        with self.lanes.inside():
            start = jnp.asarray(0), goes_on(state), state, record
        unfinished = lambda carry: (carry[0] < self.rows) & jnp.any(carry[1])
        row, active, state, record = lax.while_loop(unfinished, step, start)
        return row, jnp.any(active), state, record

    def _backwards(self, group: Group, num_rows: Array, record: Record, bars: Bars) -> Bars:
        # Fetched one step ahead: XLA would copy the slices into every kernel that needs them.
        fetched = lambda row: jtu.tree_map(lambda x: x[jnp.maximum(row, 0)], record)

        def back(carry: Any) -> Any:
            row, step, bars = carry
            columns = unstacked(step.steps, self.record_dtypes)
            with self.lanes.inside(columns[0]):
                bars = self._through_step(group, step.accepted, columns, bars)
            return row - 1, fetched(row - 1), bars

        start = num_rows - 1, fetched(num_rows - 1), bars
        return lax.while_loop(lambda carry: carry[0] >= 0, back, start)[-1]

    def _through_step(
        self, group: Group, accepted: Array, columns: list[Array], bars: Bars
    ) -> Bars:
        layout = Layout.of(self.ends.start.tprev[0])
        start, end = (layout.values([x]) for x in columns[:2])
        state = self.step_layout.values(columns[2:])
        dense_info, pullback = self._call(self.functions.step, group, start, end, state)
        if self.ts is None:
            zero = lambda value: Value.of_constant(jnp.zeros(value.shape, value.dtype))
            dense_bar = jtu.tree_map(zero, dense_info)
        else:
            bars, dense_bar = self._through_rows(group, accepted, columns[:2], dense_info, bars)
        bar = self.smooth_layout.values(bars.state), dense_bar
        transpose = lambda pullback, bar: pullback(bar)
        *through, state_bar = call_in_lanes(self.lanes, transpose, pullback, bar)
        state_bar = columns_of_values(state_bar, self.lanes)
        bars = self._including(bars, accepted, *through)
        return bars._replace(state=where(accepted, state_bar, bars.state))

    def _through_rows(
        self, group: Group, accepted: Array, ends: list[Array], dense_info: Any, bars: Bars
    ) -> tuple[Bars, Any]:
        """The values saved in a step."""
        info, layout = columns_of_values(dense_info, self.lanes), Layout.of(dense_info)
        time = Layout.of(self.ends.start.tprev[0])
        direction = self._column(self._call(self.functions.direction, group))
        at = lambda row: self.ts.astype(ends[0].dtype)[jnp.maximum(row, 0)] * direction
        due = lambda row: accepted & (row >= 0) & (at(row) > ends[0])
        lane, dtypes = jnp.arange(group.index.size), self.y_layout.dtypes_of_columns()

        def through_row(carry: Any) -> Any:
            row, info_bar = carry
            here, place = due(row), jnp.maximum(row, 0)
            with self.lanes.inside():
                bar = unstacked({d: x[place, :, lane].T for d, x in group.at_times.items()}, dtypes)
                more = self._call(
                    self.functions.through_interpolated,
                    group,
                    *(time.values([x]) for x in (at(row), *ends)),
                    layout.values(info),
                    self.y_layout.values(bar),
                )
                more = columns_of_values(more, self.lanes)
                return row - here.astype(row.dtype), added(info_bar, more, here)

        start = bars.row, [jnp.zeros_like(x) for x in info]
        row, bar = lax.while_loop(lambda c: jnp.any(due(c[0])), through_row, start)
        return bars._replace(row=row), layout.values(bar)

    def _including(self, bars: Bars, active: Array, each: Any, common: Any) -> Bars:
        each, common = (columns_of_values(x, self.lanes) for x in (each, common))
        return bars._replace(
            each=added(bars.each, each, active), common=added(bars.common, common, active)
        )

    def _call(self, function: Callable, group: Group, *args: Any) -> Any:
        each, rest = self.each_layout.values(group.each), self.rest_layout.values(group.rest)
        return call_in_lanes(self.lanes, function, each, self.common, rest, *args)

    def _column(self, value: Any) -> Array:
        return columns_of_values(value, self.lanes)[0]
