"""A hook without a constraint: steps are not changed."""

from typing import Any, ClassVar

import diffrax as dfx
import jax.numpy as jnp

from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import NoConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver
from .step.frame import StepFrame


class Unconstrained(AbstractManifoldSolver):
    """A method without a constraint: nothing is corrected, and no step is rejected that the method
    itself accepts. An explicit Runge-Kutta method, or a Rosenbrock method without a mass matrix."""

    inner: dfx.AbstractSolver
    constraint: NoConstraint
    projection: NewtonProjection
    corrects_output: ClassVar[bool] = False

    def __init__(self, solver: dfx.AbstractSolver):
        self.inner = solver
        self.constraint = NoConstraint()
        self.projection = NewtonProjection()
        self.bends_interpolant = self.bounds_error = False
        self.state_of_coordinates = None

    def prepare_terms(self, terms: Any) -> Any:
        return terms

    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True)))
        return StepFrame.of_state(y0, terms, unchanged)
