"""The perturbation approach: correct the state onto the manifold after every step."""

from typing import Any, ClassVar

import diffrax as dfx

from .._base.compat import time_direction
from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.settings import NewtonProjection
from .base import AbstractManifoldSolver, check_hook_arguments, check_noise
from .step.frame import StepFrame
from .step.implicit import with_accurate_stages


class Projected(AbstractManifoldSolver):
    """Any one-step solver, followed by a correction of the state onto the manifold:
    `y1 = pi(Phi_h(y0))`, `g(t1, y1, args) = 0` (projection; the paper's perturbation approach).

    The order of the wrapped solver is preserved. The step size controller uses the solver's error estimate
    before the correction; [`mj.diffeqsolve`][] with an adaptive controller raises it to the size of the
    correction if that is larger. A step that cannot be corrected is rejected and repeated with a smaller
    step size; if no smaller one is possible (constant steps, or steps at the limit of the time's precision)
    the solve ends with `RESULTS.nonlinear_divergence`.

    Works with `diffrax.diffeqsolve`, where every *step* ends on the manifold; use [`mj.diffeqsolve`][]
    to have the initial value, every saved value, events and the dense solution there too.

    **Arguments:**

    - `solver`: a Runge-Kutta type solver of Diffrax: explicit, (singly) diagonally implicit,
        implicit-explicit, `HalfSolver` around an explicit one, or a Stratonovich solver.
    - `constraint`: the manifold.
    - `projection`: metric, iteration limit and tolerance, [`NewtonProjection`][].

    **Raises:**

    `ValueError` for solvers that carry past values of `y` (leapfrog, reversible) and for Ito solvers of
    stochastic equations: projection makes them converge to the Stratonovich solution.

    Projection guarantees the constraint, not a smaller error: usually the error shrinks,
    sometimes it grows (compare with `manifold-jax compare`).

    The vector field has to be tangent to the manifold where it is evaluated, up to the tolerance; then the
    corrections are as small as the errors of the solver. Others (neural networks, simplified models) can be
    made tangent with [`tangent_field`][].

    Source: Sudarsan & Keerthi (1998), section 3.4; Shampine, Comp. Math. Appl. 12B (1986)
    1287-1296; Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
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
        self.state_of_coordinates = None

    def prepare_terms(self, terms: Any) -> Any:
        check_noise(self.solver, terms)
        return terms

    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        time = t1 * time_direction(terms)
        return StepFrame.of_state(y0, terms, lambda y: self.correct(time, y, args, fallback=y0))
