"""The manifold of a model: constraints on coordinates, and constraints that are linear in the speeds."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint, Constraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .function import SymbolicFunction


class SymbolicConstraint(AbstractConstraint):
    """`f(t, q) = 0` and `B(t, q) u + c(t, q) = 0`, built by `from_sympy`.

    Corrections move first the coordinates and then the speeds, at the corrected coordinates, which is a linear
    problem: the derivative of the second equations by the coordinates is never formed.
    """

    positions: SymbolicFunction | None
    velocities: SymbolicFunction
    redundant: ClassVar[bool] = False

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Any:
        (velocities,) = self.velocities(t, y, args)
        if self.positions is None:
            return (velocities,)
        return *self.positions(t, y, args), velocities

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Y, ProjectionInfo]:
        if directions is not None:  # those of the whole state
            return super().correct(
                projection, t, y, args, fallback=fallback, far=far, directions=directions
            )
        q, u = y
        safe_q, safe_u = y if fallback is None else fallback
        of_q, of_u = _projections(projection, y)
        infos = []
        if self.positions is not None:
            equations = Constraint(_OfCoordinates(self.positions))
            q, info = equations.correct(of_q, t, q, args, fallback=safe_q, far=far)
            infos.append(info)
            # Not NaN: the derivative of the next equations by it would not be zero.
            q = jnp.where(info.success, q, safe_q)
        equations = Constraint(_OfSpeeds(self.velocities))
        u, info = equations.correct(of_u, t, u, (q, args), fallback=safe_u, far=far)
        return (q, u), ProjectionInfo.of_parts(*infos, info)


class _OfCoordinates(eqx.Module):
    function: SymbolicFunction

    def __call__(self, t: RealScalarLike, q: Y, args: Args) -> jax.Array:
        return self.function(t, (q, jnp.zeros(self.function.sizes[1], q.dtype)), args)[0]


class _OfSpeeds(eqx.Module):
    function: SymbolicFunction

    def __call__(self, t: RealScalarLike, u: Y, held: tuple[Y, Args]) -> jax.Array:
        q, args = held
        return self.function(t, (q, u), args)[0]


def _projections(projection: NewtonProjection, y: Y) -> tuple[NewtonProjection, NewtonProjection]:
    """Return the projections of coordinates and speeds, each with its part of the metric."""
    metric = projection.metric
    if metric is None or isinstance(metric, str):
        return projection, projection
    if jtu.tree_structure(metric) != jtu.tree_structure(y):
        projection.inverse_metric(y)  # raises
    of_part = lambda metric: dataclasses.replace(projection, metric=metric)
    return of_part(metric[0]), of_part(metric[1])
