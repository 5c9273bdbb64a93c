"""Many trajectories in a few lanes: a lane whose trajectory has ended takes the next one."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from ..._jaxpr.lane_arrays import Lanes
from ..._jaxpr.lane_interpreter import call_in_lanes
from ..._jaxpr.lane_value import columns_of_values, Layout
from .columns import (
    columns_of_arrays,
    empty_table,
    read,
    taken,
    where,
    written,
)
from .trajectory import Start


# Steps between two looks at which lanes have ended. A lane waits half of them on average.
_STEPS = 8


class Lane(NamedTuple):
    """Columns of all lanes: which trajectory each has, its own data and state, and the next time to
    save at."""

    number: Array
    given: list[Array]
    state: list[Array]
    row: Array


class Totals(NamedTuple):
    """What is known of all trajectories: columns of the outcomes so far, how many times to save at
    were reached, and
    the table of states there; the next trajectory to take, and how many have ended."""

    outcomes: list[Array]
    rows: Array
    states: dict[str, Array]
    next: Array
    ended: Array


class Run(NamedTuple):
    """All trajectories, in front of every array. How many of the times to save at each has reached; the
    states there, as they were interpolated (a table, in its rows the times of one trajectory after
    those of the other), what was returned, and whether some of it could not be corrected."""

    start: Any  # `Start` and `Outcome`, or what the equations have in their place
    outcome: Any
    rows: Array
    states: dict[str, Array]
    values: Any
    failed: Array


class Schedule:
    """`equations` are [`Equations`][], or have their methods; `given` is what each trajectory has of
    its own, the trajectories in front of every array; `complete` makes of that of one what the
    methods are given."""

    def __init__(self, equations: Any, given: Any, complete: Any, lanes: int, limit: int):
        self.equations, self.complete = equations, complete
        self.size = jtu.tree_leaves(given)[0].shape[0]
        self.count = min(lanes, self.size)
        self.lanes = Lanes(self.count, limit)
        self.given = columns_of_arrays(given)
        self.given_layout = Layout.of_one(given)
        self.ts = equations.saveat.subs.ts

    def run(self) -> Run:
        starts, corrections, state_layout = self._starts()
        first = jnp.arange(self.count)
        row = jnp.zeros(self.count, int)
        lane = Lane(first, taken(self.given, first), taken(starts, first), row)
        outcome_layout, y_layout = self._layouts(state_layout)
        unknown = empty_table(outcome_layout, self.size)
        totals = Totals(
            read(unknown, jnp.arange(self.size), outcome_layout.dtypes_of_columns()),
            jnp.zeros(self.size, int),
            {} if self.ts is None else empty_table(y_layout, self.size * self.ts.size),
            jnp.asarray(self.count),
            jnp.asarray(0),
        )

        def advance(carry: tuple[Lane, Totals]) -> tuple[Lane, Totals]:
            with self.lanes.inside():
                lane, totals = carry
                step = lambda carry, _: (self._step(carry[0], carry[1], state_layout), None)
                (lane, states), _ = lax.scan(step, (lane, totals.states), None, length=_STEPS)
                return self._refill(lane, totals._replace(states=states), starts, state_layout)

        _, totals = lax.while_loop(lambda c: c[1].ended < self.size, advance, (lane, totals))
        start = Start(state_layout.arrays(starts), corrections)
        values, failed = None, jnp.zeros(self.size, bool)
        if self.ts is not None:
            firsts = columns_of_arrays(self.equations.state_of(start.trajectory))
            values, failed = self._handed_out(totals, firsts, y_layout)
        outcome = outcome_layout.arrays(totals.outcomes)
        return Run(start, outcome, totals.rows, totals.states, values, failed)

    def _call(self, function: Any, given: list[Array], *args: Any) -> Any:
        of_each = self.given_layout.values(given)
        call = lambda of_each, *args: function(self.complete(of_each), *args)
        return call_in_lanes(self.lanes, call, of_each, *args)

    def _starts(self) -> tuple[list[Array], Array, Layout]:
        """Columns of the first states of all trajectories."""
        layout = None

        def begin(index: Array) -> tuple[list[Array], list[Array]]:
            nonlocal layout
            given = taken(self.given, index)
            with self.lanes.inside(given[0]):
                start = self._call(self.equations.begin, given)
                layout = Layout.of(start.trajectory)
                columns = columns_of_values(start.trajectory, self.lanes)
                return columns, columns_of_values(start.correction, self.lanes)

        pieces = -(-self.size // self.count)
        index = jnp.minimum(jnp.arange(pieces * self.count), self.size - 1)
        starts, (correction,) = lax.map(begin, index.reshape(pieces, self.count))
        flat = lambda x: x.reshape(-1)[: self.size]
        return [flat(x) for x in starts], flat(correction), layout  # pyright: ignore[reportReturnType]

    def _layouts(self, state_layout: Layout) -> tuple[Layout, Layout]:
        """Return the layouts of outcomes and of states."""
        given, trajectory = self.given_layout.example(), state_layout.example()
        outcome = lambda given, trajectory: self.equations.outcome(self.complete(given), trajectory)
        outcomes = Layout.of(jax.eval_shape(outcome, given, trajectory))
        return outcomes, Layout.of(self.equations.state_of(trajectory))

    def _layout_of_values(self, y_layout: Layout) -> Layout:
        value = lambda given, t, y: self.equations.saved_value(self.complete(given), t, y)[0]
        given, y = self.given_layout.example(), y_layout.example()
        return Layout.of(jax.eval_shape(value, given, self.ts[0], y))

    def _handed_out(
        self, totals: Totals, firsts: list[Array], y_layout: Layout
    ) -> tuple[Any, Array]:
        """What is saved of the states, time by time; lanes go together."""
        times, layout = self.ts.size, self._layout_of_values(y_layout)

        def of_lanes(index: Array) -> tuple[Array, list[Array]]:
            given, first, rows = taken(self.given, index), taken(firsts, index), totals.rows[index]

            def at_time(failed: Array, row: Array) -> tuple[Array, list[Array]]:
                reached = row < rows
                with self.lanes.inside(first[0]):
                    y = read(totals.states, index * times + row, y_layout.dtypes_of_columns())
                    y = y_layout.values(where(reached, y, first))
                    t = Layout.of(self.ts[0]).values(
                        [jnp.broadcast_to(self.ts[row], reached.shape)]
                    )
                    value, success = self._call(self.equations.saved_value, given, t, y)
                    failed |= reached & ~_column(success, self.lanes)
                    return failed, columns_of_values(value, self.lanes)

            failed, columns = lax.scan(at_time, jnp.zeros(index.shape, bool), jnp.arange(times))
            unreached = jnp.arange(times)[:, None] >= rows[None]
            return failed, [_without(x, unreached) for x in columns]

        pieces = -(-self.size // self.count)
        index = jnp.minimum(jnp.arange(pieces * self.count), self.size - 1)
        failed, columns = lax.map(of_lanes, index.reshape(pieces, self.count))
        by_trajectory = lambda x: jnp.swapaxes(x, 1, 2).reshape(-1, times)[: self.size].ravel()
        values = layout.arrays([by_trajectory(x) for x in columns])
        values = jtu.tree_map(lambda x: x.reshape(self.size, times, *x.shape[1:]), values)
        return values, failed.ravel()[: self.size]

    def _step(
        self, lane: Lane, states: dict[str, Array], layout: Layout
    ) -> tuple[Lane, dict[str, Array]]:
        with self.lanes.inside(lane.state[0]):
            state = layout.values(lane.state)

            def attempt(given: Any, trajectory: Any) -> tuple[Any, Any]:
                goes_on = self.equations.goes_on(given, trajectory)
                return goes_on, self.equations.attempt(given, trajectory)

            goes_on, tried = self._call(attempt, lane.given, state)
            active = _column(goes_on, self.lanes) & (lane.number < self.size)
            after = columns_of_values(tried.trajectory, self.lanes)
            if self.ts is not None:
                lane, states = self._save(lane, states, tried, active)
            return lane._replace(state=where(active, after, lane.state)), states

    def _save(
        self, lane: Lane, states: dict[str, Array], tried: Any, active: Array
    ) -> tuple[Lane, dict[str, Array]]:
        """States at the times in this step. What takes long, their correction, is left for later: here it
        would be done for all lanes whenever one of them has something to save."""
        kept = active & _column(tried.kept, self.lanes)
        end, start = _column(tried.end, self.lanes), _column(tried.start, self.lanes)
        info_layout = Layout.of(tried.dense_info)
        info = columns_of_values(tried.dense_info, self.lanes)
        direction = _column(self._call(lambda given: given.direction, lane.given), self.lanes)
        rows, time = self.ts.size, Layout.of(tried.end)
        at = lambda row: self.ts[jnp.minimum(row, rows - 1)] * direction
        due = lambda row: kept & (row < rows) & (at(row) <= end)

        def save(carry: Any) -> Any:
            row, states = carry
            here = due(row)
            with self.lanes.inside():
                times = (time.values([x]) for x in (at(row), start, end))
                interpolated = self.equations.interpolated
                y = call_in_lanes(self.lanes, interpolated, *times, info_layout.values(info))
                columns = columns_of_values(y, self.lanes)
            place = jnp.where(here, lane.number * rows + row, self.size * rows)
            return row + here.astype(row.dtype), written(states, place, columns)

        row, states = lax.while_loop(lambda c: jnp.any(due(c[0])), save, (lane.row, states))
        return lane._replace(row=row), states

    def _refill(
        self, lane: Lane, totals: Totals, starts: list[Array], layout: Layout
    ) -> tuple[Lane, Totals]:
        state = layout.values(lane.state)
        goes_on = _column(self._call(self.equations.goes_on, lane.given, state), self.lanes)
        ended = ~goes_on & (lane.number < self.size)
        outcome = self._call(self.equations.outcome, lane.given, state)
        place = jnp.where(ended, lane.number, self.size)
        outcomes = [
            o.at[place].set(x, mode="drop")
            for o, x in zip(totals.outcomes, columns_of_values(outcome, self.lanes), strict=True)
        ]
        rows = totals.rows.at[place].set(lane.row, mode="drop")
        number = jnp.where(ended, totals.next + jnp.cumsum(ended) - 1, lane.number)
        number = jnp.minimum(number, self.size)
        fresh = ended & (number < self.size)
        index = jnp.where(fresh, number, 0)
        lane = Lane(
            number,
            where(fresh, taken(self.given, index), lane.given),
            where(fresh, taken(starts, index), lane.state),
            jnp.where(fresh, 0, lane.row),
        )
        count = jnp.sum(ended)
        return lane, Totals(
            outcomes, rows, totals.states, totals.next + count, totals.ended + count
        )


def _column(value: Any, lanes: Lanes) -> Array:
    return columns_of_values(value, lanes)[0]


def _without(x: Array, unreached: Array) -> Array:
    unknown = jnp.inf if jnp.issubdtype(x.dtype, jnp.floating) else 0
    return jnp.where(unreached, jnp.asarray(unknown, x.dtype), x)
