"""Functions of small arrays as arithmetic on one number at a time, of many trajectories at once."""

from .interpret import call_in_lanes as call_in_lanes
from .lanes import NotScalarError as NotScalarError
from .value import Value as Value
