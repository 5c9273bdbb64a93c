"""Hooks around steps that end on the manifold by themselves."""

from typing import Any, ClassVar

import jax.numpy as jnp

from .._base.types import Args, RealScalarLike, Y
from .._constraint.projection_info import ProjectionInfo
from .base import AbstractManifoldSolver
from .step.frame import StepFrame


class AbstractStepsOnManifold(AbstractManifoldSolver):
    """A hook that leaves the ends of steps as they are: a correction would add its own rounding errors,
    which no later step takes back. Values between the steps are corrected."""

    corrects_output: ClassVar[bool] = True

    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True)))
        return StepFrame.of_state(y0, terms, unchanged)
