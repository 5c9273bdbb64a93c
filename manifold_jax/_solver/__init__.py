from .base import AbstractManifoldSolver as AbstractManifoldSolver
from .local_coordinates import LocalCoordinates as LocalCoordinates
from .projected import Projected as Projected
from .relaxation import Relaxation as Relaxation
from .stabilized import Stabilized as Stabilized
from .step.frame import StepFrame as StepFrame
from .symmetric import SymmetricProjection as SymmetricProjection
