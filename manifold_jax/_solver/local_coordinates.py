"""The parameterization approach: integrate in local coordinates on the manifold."""

from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.compat import is_sde, time_direction
from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver, check_hook_arguments, check_no_mass_matrix, check_noise
from .chart import AbstractChart, AbstractCoordinates, check_state_like, TangentSpaceChart
from .step.frame import StepFrame
from .step.implicit import with_accurate_stages
from .terms import rewrite_terms, RewrittenTerm


class LocalCoordinates(AbstractManifoldSolver):
    """Any one-step solver in local coordinates: every *stage* is on the manifold, not only
    every step (the paper's parameterization approach).

    At the beginning of each step a chart `x = lift(w)` is set up, `w' = f(t, lift(w))` is advanced by
    one step of the wrapped solver, and the result lifted. The order of the solver is preserved. Its
    error estimate is pushed forward to the state, so that the tolerances mean the same as for the other
    approaches. A stage that has no point on the manifold near it rejects the step.

    **Arguments:**

    - `solver`, `constraint`, `projection`: as for [`Projected`][]; the equations must be independent.
    - `chart`: [`TangentSpaceChart`][] (default) or [`CoordinatePartitionChart`][].

    **Raises:**

    As [`Projected`][], and `ValueError` for redundant constraints, which have no chart.

    Costs one Newton solve per stage; prefer [`Projected`][] unless the vector field cannot be
    evaluated off the manifold, or measurements say otherwise (`manifold-jax compare`).

    Source: Sudarsan & Keerthi (1998), section 3.2; Rheinboldt, Math. Comp. 43 (1984) 473-482.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
    chart: AbstractChart
    corrects_output: ClassVar[bool] = True

    def __init__(
        self,
        solver: dfx.AbstractSolver,
        constraint: AbstractConstraint,
        *,
        chart: AbstractChart | None = None,
        projection: NewtonProjection | None = None,
    ):
        check_hook_arguments(solver, constraint, "LocalCoordinates")
        chart = TangentSpaceChart() if chart is None else chart
        if not isinstance(chart, AbstractChart):
            raise TypeError(
                "`chart` must be `mj.TangentSpaceChart()` or `mj.CoordinatePartitionChart()`, got "
                f"{chart!r}."
            )
        chart.check(constraint)
        self.inner = with_accurate_stages(solver)
        self.constraint = constraint
        self.projection = NewtonProjection() if projection is None else projection
        self.chart = chart
        self.bends_interpolant = True
        self.bounds_error = False
        self.state_of_coordinates = chart.state

    def prepare_terms(self, terms: Any) -> Any:
        check_noise(self.solver, terms)
        check_no_mass_matrix(terms, "LocalCoordinates")
        if self.chart.state is not None and is_sde(terms):
            raise ValueError(
                f"`terms` has noise, which coordinates of `chart={type(self.chart).__name__}` are not for. Use "
                "`mj.Projected(solver, constraint)`."
            )
        return terms

    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        direction = time_direction(terms)
        of = self.chart.at(self.constraint, self.projection, t0 * direction, y0, args)
        if self.chart.state is None:
            check_state_like(self.chart, of.origin, y0)
        return _DirectedCoordinates(of, y0, direction).frame(terms, t1, args, self.chart.state)


class _DirectedCoordinates(eqx.Module):
    """Coordinates as functions of Diffrax's time, which is negated backwards."""

    of: AbstractCoordinates
    centre: Y
    direction: RealScalarLike

    def frame(self, terms: Any, t1: RealScalarLike, args: Args, state: Any) -> StepFrame:
        stage_terms = rewrite_terms(terms, lambda term: RewrittenTerm(term, self.field))
        correct = lambda w: self.lift(t1, w, args)
        error = lambda w1, y1, e: self.of.push_forward(t1 * self.direction, w1, y1, args, e)
        return StepFrame(self.of.origin, stage_terms, correct, self.pull_back, state, error)

    def lift(self, t: RealScalarLike, w: Y, args: Args) -> tuple[Y, ProjectionInfo]:
        return self.of.lift(t * self.direction, w, args)

    def field(self, term: dfx.AbstractTerm, t: RealScalarLike, w: Y, args: Args) -> Any:
        """Return the velocity of the coordinates, NaN where there is no lift."""
        lifted, info = self.lift(t, w, args)
        # Evaluated at a point where it is finite, then made NaN by an addition: the derivative of a NaN
        # in a rejected step would be NaN instead of zero.
        where = lambda a, b: jnp.where(info.success, a, jax.lax.stop_gradient(b))
        lifted = jtu.tree_map(where, lifted, self.centre)
        velocity = self.pull_back(t, w, lifted, term.vf(t, lifted, args))
        return nan_unless(info.success, velocity)

    def pull_back(self, t: RealScalarLike, w: Y, y: Y, vector: Y) -> Y:
        return self.of.pull_back(t * self.direction, w, y, vector)


def nan_unless(success: BoolScalar, tree: Any) -> Any:
    undefined = jnp.where(success, 0.0, jnp.nan)
    return jtu.tree_map(lambda leaf: leaf + undefined.astype(leaf.dtype), tree)
