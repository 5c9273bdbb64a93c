"""Constraint stabilization: a vector field that is attracted to the manifold."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp

from .._base.compat import is_sde, time_direction
from .._base.rejection import result_of_state
from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver, check_hook_arguments, check_no_mass_matrix
from .stabilization import AbstractStabilization, is_stable
from .step.frame import StepFrame
from .step.implicit import with_accurate_stages
from .terms import has_several, rewrite_terms, RewrittenTerm


class Stabilized(AbstractManifoldSolver):
    """Any one-step solver with a stabilized vector field: violations decay, but are not zero
    (constraint stabilization).

    Works forward and backward in time: violations decay in the direction of integration.
    Results are not corrected (except with `ExactStabilization(0)`): the violation is of the
    size of the tolerance. Use [`Projected`][] for values on the manifold.

    **Arguments:**

    - `solver`, `constraint`: as for [`Projected`][]; ordinary differential equations only.
    - `stabilization`: [`InvariantStabilization`][] or [`ExactStabilization`][]. [`Baumgarte`][] and
        [`VelocityStabilization`][] change the accelerations of a [`MechanicalSystem`][] instead.
    - `projection`: metric of the correction, [`NewtonProjection`][].

    **Raises:**

    As [`Projected`][]. A step with `gain * h` beyond the stability interval of an explicit solver is
    rejected, or ends the solve with `RESULTS.nonlinear_divergence` if steps are constant.

    Source: Sudarsan & Keerthi (1998), section 3.3; Ascher, Chin & Reich, Numer. Math. 67
    (1994) 131-149.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
    stabilization: AbstractStabilization

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
        self.state_of_coordinates = None

    @property
    def corrects_output(self) -> bool:
        return self.stabilization.ends_on_manifold

    def prepare_terms(self, terms: Any) -> Any:
        """Return terms with the stabilized vector field."""
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
        direction = time_direction(terms)

        def field(term, t, y, args):
            f = lambda t, y, args: term.vf(t * direction, y, args)
            return self.stabilization.field(
                f, self.constraint, self.projection, direction, t * direction, y, args
            )

        return rewrite_terms(terms, lambda term: RewrittenTerm(term, field))

    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        time = t1 * time_direction(terms)
        stable = is_stable(self.stabilization.rate, jnp.asarray(t1) - t0, self.solver)
        if self.corrects_output:
            return StepFrame.of_state(y0, terms, lambda y: self.correct(time, y, args, fallback=y0))
        unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, stable))
        return StepFrame.of_state(y0, terms, unchanged, verdict=result_of_state)
