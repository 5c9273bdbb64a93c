"""The perturbation approach: correct the state onto the manifold after every step."""

from typing import Any, ClassVar

import diffrax as dfx
from diffrax import RESULTS

from .._base.compat import time_direction
from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import check_constraint
from .._constraint.constraint import AbstractConstraint
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver, check_hook_arguments, check_noise
from .interpolation import CorrectedInterpolationFactory
from .step.advance import conclude, HookState
from .step.execution import execution_of
from .step.frame import Frame
from .step.implicit import with_accurate_stages


class Projected(AbstractManifoldSolver):
    """Any one-step solver, followed by a correction of the state onto the manifold:
    `y1 = pi(Phi_h(y0))`, `g(t1, y1, args) = 0` (projection; the paper's perturbation approach).

    The order of the wrapped solver is kept. The step size controller chooses the steps, from the
    solver's error estimate before the correction; [`mj.diffeqsolve`][] with an adaptive one also counts
    the correction as an error, where it is the larger of both. A step that cannot be corrected is rejected and repeated with a smaller one;
    if no smaller one is possible (constant steps, or steps at the limit of the time's
    precision) the solve ends with `RESULTS.nonlinear_divergence`.

    Works with `diffrax.diffeqsolve`, where every *step* ends on the manifold; use
    [`mj.diffeqsolve`][] to have the initial value, every saved value, events and the dense
    solution there too.

    **Arguments:**

    - `solver`: a Runge-Kutta type solver of Diffrax: explicit, (singly) diagonally implicit,
        implicit-explicit, `HalfSolver` around an explicit one, or a Stratonovich solver.
    - `constraint`: the manifold.
    - `projection`: metric, iteration limit and tolerance, [`NewtonProjection`][].

    **Raises:**

    `ValueError` for solvers that carry past values of `y` (leapfrog, reversible) and for
    Ito solvers of stochastic equations: projection makes them converge to the Stratonovich
    solution.

    Projection guarantees the constraint, not a smaller error: usually the error shrinks,
    sometimes it grows (compare with `manifold-jax compare`).

    The vector field has to be tangent to the manifold where it is evaluated, up to the tolerance;
    the corrections are as small as the errors of the solver then. Make others so with
    [`tangent_field`][] (neural networks, simplified models).

    Source: Sudarsan & Keerthi (1998), section 3.4; Shampine, Comp. Math. Appl. 12B (1986)
    1287-1296; Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
    bends_interpolant: bool
    bounds_error: bool
    corrects_output: ClassVar[bool] = True

    def __init__(
        self,
        solver: dfx.AbstractSolver,
        constraint: AbstractConstraint,
        *,
        projection: NewtonProjection | None = None,
    ):
        check_hook_arguments(solver, constraint, "Projected")
        self.inner = with_accurate_stages(solver)
        self.constraint = constraint
        self.projection = NewtonProjection() if projection is None else projection
        self.bends_interpolant = True
        self.bounds_error = False

    @property
    def interpolation_cls(self):  # pyright: ignore
        return CorrectedInterpolationFactory(self.inner.interpolation_cls, self.bends_interpolant)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
        check_noise(self.solver, terms)
        check_constraint(self.constraint, t0, y0, args)
        execution = execution_of(self.inner, terms, t0, t1, y0, args)
        frame = self._frame(terms, t1, y0, args)
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
        execution = execution_of(self.inner, terms, t0, t1, y0, args)
        frame = self._frame(terms, t1, y0, args)
        step = execution.step(terms, frame, t0, t1, y0, args, solver_state.memory, made_jump)
        return conclude(step, t0, t1, solver_state, self.bounds_error)

    def _frame(self, terms: Any, t1: RealScalarLike, y0: Y, args: Args) -> Frame:
        time = t1 * time_direction(terms)
        return Frame.of_state(y0, terms, lambda y: self.correct(time, y, args, fallback=y0))
