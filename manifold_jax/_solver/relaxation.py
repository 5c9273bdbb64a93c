"""Relaxation: one invariant is kept by steps that are a little longer, so that linear invariants stay, too."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS

from .._base.compat import nonlinear_failure, time_direction
from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.correction import equations_of, solve_correction
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .._linalg.rows import multiply
from .base import check_hook_arguments, check_one_equation
from .interpolation import CorrectedInterpolation
from .on_manifold import AbstractStepsOnManifold
from .step.execution import ExplicitStep
from .step.frame import StepFrame


class RelaxedSteps(dfx.AbstractSolver):
    """The steps of [`Relaxation`][], which has the formula."""

    method: dfx.AbstractERK
    constraint: AbstractConstraint

    term_structure: ClassVar = dfx.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable[..., dfx.AbstractLocalInterpolation]:  # pyright: ignore
        return _InterpolationFactory(self.method.interpolation_cls)

    def order(self, terms: Any) -> int | None:
        return self.method.order(terms)

    def error_order(self, terms: Any) -> RealScalarLike | None:
        return self.method.error_order(terms)

    def init(self, terms, t0, t1, y0: Y, args: Args) -> None:
        return None

    def func(self, terms, t0, y0: Y, args: Args) -> Any:
        return self.method.func(terms, t0, y0, args)

    @eqx.filter_jit  # traced once
    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: None,
        made_jump,
    ) -> Any:
        unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True)))
        frame = StepFrame.of_state(y0, terms, unchanged)
        execution = ExplicitStep(self.method)
        step = execution.step(terms, frame, t0, t1, y0, args, None, False)
        field = step.memory
        if not execution.remembers_field:
            field = terms.vf(t1, step.y1, args)
        moved = jtu.tree_map(jnp.subtract, step.y1, y0)
        direction = jtu.tree_map(jnp.subtract, moved, terms.prod(field, terms.contr(t0, t1)))
        root = self._relaxed(t1 * time_direction(terms), y0, step.y1, direction, args)
        y1 = jfu.ravel_pytree(step.y1)[1](root.p)
        shift = jtu.tree_map(jnp.subtract, y1, step.y1)
        dense_info = dict(method=step.dense_info, y1=y1, shift=shift)
        result = RESULTS.where(root.success, RESULTS.successful, nonlinear_failure())
        return y1, step.error, dense_info, None, result

    def _relaxed(self, t: RealScalarLike, y0: Y, y1: Y, direction: Y, args: Args) -> Any:
        """Return the root on the line through `y1` in this direction."""
        line, safe = (jfu.ravel_pytree(y)[0] for y in (direction, y0))
        projection = NewtonProjection()
        equations = equations_of(self.constraint, t, y1, args, projection, False)
        number = equations.residual(equations.x).size
        if number != 1:
            raise ValueError(
                f"`constraint` has {number} equations, but relaxation moves along one direction and keeps one invariant. Give "
                "the one that is not linear (linear ones are kept anyway), or use `mj.Projected(solver, constraint)`."
            )
        # Pivots must be positive, so the line points to where the invariant grows; `gamma` takes the sign.
        falls = multiply(equations.normals().jacobian, line) < 0
        line = jnp.where(falls, -line, line)
        return solve_correction(equations.along(line[None, :]), safe, projection, True)


class _InterpolationFactory(eqx.Module):
    """Builds the interpolant of a method, bent to end at the relaxed state."""

    method: Callable[..., dfx.AbstractLocalInterpolation] = eqx.field(static=True)

    def __call__(self, *, t0, t1, method, y1, shift) -> CorrectedInterpolation:
        inner = self.method(t0=t0, t1=t1, **method)
        return CorrectedInterpolation(t0=t0, t1=t1, inner=inner, y1=y1, correction=shift)


class Relaxation(AbstractStepsOnManifold):
    r"""Keeps one invariant, and with it all linear ones: total momenta, masses, charges, which steps of
    Runge-Kutta methods keep, but corrections along the gradient of an energy do not.

    A step of length $h$ of the method, from $y_0$ to $\tilde y_1$, is made longer or shorter by $\gamma$, and moved
    along the vector field by as much back in time:

    $$y_1 = \tilde y_1 + \gamma\, (\tilde y_1 - y_0 - h f(t_1, \tilde y_1)), \qquad g(t_1, y_1) = 0.$$

    Values of `f` leave linear invariants as they are, and so does this sum of them.

    ```python
    energy = mj.Invariants(lambda t, y, args: hamiltonian(y), y0=y0)
    sol = mj.diffeqsolve(terms, mj.Relaxation(dfx.Tsit5(), energy), 0.0, 100.0, 0.1, y0)
    ```

    **Arguments:**

    - `solver`: an explicit Runge-Kutta method of Diffrax, such as `Tsit5()`.
    - `constraint`: one equation, in general [`Invariants`][] with one quantity: a convex one, such as most energies
        and entropies, or a concave one. Elsewhere there may be steps which no `gamma` brings back.

    The order is that of the method. Steps may have constant or adaptive sizes. Ends of steps keep all invariants;
    values between the steps are corrected as by [`Projected`][], which keeps the one in `constraint`:
    save with `SaveAt(steps=...)` where linear ones matter to the last digit.

    **Raises:**

    `TypeError` and `ValueError` for other solvers and something else than a constraint; when it is solved,
    `ValueError` for several equations and for terms that are not an ordinary differential equation. A step
    on whose line the invariant does not take its value is rejected, or with constant steps fails.

    Prefer [`Projected`][] for constraints that the differential equation keeps by itself only in theory, and for
    several invariants; [`rattle`][] or [`SymmetricProjection`][] for long times.

    Source: Ketcheson, SIAM J. Numer. Anal. 57 (2019) 2850-2870, where a step ends at the time
    `t_0 + (1 + gamma) h`; moving back changes it by `O(h^(2 p))`, with `gamma = O(h^(p - 1))`.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection

    def __init__(self, solver: Any, constraint: AbstractConstraint):
        check_hook_arguments(solver, constraint, "Relaxation")
        if not isinstance(solver, dfx.AbstractERK):
            raise ValueError(
                f"`solver={type(solver).__name__}()` is not an explicit Runge-Kutta method, whose steps can be relaxed. "
                "Use e.g. `Tsit5()`, `Bosh3()` or `Dopri8()`."
            )
        self.inner = RelaxedSteps(solver, constraint)
        self.constraint = constraint
        self.projection = NewtonProjection()
        self.bends_interpolant = True
        self.bounds_error = False
        self.state_of_coordinates = None

    def prepare_terms(self, terms: Any) -> Any:
        check_one_equation(terms, "Relaxation")
        return terms
