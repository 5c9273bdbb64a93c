"""What every step hook shares: forwarding to the solver it is wrapped around."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx

from .._base.compat import is_sde, undirected
from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import check_constraint_type
from .._constraint.constraint import AbstractConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .._rosenbrock import AbstractRosenbrock, MassMatrixTerm


# One-step methods that keep no past values of y. Others (leapfrog, reversible) carry a
# shadow trajectory in their state that would not be moved onto the manifold.
_SUPPORTED = (
    dfx.AbstractRungeKutta,
    dfx.AbstractSRK,
    dfx.Euler,
    dfx.ImplicitEuler,
    dfx.EulerHeun,
    dfx.StratonovichMilstein,
    AbstractRosenbrock,
)


class AbstractManifoldSolver(dfx.AbstractWrappedSolver):
    """A Diffrax solver wrapped around another, `inner`, that keeps to a manifold.

    Diffrax looks at the type and at some attributes of the solver it is given. It sends
    type checks through `.solver`, one level only, so `solver` is the innermost solver;
    everything else is forwarded here, in one place. Implementations provide `init`,
    `step` and `interpolation_cls`.
    """

    inner: eqx.AbstractVar[dfx.AbstractSolver]
    constraint: eqx.AbstractVar[AbstractConstraint]
    projection: eqx.AbstractVar[NewtonProjection]  # also corrects what is handed out
    corrects_output: eqx.AbstractVar[bool]  # whether what is handed out is corrected
    # Whether interpolants are bent to end at the corrected state. Not where every interpolated value
    # is corrected afterwards, which makes them continuous by itself: the same correction of the same
    # point. Bending costs more than interpolating.
    bends_interpolant: eqx.AbstractVar[bool]
    # Whether the error estimate of a step is at least the size of its correction, which is a lower
    # bound of the local error (Sudarsan & Keerthi 1998, 3.4).
    bounds_error: eqx.AbstractVar[bool]

    def within(
        self, controller: dfx.AbstractStepSizeController, bends_interpolant: bool
    ) -> "AbstractManifoldSolver":
        """The solver as `mj.diffeqsolve` runs it: with the tolerances of the step size controller,
        which it cannot see by itself, unless it has others. Errors are bounded if there are any."""
        tolerances = controller_tolerances(controller)
        projection = self.projection
        if tolerances is not None and projection.rtol is None:
            rtol, atol = tolerances.rtol, tolerances.atol
            projection = dataclasses.replace(projection, rtol=rtol, atol=atol)
        return eqx.tree_at(
            lambda s: (s.projection, s.bends_interpolant, s.bounds_error),
            self,
            (projection, bends_interpolant, tolerances is not None),
        )

    def correct(
        self, t: RealScalarLike, y: Y, args: Args, fallback: Y | None = None
    ) -> tuple[Y, ProjectionInfo]:
        """A state on the manifold, at the true time `t`."""
        return self.constraint.correct(self.projection, t, y, args, fallback=fallback)

    @property
    def solver(self) -> dfx.AbstractSolver:  # pyright: ignore
        return self.inner.solver if isinstance(self.inner, dfx.HalfSolver) else self.inner

    @property
    def term_structure(self):  # pyright: ignore
        return self.inner.term_structure

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore
        return self.inner.term_compatible_contr_kwargs

    # Read, and replaced through `eqx.tree_at`, when the innermost solver is implicit.
    @property
    def root_finder(self):
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps  # pyright: ignore

    # Set by forward-mode adjoints on Runge-Kutta methods.
    @property
    def scan_kind(self):
        return self.solver.scan_kind  # pyright: ignore

    def order(self, terms) -> int | None:
        return self.inner.order(terms)

    def strong_order(self, terms) -> RealScalarLike | None:
        return self.inner.strong_order(terms)

    def error_order(self, terms) -> RealScalarLike | None:
        return self.inner.error_order(terms)

    def func(self, terms, t0: RealScalarLike, y0: Y, args: Args) -> Any:
        return self.inner.func(terms, t0, y0, args)


def controller_tolerances(controller: Any) -> dfx.PIDController | None:
    """The controller that holds `rtol`, `atol` and `norm`, inside any wrappers around it."""
    while hasattr(controller, "controller"):
        controller = controller.controller
    return controller if isinstance(controller, dfx.PIDController) else None


def check_hook_arguments(solver: Any, constraint: Any, hook: str) -> None:
    _check_inner_solver(solver, hook)
    check_constraint_type(constraint)


def _check_inner_solver(solver: Any, hook: str) -> None:
    """Refuse solvers whose steps cannot be corrected, naming what to write instead."""
    if isinstance(solver, type):
        raise TypeError(f"`solver` must be an instance: write `{hook}({solver.__name__}(), ...)`.")
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(f"`solver` must be a Diffrax solver, got {type(solver).__name__}.")
    if isinstance(solver, dfx.HalfSolver):
        if isinstance(solver.solver, AbstractManifoldSolver):
            raise ValueError(
                f"`HalfSolver({type(solver.solver).__name__}(...))` hides failed steps: put the hook outermost, "
                f"`{hook}(HalfSolver(solver), constraint)`."
            )
        if isinstance(solver.solver, dfx.AbstractImplicitSolver | AbstractRosenbrock):
            raise ValueError(
                f"`HalfSolver({type(solver.solver).__name__}())` does not work in Diffrax: it loses failures of the "
                "implicit stages. Use the implicit solver itself, it has an error estimate: "
                f"`{hook}({type(solver.solver).__name__}(), constraint)`."
            )
        solver = solver.solver
    if isinstance(solver, AbstractManifoldSolver):
        raise ValueError(
            f"`solver` is already a {type(solver).__name__}. Put all equations into one constraint: "
            f"`{hook}(solver, constraint)`."
        )
    name = type(solver).__name__
    if isinstance(solver, dfx.ItoMilstein):
        raise ValueError(
            "`solver=ItoMilstein()` cannot be projected: projection turns an Ito method into a Stratonovich one. "
            "Write the equation in Stratonovich form and use `StratonovichMilstein()`."
        )
    if not isinstance(solver, _SUPPORTED):
        raise ValueError(
            f"`solver={name}()` keeps past values of y in its state (or splits y), which a correction onto the "
            "manifold does not reach. Use a Runge-Kutta method such as `Tsit5()`, `Dopri8()` or `Kvaerno5()`, or for "
            "Stratonovich equations `Heun()` or `StratonovichMilstein()`."
        )


def check_noise(solver: dfx.AbstractSolver, terms: Any) -> None:
    """Refuse Ito solvers of stochastic equations (`Euler` is one, but fine for ODEs)."""
    if is_sde(terms) and isinstance(solver, dfx.AbstractItoSolver):
        raise ValueError(
            f"`solver={type(solver).__name__}()` converges to the Ito solution, but projection makes it converge to "
            "the Stratonovich one. Write the equation in Stratonovich form and use `EulerHeun()`, `Heun()` or "
            "`StratonovichMilstein()`."
        )


def check_no_mass_matrix(terms: Any, hook: str) -> None:
    """Refuse `M y' = f` where a hook needs y' itself."""
    if isinstance(undirected(terms), MassMatrixTerm):
        raise ValueError(
            f"`terms` is an `mj.MassMatrixTerm`, but `mj.{hook}` needs y' itself. Use `mj.Projected(mj.Rodas5P(), "
            "constraint)`, or for a regular mass matrix solve for y' in the vector field of a `diffrax.ODETerm`."
        )
