"""Many trajectories in a few lanes: a lane whose trajectory has ended takes the next one."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from ..._jaxpr.lane_arrays import Lanes
from ..._jaxpr.lane_interpreter import call_in_lanes
from ..._jaxpr.lane_value import ColumnLayout, Columns, LaneValue, where
from .columns import empty_table, read, Stacked, taken, unknown, written
from .trajectory import LaneStart


# Number of steps between refills of the lanes that have ended. A lane waits half of them on average.
_STEPS_BETWEEN_REFILLS = 8


class Slots(NamedTuple):
    """The contents of the lanes: the number of the trajectory in each, its own data and state, and the next
    time to save at."""

    number: Array
    given: Columns
    state: Columns
    row: Array


class Totals(NamedTuple):
    """Results of all trajectories so far: the outcomes, how many times to save at were reached, and the
    table of states there; the next trajectory to take, and how many have ended."""

    outcomes: Columns
    rows: Array
    states: Stacked | None
    next: Array
    ended: Array


class LaneRun(NamedTuple):
    """The results of all trajectories, which are the leading axis of every array. `rows`: how many of
    the times to save at each has reached. `states`: a table of the interpolated states there,
    trajectory after trajectory, with a row for each time. `values`: their saved values, `failed`:
    whether any of these could not be corrected."""

    start: Any  # `LaneStart` and `LaneOutcome`, or those of other `equations`
    outcome: Any
    rows: Array
    states: Stacked | None
    values: Any
    failed: Array


class Schedule:
    """Runs all trajectories.

    - `equations`: [`LaneEquations`][], or an object with the same methods.
    - `given`: the data that each trajectory has of its own, with the trajectories in front.
    - `complete`: maps the data of one trajectory to the first argument of these methods.
    """

    def __init__(self, equations: Any, given: Any, complete: Any, limit: int):
        self.equations, self.complete = equations, complete
        self.size = jtu.tree_leaves(given)[0].shape[0]
        self.count = min(equations.lanes, self.size)
        self.lanes = Lanes(self.count, limit)
        self.given = Columns.of_arrays(given)
        self.ts = equations.saveat.subs.ts

    def run(self) -> LaneRun:
        flat = lambda x: x.reshape(-1)[: self.size]
        starts, corrections = jtu.tree_map(flat, self._of_all(self._begin))
        first = jnp.arange(self.count)
        given, state = taken((self.given, starts), first)
        lane = Slots(first, given, state, jnp.zeros(self.count, int))
        outcome_layout, y_layout = self._layouts(starts.layout)
        empty = [jnp.full(self.size, unknown(d), d) for d in outcome_layout.dtypes_of_columns()]
        totals = Totals(
            Columns(empty, outcome_layout),
            jnp.zeros(self.size, int),
            None if self.ts is None else empty_table(y_layout, self.size * self.ts.size),
            jnp.asarray(self.count),
            jnp.asarray(0),
        )

        def advance(carry: tuple[Slots, Totals]) -> tuple[Slots, Totals]:
            with self.lanes.inside():
                lane, totals = carry
                step = lambda carry, _: (self._step(*carry), None)
                (lane, states), _ = lax.scan(
                    step, (lane, totals.states), None, length=_STEPS_BETWEEN_REFILLS
                )
                return self._refill(lane, totals._replace(states=states), starts)

        _, totals = lax.while_loop(lambda c: c[1].ended < self.size, advance, (lane, totals))
        start = LaneStart(starts.arrays(), corrections.arrays())
        values, failed = None, jnp.zeros(self.size, bool)
        if totals.states is not None:
            firsts = Columns.of_arrays(self.equations.state_of(start.trajectory))
            values, failed = self._handed_out(totals.rows, totals.states, firsts)
        return LaneRun(start, totals.outcomes.arrays(), totals.rows, totals.states, values, failed)

    def _call(self, function: Any, given: Columns, *args: Any) -> Any:
        call = lambda of_each, *args: function(self.complete(of_each), *args)
        return call_in_lanes(self.lanes, call, given.values(), *args)

    def _column(self, value: LaneValue) -> Array:
        return value.columns(self.lanes)[0]

    def _of_all(self, function: Callable) -> Any:
        """Return `function(index)` for all trajectories, as many of them at a time as there are lanes."""
        pieces = -(-self.size // self.count)
        index = jnp.minimum(jnp.arange(pieces * self.count), self.size - 1)
        return lax.map(function, index.reshape(pieces, self.count))

    def _begin(self, index: Array) -> list[Columns]:
        given = taken(self.given, index)
        with self.lanes.inside(given.columns[0]):
            start = self._call(self.equations.begin, given)
            return [Columns.of_values(x, self.lanes) for x in start]

    def _layouts(self, state_layout: ColumnLayout) -> tuple[ColumnLayout, ColumnLayout]:
        """Return the layouts of outcomes and of states."""
        given, trajectory = self.given.layout.example(), state_layout.example()
        outcome = lambda given, trajectory: self.equations.outcome(self.complete(given), trajectory)
        outcomes = ColumnLayout.of(jax.eval_shape(outcome, given, trajectory))
        return outcomes, ColumnLayout.of(self.equations.state_of(trajectory))

    def _handed_out(self, rows: Array, states: Stacked, firsts: Columns) -> tuple[Any, Array]:
        """Return the saved values of the states, time by time, and whether any could not be corrected."""
        times = self.ts.size

        def of_lanes(index: Array) -> tuple[Array, Columns]:
            given, first, num_rows = taken((self.given, firsts, rows), index)

            def at_time(failed: Array, row: Array) -> tuple[Array, Columns]:
                reached = row < num_rows
                with self.lanes.inside(first.columns[0]):
                    y = where(reached, read(states, index * times + row), first).values()
                    t = LaneValue.of_column(jnp.broadcast_to(self.ts[row], reached.shape))
                    value, success = self._call(self.equations.saved_value, given, t, y)
                    failed |= reached & ~self._column(success)
                    return failed, Columns.of_values(value, self.lanes)

            failed, values = lax.scan(at_time, jnp.zeros(index.shape, bool), jnp.arange(times))
            unreached = jnp.arange(times)[:, None] >= num_rows[None]
            without = lambda x: jnp.where(unreached, jnp.asarray(unknown(x.dtype), x.dtype), x)
            return failed, jtu.tree_map(without, values)

        failed, values = self._of_all(of_lanes)
        by_trajectory = lambda x: jnp.swapaxes(x, 1, 2).reshape(-1, times)[: self.size].ravel()
        values = jtu.tree_map(by_trajectory, values).arrays()
        values = jtu.tree_map(lambda x: x.reshape(self.size, times, *x.shape[1:]), values)
        return values, failed.ravel()[: self.size]

    def _step(self, lane: Slots, states: Stacked | None) -> tuple[Slots, Stacked | None]:
        with self.lanes.inside(lane.state.columns[0]):

            def attempt(given: Any, trajectory: Any) -> tuple[Any, Any]:
                goes_on = self.equations.goes_on(given, trajectory)
                return goes_on, self.equations.attempt(given, trajectory)

            goes_on, tried = self._call(attempt, lane.given, lane.state.values())
            active = self._column(goes_on) & (lane.number < self.size)
            after = Columns.of_values(tried.trajectory, self.lanes)
            if states is not None:
                lane, states = self._save(lane, states, tried, active)
            return lane._replace(state=where(active, after, lane.state)), states

    def _save(
        self, lane: Slots, states: Stacked, tried: Any, active: Array
    ) -> tuple[Slots, Stacked]:
        """Save the interpolated states at the times in this step. Their correction is expensive and
        left for later: here it would be done for all lanes whenever one of them has something to save."""
        kept = active & self._column(tried.kept)
        end, start = self._column(tried.end), self._column(tried.start)
        info = Columns.of_values(tried.dense_info, self.lanes)
        direction = self._column(self._call(lambda given: given.direction, lane.given))
        rows = self.ts.size
        at = lambda row: self.ts[jnp.minimum(row, rows - 1)] * direction
        due = lambda row: kept & (row < rows) & (at(row) <= end)

        def save(carry: tuple[Array, Stacked]) -> tuple[Array, Stacked]:
            row, states = carry
            here = due(row)
            with self.lanes.inside():
                times = map(LaneValue.of_column, (at(row), start, end))
                interpolated = self.equations.interpolated
                y = call_in_lanes(self.lanes, interpolated, *times, info.values())
                y = Columns.of_values(y, self.lanes)
            place = jnp.where(here, lane.number * rows + row, self.size * rows)
            return row + here.astype(row.dtype), written(states, place, y)

        row, states = lax.while_loop(lambda c: jnp.any(due(c[0])), save, (lane.row, states))
        return lane._replace(row=row), states

    def _refill(self, lane: Slots, totals: Totals, starts: Columns) -> tuple[Slots, Totals]:
        state = lane.state.values()
        goes_on = self._column(self._call(self.equations.goes_on, lane.given, state))
        ended = ~goes_on & (lane.number < self.size)
        outcome = self._call(self.equations.outcome, lane.given, state)
        place = jnp.where(ended, lane.number, self.size)
        write = lambda total, x: total.at[place].set(x, mode="drop")
        outcomes = jtu.tree_map(write, totals.outcomes, Columns.of_values(outcome, self.lanes))
        rows = write(totals.rows, lane.row)
        number = jnp.where(ended, totals.next + jnp.cumsum(ended) - 1, lane.number)
        number = jnp.minimum(number, self.size)
        fresh = ended & (number < self.size)
        following = taken((self.given, starts), jnp.where(fresh, number, 0))
        given, state = where(fresh, following, (lane.given, lane.state))
        lane = Slots(number, given, state, jnp.where(fresh, 0, lane.row))
        count = jnp.sum(ended)
        return lane, Totals(
            outcomes, rows, totals.states, totals.next + count, totals.ended + count
        )
