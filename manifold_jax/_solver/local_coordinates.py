"""The parameterization approach: integrate in local coordinates on the manifold."""

from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._chart import AbstractChart, push_forward, TangentSpaceChart
from .._compat import time_direction
from .._constraint import AbstractConstraint, check_constraint
from .._custom_types import Args, BoolScalar, RealScalarLike, Y
from .._interpolation import CorrectedInterpolationFactory
from .._projection import NewtonProjection
from .._projection_info import ProjectionInfo
from .advance import advance, conclude, HookState, initial_state
from .base import AbstractManifoldSolver, check_hook_arguments, check_noise
from .implicit import with_accurate_stages
from .rewrite import rewrite_terms, RewrittenTerm


class LocalCoordinates(AbstractManifoldSolver):
    """Any one-step solver in local coordinates: every *stage* is on the manifold, not only
    every step (the paper's parameterization approach).

    At the beginning of each step a chart `x = lift(w)` is set up, `w' = f(t, lift(w))` is
    advanced by one step of the wrapped solver, and the result lifted. The order of the
    wrapped solver is kept. Its error estimate is pushed forward to the state, so that the
    tolerances mean the same as for the other approaches. A stage that has no point on the
    manifold near it rejects the step.

    **Arguments:**

    - `solver`, `constraint`, `projection`: as for [`Projected`][]; the equations must be
        independent.
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
    bend_interpolant: bool
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
        if constraint.redundant:
            raise ValueError(
                "`constraint` is redundant: equations that depend on each other define no local coordinates. "
                "Remove the dependent ones, or use `mj.Projected(solver, constraint)`."
            )
        self.inner = with_accurate_stages(solver)
        self.constraint = constraint
        self.projection = NewtonProjection() if projection is None else projection
        self.chart = chart
        self.bend_interpolant = True

    @property
    def interpolation_cls(self):  # pyright: ignore
        return CorrectedInterpolationFactory(self.inner.interpolation_cls, self.bend_interpolant)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
        check_noise(self.solver, terms)
        check_constraint(self.constraint, t0, y0, args)
        return initial_state(self.inner, terms, t0, t1, y0, args)

    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: HookState,
        made_jump: Any,
    ) -> tuple[Y, Y | None, dict[str, Any], HookState, RESULTS]:
        direction = time_direction(terms)
        rows = self.chart.directions(self.projection, self.constraint, t0 * direction, y0, args)
        lift = _Lift(self.constraint, self.projection, direction, rows, y0)
        stage_terms = rewrite_terms(terms, lambda term: RewrittenTerm(term, lift.field))
        step = advance(
            self.inner,
            terms,
            stage_terms,
            t0,
            t1,
            y0,
            args,
            solver_state.inner,
            made_jump,
            lambda y: lift(t1, y, args),
        )
        if step.error is not None:
            pushed = push_forward(self.constraint, t1 * direction, step.y1, args, rows, step.error)
            step = step._replace(error=pushed)
        return conclude(step, t0, t1, solver_state, self.projection.rtol is not None)


class _Lift(eqx.Module):
    """From any representative of the coordinates to the point on the manifold."""

    constraint: AbstractConstraint
    projection: NewtonProjection
    direction: RealScalarLike
    rows: Float[Array, "m n"]
    centre: Y

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, ProjectionInfo]:
        return self.projection(
            self.constraint,
            t * self.direction,
            y,
            args,
            fallback=self.centre,
            directions=self.rows,
        )

    def field(self, term: dfx.AbstractTerm, t: RealScalarLike, y: Y, args: Args) -> Any:
        """The vector field at the lifted stage, NaN where there is none."""
        lifted, info = self(t, y, args)
        # Evaluated at a point where it is finite, and then added to: the derivative of a NaN
        # in a step that is rejected would otherwise be NaN, not zero.
        where = lambda a, b: jnp.where(info.success, a, jax.lax.stop_gradient(b))
        lifted = jtu.tree_map(where, lifted, self.centre)
        return nan_unless(info.success, term.vf(t, lifted, args))


def nan_unless(success: BoolScalar, tree: Any) -> Any:
    undefined = jnp.where(success, 0.0, jnp.nan)
    return jtu.tree_map(lambda leaf: leaf + undefined.astype(leaf.dtype), tree)
