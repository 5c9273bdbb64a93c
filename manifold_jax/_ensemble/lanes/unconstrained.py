"""A solver without a hook, as lanes advance it: an explicit one of Diffrax, or a Rosenbrock method."""

import dataclasses
from typing import Any, ClassVar

import diffrax as dfx
import jax.numpy as jnp
from diffrax import RESULTS

from ..._base.types import Args, RealScalarLike, Residual, Y
from ..._constraint.constraint import AbstractConstraint
from ..._constraint.projection_info import ProjectionInfo
from ..._constraint.settings import NewtonProjection
from ..._rosenbrock import AbstractRosenbrock, RosenbrockState
from ..._solve.prepare import as_state, chosen_first_step, Ready, time_dtype
from ..._solve.start import StartInfo
from ..._solver.base import AbstractManifoldSolver
from ..._solver.interpolation import CorrectedInterpolationFactory
from ..._solver.step.advance import conclude, HookState
from ..._solver.step.execution import WrittenOut
from ..._solver.step.frame import Frame


# Unknowns up to which a Rosenbrock method is advanced in lanes, its elimination written out: for five
# (eight) in 0.1 (0.17) of the time of `vmap`, jaxlib 0.12.0.1. Beyond it compiling takes too long.
LARGEST_STIFF = 8


class Everywhere(AbstractConstraint):
    """The whole space."""

    redundant: ClassVar[bool] = False

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return jnp.zeros(0)


class Unconstrained(AbstractManifoldSolver):
    """A method whose steps are what they are, nothing corrected, nor rejected that it would keep
    alone: an explicit Runge-Kutta method, its stages written out, or a Rosenbrock method without a
    mass matrix, which remembers nothing of the step before."""

    inner: dfx.AbstractSolver
    constraint: Everywhere = Everywhere()
    projection: NewtonProjection = NewtonProjection()
    bends_interpolant: bool = False
    bounds_error: bool = False
    corrects_output: ClassVar[bool] = False

    @property
    def interpolation_cls(self):  # pyright: ignore
        if isinstance(self.inner, AbstractRosenbrock):
            return self.inner.interpolation_cls
        return CorrectedInterpolationFactory(self.inner.interpolation_cls, False)

    def ready(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        dt0: Any,
        y0: Y,
        args: Args,
        saveat: dfx.SaveAt,
        controller: dfx.AbstractStepSizeController,
    ) -> Ready:
        """As `prepare`, with the first step that `mj.diffeqsolve` begins with where there is no hook."""
        dtype = time_dtype(t0, t1, dt0, saveat)
        start = StartInfo(jnp.zeros((), dtype), jnp.asarray(True))
        t0, t1, y0 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype), as_state(y0, dtype)
        if dt0 is None and isinstance(self.inner, AbstractRosenbrock):
            first = chosen_first_step(terms, self.inner, t0, t1, y0, args, controller)
            dt0 = None if first is None else first.size
        return Ready(t0, t1, dt0, y0, None, start)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
        if isinstance(self.inner, AbstractRosenbrock):
            return HookState.initial(None, t0, t1, y0)
        memory = WrittenOut(self.inner).initial_memory(terms, _frame(y0, terms), t0, t1, y0, args)
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
        if isinstance(self.inner, AbstractRosenbrock):
            solver = dataclasses.replace(self.inner, largest_written_out=LARGEST_STIFF)
            state = RosenbrockState(solver_state.first_step, None, jnp.asarray(True))
            y1, error, dense_info, _, result = solver.step(
                terms, t0, t1, y0, args, state, made_jump
            )
            return y1, error, dense_info, dataclasses.replace(solver_state, result=result), result
        execution, memory = WrittenOut(self.inner), solver_state.memory
        step = execution.step(terms, _frame(y0, terms), t0, t1, y0, args, memory, made_jump)
        return conclude(step, t0, t1, solver_state, bounds_error=False)


def _frame(y0: Y, terms: Any) -> Frame:
    return Frame.of_state(y0, terms, lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True))))
