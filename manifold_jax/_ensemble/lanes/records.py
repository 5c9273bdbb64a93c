"""What the reverse sweep of an ensemble begins with, carries along, and keeps of the forward one."""

from typing import Any, NamedTuple

from jaxtyping import Array

from .columns import stacked
from .trajectory import Trajectory


class Ends(NamedTuple):
    """The ends of all trajectories, in front of every array: the states they begin with, numbers
    of steps and of
    saved rows, and the table of states there (see [`Run`][]); cotangents of the first and the last
    states and of the values at `ts`."""

    start: Trajectory
    num_steps: Array
    rows: Array
    states: dict[str, Array]
    first_bar: Any
    last_bar: Any
    values_bar: Any


class Group(NamedTuple):
    """Columns of those that go together: which they are, and whether anything depends on them; the
    cotangents of their states at `ts`, time by time."""

    index: Array
    present: Array
    each: list[Array]
    rest: list[Array]
    at_times: dict[str, Array]


class Bars(NamedTuple):
    """Columns of cotangents so far, of the state and of what steps depend on; which of the times to
    save at is the last one still to come."""

    state: list[Array]
    each: list[Array]
    common: list[Array]
    row: Array


class Record(NamedTuple):
    """A record of the steps of a segment: where they begin and end, from which state; which were
    accepted."""

    steps: dict[str, Array]
    accepted: Array

    def with_row(self, row: Array, columns: list[Array], accepted: Array) -> "Record":
        new = stacked(columns)
        steps = {dtype: x.at[row].set(new[dtype]) for dtype, x in self.steps.items()}
        return Record(steps, self.accepted.at[row].set(accepted))
