from .curve import CurveTrace as CurveTrace, trace_curve as trace_curve
from .linearization import Linearization as Linearization, linearize as linearize
from .optimization import ConstrainedMinimum as ConstrainedMinimum, gradient_flow as gradient_flow
from .regulation import regulate as regulate, Regulator as Regulator
from .trajectory import (
    OptimalTrajectory as OptimalTrajectory,
    optimize_trajectory as optimize_trajectory,
)
