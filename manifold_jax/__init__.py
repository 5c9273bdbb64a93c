"""Differential equations on manifolds, for JAX and Diffrax."""

from importlib.metadata import version

from ._adjoint import StepReplayAdjoint as StepReplayAdjoint
from ._applications import (
    ConstrainedMinimum as ConstrainedMinimum,
    CurveTrace as CurveTrace,
    gradient_flow as gradient_flow,
    Linearization as Linearization,
    linearize as linearize,
    OptimalTrajectory as OptimalTrajectory,
    optimize_trajectory as optimize_trajectory,
    regulate as regulate,
    Regulator as Regulator,
    trace_curve as trace_curve,
)
from ._constraint.constraint import (
    AbstractConstraint as AbstractConstraint,
    Constraint as Constraint,
    Invariants as Invariants,
)
from ._constraint.correction import ConstraintNormals as ConstraintNormals
from ._constraint.project import consistent_state as consistent_state, project as project
from ._constraint.projection_info import ProjectionInfo as ProjectionInfo
from ._constraint.settings import NewtonProjection as NewtonProjection
from ._constraint.violation import constraint_violation as constraint_violation
from ._dae import DAEReport as DAEReport, reduce_dae as reduce_dae, ReducedDAE as ReducedDAE
from ._ensemble import (
    EnsembleSolution as EnsembleSolution,
    open_ensemble as open_ensemble,
    StoredEnsemble as StoredEnsemble,
)
from ._ensemble.api.solve_ensemble import solve_ensemble as solve_ensemble
from ._ensemble.api.stream_ensemble import stream_ensemble as stream_ensemble
from ._fit import FitResult as FitResult
from ._fit.fit import fit as fit
from ._mechanics import (
    Baumgarte as Baumgarte,
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
    impact as impact,
    MechanicalSystem as MechanicalSystem,
    rattle as rattle,
    VelocityStabilization as VelocityStabilization,
)
from ._radau import RadauIIA5 as RadauIIA5
from ._resets.record import Resets as Resets
from ._resets.reset import Reset as Reset, ResetAt as ResetAt
from ._rosenbrock import MassMatrixTerm as MassMatrixTerm, Rodas3P as Rodas3P, Rodas5P as Rodas5P
from ._solve.diffeqsolve import diffeqsolve as diffeqsolve
from ._solve.solution import Solution as Solution
from ._solver import (
    AbstractManifoldSolver as AbstractManifoldSolver,
    LocalCoordinates as LocalCoordinates,
    Projected as Projected,
    Relaxation as Relaxation,
    Stabilized as Stabilized,
    StepFrame as StepFrame,
    SymmetricProjection as SymmetricProjection,
)
from ._solver.chart import (
    AbstractChart as AbstractChart,
    AbstractCoordinates as AbstractCoordinates,
    CoordinatePartitionChart as CoordinatePartitionChart,
    TangentSpaceChart as TangentSpaceChart,
)
from ._solver.stabilization import (
    AbstractStabilization as AbstractStabilization,
    ExactStabilization as ExactStabilization,
    InvariantStabilization as InvariantStabilization,
)
from ._solver.tangent import tangent_field as tangent_field
from ._sympy import from_sympy as from_sympy, SymbolicSystem as SymbolicSystem


# isort: split
# These use only the public names above, as extensions of others do.
from ._lie_groups import (
    AbstractLieGroup as AbstractLieGroup,
    LieGroupChart as LieGroupChart,
    SE3 as SE3,
    SO3 as SO3,
    UnitQuaternion as UnitQuaternion,
)
from ._manifolds import Product as Product, Sphere as Sphere, Stiefel as Stiefel


# isort: split
from . import multibody as multibody, problems as problems
from ._base.docstrings import unlink_docstrings as _unlink_docstrings


__version__ = version("manifold_jax")
_unlink_docstrings(globals(), vars(multibody), vars(problems))
