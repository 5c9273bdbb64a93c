"""Functions of small arrays as arithmetic on one number at a time, of many trajectories at once."""

from .example import example as example
from .interpret import call_in_lanes as call_in_lanes
from .lanes import Lanes as Lanes, NotScalarError as NotScalarError
from .value import object_array as object_array, Value as Value
