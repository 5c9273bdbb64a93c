"""The part that all step hooks share: `init` and `step` around those of the wrapped solver."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
from diffrax import RESULTS

from .._base.compat import is_sde, undirected, update_result
from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import check_constraint, check_constraint_type
from .._constraint.constraint import AbstractConstraint, NoConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .._rosenbrock import AbstractMassMatrixSolver, MassMatrixTerm
from .interpolation import CorrectedInterpolationFactory
from .step.execution import AbstractExecution, execution_of
from .step.frame import StepFrame
from .step.hook_state import conclude, HookState
from .terms import has_several


# One-step methods that keep no past values of y. Others (leapfrog, reversible) carry a
# shadow trajectory in their state that would not be moved onto the manifold.
_SUPPORTED = (
    dfx.AbstractRungeKutta,
    dfx.AbstractSRK,
    dfx.Euler,
    dfx.ImplicitEuler,
    dfx.EulerHeun,
    dfx.StratonovichMilstein,
    AbstractMassMatrixSolver,
)


class AbstractManifoldSolver(dfx.AbstractWrappedSolver):
    """A Diffrax solver wrapped around another, `inner`, whose steps are kept on a manifold.

    [`Projected`][], [`Stabilized`][] and [`LocalCoordinates`][] are its implementations. Write one of your own
    for another correction of steps: [`mj.diffeqsolve`][] then makes `y0` consistent and corrects
    saved values, events and the dense solution for it, too, which it cannot do for an unknown
    wrapper. An implementation is a dataclass with these three fields, a class variable and two methods:

    - `inner`: the wrapped solver, a one-step method of Diffrax or of this library.
    - `constraint`: the manifold, an [`AbstractConstraint`][].
    - `projection`: how corrections are made, [`NewtonProjection`][].
    - `corrects_output`: whether steps end on the manifold, and values between steps are to be
        corrected onto it.
    - [`prepare_terms`][manifold_jax.AbstractManifoldSolver.prepare_terms] and
        [`frame`][manifold_jax.AbstractManifoldSolver.frame].

    The other fields are set by [`mj.diffeqsolve`][] and need no attention.

    Source: the common part of sections 3.2 to 3.4 of Sudarsan & Keerthi (1998).
    """

    # Diffrax looks at the type and at some attributes of the solver it is given. It forwards type
    # checks through `.solver`, one level only, so `solver` is the innermost solver; everything else is
    # forwarded here, in one place.
    inner: eqx.AbstractVar[dfx.AbstractSolver]
    constraint: eqx.AbstractVar[AbstractConstraint]
    projection: eqx.AbstractVar[NewtonProjection]
    corrects_output: eqx.AbstractVar[bool]
    # Whether interpolants are bent to end at the corrected state. Not needed if every interpolated
    # value is corrected afterwards: the same correction of the same point makes them continuous.
    # Bending costs more than interpolating.
    bends_interpolant: bool = eqx.field(default=True, kw_only=True)
    # Whether the error estimate of a step is raised to the size of its correction, which is a lower
    # bound of the local error (Sudarsan & Keerthi 1998, 3.4).
    bounds_error: bool = eqx.field(default=False, kw_only=True)
    # `(y, w) -> y`, a state near that of the coordinates `w` of steps; None if they are states.
    state_of_coordinates: Callable[[Y, Y], Y] | None = eqx.field(
        default=None, kw_only=True, static=True
    )

    @abc.abstractmethod
    def prepare_terms(self, terms: Any) -> Any:
        """Refuse terms that this hook cannot keep on the manifold; return those whose solution the
        steps approximate: `terms` themselves, or with another vector field."""

    @abc.abstractmethod
    def frame(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> StepFrame:
        """Return the coordinates in which the step from `t0` to `t1` is made, and the correction of its
        end. Times are those of Diffrax, which are negated backwards: `diffrax` calls terms with
        `t * direction`. Write `mj.StepFrame.of_state(y0, terms, correct)` if the state is its own
        coordinates; `correct(y)` returns the new state and a [`ProjectionInfo`][]."""

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
        terms = self.prepare_terms(terms)
        check_constraint(self.constraint, t0, y0, args)
        frame = self.frame(terms, t0, t1, y0, args)
        execution = self.execution(terms, t0, t1, y0, args)
        memory = execution.initial_memory(terms, frame, t0, t1, y0, args)
        return HookState.initial(memory, t0, t1, y0)

    # Traced once, although the loop of Diffrax and the reverse sweep look at a step several times.
    @eqx.filter_jit
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
        terms = self.prepare_terms(terms)
        frame = self.frame(terms, t0, t1, y0, args)
        execution = self.execution(terms, t0, t1, y0, args)
        step = execution.step(terms, frame, t0, t1, y0, args, solver_state.memory, made_jump)
        if frame.error_of_state is not None and step.error is not None:
            step = step._replace(error=frame.error_of_state(step.w1, step.y1, step.error))
        if frame.verdict is not None:
            step = step._replace(result=update_result(step.result, frame.verdict(step.y1)))
        rejects = not isinstance(self.constraint, NoConstraint)
        return conclude(step, t0, t1, solver_state, self.bounds_error, rejects)

    def execution(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> AbstractExecution:
        """Choose how steps of `inner` are executed, for terms that are prepared."""
        return execution_of(self.inner, terms, t0, t1, y0, args)

    @property
    def interpolation_cls(self):  # pyright: ignore
        bend = self.bends_interpolant and self.corrects_output
        inner = self.inner.interpolation_cls
        return CorrectedInterpolationFactory(inner, bend, self.state_of_coordinates)

    def within(
        self, controller: dfx.AbstractStepSizeController, bends_interpolant: bool
    ) -> "AbstractManifoldSolver":
        """Return the solver as `mj.diffeqsolve` runs it: with the tolerances of the step size
        controller, unless it has its own. Error estimates are raised to corrections if there are any."""
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
        """Correct a state onto the manifold, at the true time `t`."""
        fallback = y if fallback is None else fallback
        return _correct(self.constraint, self.projection, t, y, args, fallback)

    @property
    def solver(self) -> dfx.AbstractSolver:  # pyright: ignore
        return self.inner.solver if isinstance(self.inner, dfx.HalfSolver) else self.inner

    @property
    def term_structure(self):  # pyright: ignore
        return self.inner.term_structure

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore
        return self.inner.term_compatible_contr_kwargs

    # Read, and replaced with `eqx.tree_at`, if the innermost solver is implicit.
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
        return self.inner.func(self.prepare_terms(terms), t0, y0, args)


@eqx.filter_jit
def _correct(
    constraint: AbstractConstraint,
    projection: NewtonProjection,
    t: RealScalarLike,
    y: Y,
    args: Args,
    fallback: Y,
) -> tuple[Y, ProjectionInfo]:
    return constraint.correct(projection, t, y, args, fallback=fallback)


def controller_tolerances(controller: Any) -> dfx.PIDController | None:
    """Return the controller that holds `rtol`, `atol` and `norm`, inside any wrappers around it."""
    while hasattr(controller, "controller"):
        controller = controller.controller
    return controller if isinstance(controller, dfx.PIDController) else None


def check_hook_arguments(solver: Any, constraint: Any, hook: str) -> None:
    _check_inner_solver(solver, hook)
    if constraint is None:
        raise TypeError(
            "`constraint` must be an `mj.Constraint`, got None. Without a constraint use the solver alone, not in "
            f"`{hook}`."
        )
    check_constraint_type(constraint, f"{hook}(solver, constraint)")


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
        if isinstance(solver.solver, dfx.AbstractImplicitSolver | AbstractMassMatrixSolver):
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


def check_one_equation(terms: Any, hook: str) -> None:
    """Refuse noise, sums of terms and mass matrices."""
    if is_sde(terms) or has_several(terms):
        raise ValueError(
            "`terms` must be one ordinary differential equation, a `diffrax.ODETerm`. Use "
            "`mj.Projected(solver, constraint)`."
        )
    check_no_mass_matrix(terms, hook)
