"""Many trajectories in a few lanes: a lane whose trajectory has ended takes the next one."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from .._scalar import call_in_lanes, example, Lanes
from .columns import columns_of_arrays, columns_of_values, Layout, taken, where
from .trajectory import Start


# Steps between two looks at which lanes have ended. A lane waits half of them on average.
_STEPS = 8


class Lane(NamedTuple):
    """Columns of all lanes: which trajectory each has, its own data and state, the next time to save
    at, and whether a value could not be corrected."""

    number: Array
    given: list[Array]
    state: list[Array]
    row: Array
    failed: Array


class Totals(NamedTuple):
    """Columns of all trajectories: the outcomes so far, how many rows were saved, and which; the
    next trajectory to take, and how many have ended."""

    outcomes: list[Array]
    rows: Array
    saved: list[Array]
    next: Array
    ended: Array


class Run(NamedTuple):
    """All trajectories, in front of every array. How many rows of `values`, those at `ts`, each
    has reached."""

    start: Any  # `Start` and `Outcome`, or what the equations have in their place
    outcome: Any
    rows: Array
    values: Any


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
        self.given_layout = Layout.of(jtu.tree_map(lambda x: example(x.shape[1:], x.dtype), given))
        self.ts = equations.saveat.subs.ts

    def run(self) -> Run:
        starts, corrections, state_layout = self._starts()
        first = jnp.arange(self.count)
        lane = Lane(
            first,
            taken(self.given, first),
            taken(starts, first),
            jnp.zeros(self.count, int),
            jnp.zeros(self.count, bool),
        )
        outcome_layout, saved_layout = self._layouts(state_layout)
        empty = lambda layout, rows: [
            jnp.full(rows, jnp.inf if jnp.issubdtype(dtype, jnp.floating) else 0, dtype)
            for shape, dtype in zip(layout.shapes, layout.dtypes, strict=True)
            for _ in range(_size(shape))
        ]
        num_times = 0 if self.ts is None else self.ts.size
        saved = empty(saved_layout, self.size * num_times) if num_times else []
        totals = Totals(
            empty(outcome_layout, self.size),
            jnp.zeros(self.size, int),
            saved,
            jnp.asarray(self.count),
            jnp.asarray(0),
        )

        def advance(carry: tuple[Lane, Totals]) -> tuple[Lane, Totals]:
            with self.lanes.inside():
                lane, totals = carry
                step = lambda carry, _: (self._step(*carry, state_layout), None)  # pyright: ignore[reportCallIssue]
                (lane, saved), _ = lax.scan(step, (lane, totals.saved), None, length=_STEPS)
                return self._refill(lane, totals._replace(saved=saved), starts, state_layout)

        _, totals = lax.while_loop(lambda c: c[1].ended < self.size, advance, (lane, totals))
        values = None
        if num_times:
            values = jtu.tree_map(
                lambda x: x.reshape(self.size, num_times, *x.shape[1:]),
                saved_layout.arrays(totals.saved),  # pyright: ignore[reportOptionalMemberAccess]
            )
        start = Start(state_layout.arrays(starts), corrections)
        return Run(start, outcome_layout.arrays(totals.outcomes), totals.rows, values)

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

    def _layouts(self, state_layout: Layout) -> tuple[Layout, Layout | None]:
        """Of outcomes and of saved values."""
        given, state = self.given_layout.example(), state_layout.example()

        def outcome(given, state):
            return self.equations.outcome(self.complete(given), state, jnp.asarray(False))

        def value(given, state):
            given = self.complete(given)
            attempt = self.equations.attempt(given, state)
            t = attempt.start
            return self.equations.value(given, t, t, attempt.end, attempt.dense_info)[0]

        outcomes = Layout.of(jax.eval_shape(outcome, given, state))
        if self.ts is None:
            return outcomes, None
        return outcomes, Layout.of(jax.eval_shape(value, given, state))

    def _step(self, lane: Lane, saved: list[Array], layout: Layout) -> tuple[Lane, list[Array]]:
        with self.lanes.inside(lane.state[0]):
            state = layout.values(lane.state)

            def attempt(given: Any, trajectory: Any) -> tuple[Any, Any]:
                goes_on = self.equations.goes_on(given, trajectory)
                return goes_on, self.equations.attempt(given, trajectory)

            goes_on, tried = self._call(attempt, lane.given, state)
            active = _column(goes_on, self.lanes) & (lane.number < self.size)
            after = columns_of_values(tried.trajectory, self.lanes)
            if self.ts is not None:
                lane, saved = self._save(lane, saved, tried, active)
            return lane._replace(state=where(active, after, lane.state)), saved

    def _save(
        self, lane: Lane, saved: list[Array], tried: Any, active: Array
    ) -> tuple[Lane, list[Array]]:
        kept = active & _column(tried.kept, self.lanes)
        end, start = _column(tried.end, self.lanes), _column(tried.start, self.lanes)
        info_layout = Layout.of(tried.dense_info)
        info = columns_of_values(tried.dense_info, self.lanes)
        direction = _column(self._call(lambda given: given.direction, lane.given), self.lanes)
        rows = self.ts.size

        def time(row: Array) -> Array:
            return self.ts[jnp.minimum(row, rows - 1)] * direction

        def due(row: Array) -> Array:
            return kept & (row < rows) & (time(row) <= end)

        def save(carry: Any) -> Any:
            row, failed, saved = carry
            here = due(row)
            with self.lanes.inside():
                wrap = Layout.of(tried.end).values
                value, success = self._call(
                    self.equations.value,
                    lane.given,
                    wrap([time(row)]),
                    wrap([start]),
                    wrap([end]),
                    info_layout.values(info),
                )
                columns = columns_of_values(value, self.lanes)
                failed = failed | (here & ~_column(success, self.lanes))
            place = jnp.where(here, lane.number * rows + row, self.size * rows)
            saved = [s.at[place].set(x, mode="drop") for s, x in zip(saved, columns, strict=True)]
            return row + here.astype(row.dtype), failed, saved

        row, failed, saved = lax.while_loop(
            lambda c: jnp.any(due(c[0])), save, (lane.row, lane.failed, saved)
        )
        return lane._replace(row=row, failed=failed), saved

    def _refill(
        self, lane: Lane, totals: Totals, starts: list[Array], layout: Layout
    ) -> tuple[Lane, Totals]:
        state, failed = layout.values(lane.state), Layout.of(jnp.asarray(False))
        goes_on = _column(self._call(self.equations.goes_on, lane.given, state), self.lanes)
        ended = ~goes_on & (lane.number < self.size)
        outcome = self._call(
            self.equations.outcome, lane.given, state, failed.values([lane.failed])
        )
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
            jnp.where(fresh, False, lane.failed),
        )
        count = jnp.sum(ended)
        return lane, Totals(outcomes, rows, totals.saved, totals.next + count, totals.ended + count)


def _column(value: Any, lanes: Lanes) -> Array:
    return columns_of_values(value, lanes)[0]


def _size(shape: tuple[int, ...]) -> int:
    size = 1
    for length in shape:
        size *= length
    return size
