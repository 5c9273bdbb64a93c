"""Differential equations on manifolds, for JAX and Diffrax."""

from importlib.metadata import version

from . import problems as problems
from ._adjoint import StepReplayAdjoint as StepReplayAdjoint
from ._applications import (
    ConstrainedMinimum as ConstrainedMinimum,
    CurveTrace as CurveTrace,
    gradient_flow as gradient_flow,
    trace_curve as trace_curve,
)
from ._chart import (
    CoordinatePartitionChart as CoordinatePartitionChart,
    TangentSpaceChart as TangentSpaceChart,
)
from ._constraint import (
    Constraint as Constraint,
    Invariants as Invariants,
)
from ._diffeqsolve import diffeqsolve as diffeqsolve
from ._fit import fit as fit, FitResult as FitResult
from ._initial import consistent_state as consistent_state
from ._mechanics import (
    Baumgarte as Baumgarte,
    MechanicalSystem as MechanicalSystem,
    VelocityStabilization as VelocityStabilization,
)
from ._projection import (
    NewtonProjection as NewtonProjection,
    project as project,
)
from ._projection_info import ProjectionInfo as ProjectionInfo
from ._solver import (
    LocalCoordinates as LocalCoordinates,
    Projected as Projected,
    Stabilized as Stabilized,
)
from ._stabilization import (
    ExactStabilization as ExactStabilization,
    InvariantStabilization as InvariantStabilization,
)
from ._tangent import tangent_field as tangent_field
from ._violation import constraint_violation as constraint_violation


__version__ = version("manifold_jax")
