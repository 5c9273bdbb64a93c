"""What the reverse sweep of an ensemble begins with, carries along, and keeps of the forward one."""

from typing import Any, NamedTuple

from jaxtyping import Array

from ..._jaxpr.lane_value import Columns
from .columns import Stacked
from .trajectory import Trajectory


class Ends(NamedTuple):
    """The ends of all trajectories, in front of every array: the states they begin with, numbers
    of steps and of saved rows, and the table of states there (see [`Run`][]); cotangents of the
    first and the last states and of the values at `ts`."""

    start: Trajectory
    num_steps: Array
    rows: Array
    states: Stacked | None
    first_bar: Any
    last_bar: Any
    values_bar: Any


class Group(NamedTuple):
    """Those that go together: which they are, and whether anything depends on them; what they are
    given; the cotangents of their states at `ts`, time by time."""

    index: Array
    present: Array
    each: Columns
    rest: Columns
    at_times: Stacked | None


class Bars(NamedTuple):
    """Cotangents so far, of the state and of what steps depend on; which of the times to save at is
    the last one still to come."""

    state: Columns
    each: Columns
    common: Columns
    row: Array


class Record(NamedTuple):
    """The steps of a segment: where they begin and end, from which state; which were accepted."""

    steps: Stacked
    accepted: Array
