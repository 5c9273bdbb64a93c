"""The ways in which a step of the wrapped solver is executed; the choice is made only here.

- [`ExplicitStep`][]: an explicit Runge-Kutta step, stage by stage or in a loop over the stages.
- [`CarriedDerivative`][]: Diffrax's own step of an implicit method, which begins with the derivative
  at which the step before ended.
- [`OwnStep`][]: the solver's own step, whatever it is.
"""

import abc
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
from diffrax import RESULTS

from ..._base.types import Args, RealScalarLike, Y
from ..._constraint.projection_info import ProjectionInfo
from .explicit import explicit_step, is_first_same_as_last, is_unrollable, refreshed
from .frame import StepFrame
from .implicit import carries_derivative, step_with_derivative


class Step(NamedTuple):
    """One attempted step: the state before it and after it, corrected and `raw`, the coordinates `w1`
    at its end with their error estimate, and the memory."""

    y0: Y
    y1: Y
    raw: Y
    w1: Y
    error: Y | None
    dense_info: dict[str, Any]
    memory: Any
    result: RESULTS
    info: ProjectionInfo


class AbstractExecution(eqx.Module):
    """An execution of steps; `memory` is carried from step to step, arrays of constant shapes."""

    solver: eqx.AbstractVar[dfx.AbstractSolver]

    @abc.abstractmethod
    def initial_memory(
        self,
        terms: Any,
        frame: StepFrame,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        """Return the memory before the first step."""

    @abc.abstractmethod
    def step(
        self,
        terms: Any,
        frame: StepFrame,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        memory: Any,
        made_jump: Any,
    ) -> Step:
        """Make one step and correct its end. `terms` are those of the state, evaluated on the manifold;
        `frame.terms` those of the coordinates, evaluated at stages."""


class ExplicitStep(AbstractExecution):
    """An explicit step of this library, which corrects the new state before the last stage."""

    solver: dfx.AbstractSolver
    in_a_loop: bool | None = None  # None: whichever is faster

    def initial_memory(self, terms, frame, t0, t1, y0, args):
        return terms.vf(t0, y0, args) if self.remembers_field else None

    @property
    def remembers_field(self) -> bool:
        """Whether the memory is the vector field at the state, with which a step ends."""
        return is_first_same_as_last(self._tableau)

    def step(self, terms, frame, t0, t1, y0, args, memory, made_jump) -> Step:
        evaluate = lambda: terms.vf(t0, y0, args)
        f0 = None if memory is None else refreshed(made_jump, memory, evaluate)
        y1, w1, error, dense_info, f1, info = explicit_step(
            self._tableau, terms, frame, t0, t1, y0, args, f0, self.in_a_loop
        )
        raw, dense_info = _in_state(frame, y0, w1, dense_info)
        return Step(y0, y1, raw, w1, error, dense_info, f1, RESULTS.successful, info)

    @property
    def _tableau(self) -> dfx.ButcherTableau:
        return self.solver.tableau  # pyright: ignore


class CarriedDerivative(AbstractExecution):
    """Diffrax's step of an implicit method whose last stage is the first one of the next step."""

    solver: dfx.AbstractSolver

    def initial_memory(self, terms, frame, t0, t1, y0, args):
        terms, w0 = _in_coordinates(frame, terms, y0)
        return self.solver.func(terms, t0, w0, args)

    def step(self, terms, frame, t0, t1, y0, args, memory, made_jump) -> Step:
        w1, error, dense_info, memory, result = step_with_derivative(
            self.solver, terms, frame, t0, t1, y0, args, memory, made_jump
        )
        y1, info = frame.correct(w1)
        raw, dense_info = _in_state(frame, y0, w1, dense_info)
        return Step(y0, y1, raw, w1, error, dense_info, memory, result, info)


class OwnStep(AbstractExecution):
    """The solver's own step."""

    solver: dfx.AbstractSolver

    def initial_memory(self, terms, frame, t0, t1, y0, args):
        terms, w0 = _in_coordinates(frame, terms, y0)
        return self.solver.init(terms, t0, t1, w0, args)

    def step(self, terms, frame, t0, t1, y0, args, memory, made_jump) -> Step:
        # The memory of a solver belongs to the uncorrected state. Diffrax evaluates it again if any
        # lane of a batch needs it, which would make lanes depend on each other; always evaluating it
        # does not.
        w1, error, dense_info, memory, result = self.solver.step(
            frame.terms, t0, t1, frame.origin, args, memory, made_jump=True
        )
        y1, info = frame.correct(w1)
        raw, dense_info = _in_state(frame, y0, w1, dense_info)
        return Step(y0, y1, raw, w1, error, dense_info, memory, result, info)


def execution_of(
    solver: dfx.AbstractSolver,
    terms: Any,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
) -> AbstractExecution:
    """Choose the fastest implementation with the same result."""
    if is_unrollable(solver, terms, t0, t1, y0, args):
        return ExplicitStep(solver)
    if carries_derivative(solver, terms, t0, t1, y0, args):
        return CarriedDerivative(solver)
    return OwnStep(solver)


def _in_coordinates(frame: StepFrame, terms: Any, y0: Y) -> tuple[Any, Y]:
    """Return the terms from which the initial memory is computed, and where they begin."""
    return (terms, y0) if frame.state is None else (frame.terms, frame.origin)


def _in_state(
    frame: StepFrame, y0: Y, w1: Y, dense_info: dict[str, Any]
) -> tuple[Y, dict[str, Any]]:
    """Return the state at the end of the solver's own interpolation, and the data of the interpolation."""
    if frame.state is None:
        return w1, dense_info
    return frame.state(y0, w1), dict(start=y0, **dense_info)
