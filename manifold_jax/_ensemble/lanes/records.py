"""The data of the reverse sweep of an ensemble."""

from typing import Any, NamedTuple

from jaxtyping import Array

from ..._jaxpr.lane_value import Columns
from .columns import Stacked
from .trajectory import Trajectory


class LaneEnds(NamedTuple):
    """Starts and ends of all `N` trajectories, which are the leading axis of every array."""

    start: Trajectory
    num_steps: Array
    rows: Array  # how many of the times to save at each has reached
    states: Stacked | None  # the states at these times, a table (see [`LaneRun`][])
    first_bar: Any  # cotangents of the first and the last states, and of the values at `ts`
    last_bar: Any
    values_bar: Any


class Group(NamedTuple):
    """The trajectories that go back together, one in each lane."""

    index: Array  # (lanes,)
    present: Array  # whether there is one, with a cotangent other than zero
    each: Columns  # its own data that are differentiated
    rest: Columns  # those that are not
    at_times: Stacked | None  # cotangents of its states at `ts`, with the times in front


class InputBars(NamedTuple):
    """Cotangents of the differentiated inputs: of each trajectory, and common to all."""

    each: Any
    common: Any


class Bars(NamedTuple):
    """The cotangents so far, of the state and of the inputs."""

    state: Columns
    each: Columns
    common: Columns
    row: Array  # the last of the times to save at that is still to come


class LaneRecord(NamedTuple):
    """The steps of a segment, which are the leading axis of every array."""

    steps: Stacked  # their start and end times, and the states before them
    accepted: Array  # (steps, lanes)
