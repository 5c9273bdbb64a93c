"""Differential equations on manifolds, for JAX and Diffrax."""

from importlib.metadata import version

from . import problems as problems
from ._constraint import (
    Constraint as Constraint,
    constraint_violation as constraint_violation,
    Invariants as Invariants,
)
from ._diffeqsolve import diffeqsolve as diffeqsolve
from ._initial import consistent_state as consistent_state
from ._projection import (
    NewtonProjection as NewtonProjection,
    project as project,
    ProjectionInfo as ProjectionInfo,
)
from ._solver import Projected as Projected


__version__ = version("manifold_jax")
