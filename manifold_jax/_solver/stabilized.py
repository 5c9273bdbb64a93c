"""Constraint stabilization: a vector field that is drawn to the manifold."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
from diffrax import RESULTS

from .._base.compat import is_sde, time_direction, update_result
from .._base.rejection import result_of_state
from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import check_constraint
from .._constraint.constraint import AbstractConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver, check_hook_arguments, check_no_mass_matrix
from .interpolation import CorrectedInterpolationFactory
from .stabilization import AbstractStabilization, is_stable
from .step.advance import conclude, HookState
from .step.execution import execution_of
from .step.frame import Frame
from .step.implicit import with_accurate_stages
from .terms import has_several, rewrite_terms, RewrittenTerm


class Stabilized(AbstractManifoldSolver):
    """Any one-step solver with a stabilized vector field: violations decay, but are not zero
    (constraint stabilization).

    Works forward and backward in time: violations decay in the direction of integration.
    What is handed out is not corrected (except with `ExactStabilization(0)`): the violation
    is of the size of the tolerance. Use [`Projected`][] for values on the manifold.

    **Arguments:**

    - `solver`, `constraint`: as for [`Projected`][]; ordinary differential equations only.
    - `stabilization`: [`InvariantStabilization`][] or [`ExactStabilization`][].
        [`Baumgarte`][] and [`VelocityStabilization`][] change the
        accelerations of a [`MechanicalSystem`][] instead.
    - `projection`: metric of the correction, [`NewtonProjection`][].

    **Raises:**

    As [`Projected`][]. A step with `gain * h` beyond the stability interval of an explicit
    solver is rejected, or ends the solve with `RESULTS.nonlinear_divergence` if steps are
    constant.

    Source: Sudarsan & Keerthi (1998), section 3.3; Ascher, Chin & Reich, Numer. Math. 67
    (1994) 131-149.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
    stabilization: AbstractStabilization
    bends_interpolant: bool
    bounds_error: bool

    def __init__(
        self,
        solver: dfx.AbstractSolver,
        constraint: AbstractConstraint,
        *,
        stabilization: AbstractStabilization,
        projection: NewtonProjection | None = None,
    ):
        check_hook_arguments(solver, constraint, "Stabilized")
        if not isinstance(stabilization, AbstractStabilization):
            raise TypeError(
                "`stabilization` must be `mj.InvariantStabilization(gain)` or `mj.ExactStabilization(gain)`, "
                f"got {type(stabilization).__name__}. Baumgarte's method is an argument of `mj.MechanicalSystem`."
            )
        self.inner = with_accurate_stages(solver)
        self.constraint = constraint
        self.projection = NewtonProjection() if projection is None else projection
        self.stabilization = stabilization
        self.bends_interpolant = True
        self.bounds_error = False

    @property
    def corrects_output(self) -> bool:
        return self.stabilization.ends_on_manifold

    @property
    def interpolation_cls(self):  # pyright: ignore
        return CorrectedInterpolationFactory(
            self.inner.interpolation_cls, self.bends_interpolant and self.corrects_output
        )

    def func(self, terms, t0: RealScalarLike, y0: Y, args: Args) -> Any:
        return self.inner.func(self._stabilized(terms), t0, y0, args)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
        if is_sde(terms):
            raise ValueError(
                "`terms` has noise, which no stabilization of the drift keeps on the manifold. Use "
                "`mj.Projected(solver, constraint)`."
            )
        if has_several(terms):
            raise ValueError(
                "`terms` is a `MultiTerm`: which of its vector fields should be stabilized is not defined. Add "
                "them up in one `diffrax.ODETerm`, or use `mj.Projected(solver, constraint)`."
            )
        check_no_mass_matrix(terms, "Stabilized")
        check_constraint(self.constraint, t0, y0, args)
        terms = self._stabilized(terms)
        execution = execution_of(self.inner, terms, t0, t1, y0, args)
        frame = self._frame(terms, t0, t1, y0, args)
        memory = execution.initial_memory(terms, frame, t0, t1, y0, args)
        return HookState.initial(memory, t0, t1, y0)

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
        terms = self._stabilized(terms)
        execution = execution_of(self.inner, terms, t0, t1, y0, args)
        frame = self._frame(terms, t0, t1, y0, args)
        step = execution.step(terms, frame, t0, t1, y0, args, solver_state.memory, made_jump)
        if not self.corrects_output:  # nothing has looked at the state
            step = step._replace(result=update_result(step.result, result_of_state(step.y1)))
        return conclude(step, t0, t1, solver_state, self.bounds_error)

    def _frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> Frame:
        time = t1 * time_direction(terms)
        stable = is_stable(self.stabilization.rate, jnp.asarray(t1) - t0, self.solver)

        def correct(y: Y) -> tuple[Y, ProjectionInfo]:
            if not self.corrects_output:
                return y, ProjectionInfo.of_nothing(y, stable)
            return self.correct(time, y, args, fallback=y0)

        return Frame.of_state(y0, terms, correct)

    def _stabilized(self, terms: Any) -> Any:
        direction = time_direction(terms)

        def field(term, t, y, args):
            f = lambda t, y, args: term.vf(t * direction, y, args)
            return self.stabilization.field(
                f, self.constraint, self.projection, direction, t * direction, y, args
            )

        return rewrite_terms(terms, lambda term: RewrittenTerm(term, field))
