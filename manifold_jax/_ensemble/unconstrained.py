"""An explicit solver of Diffrax alone, as lanes advance it."""

from typing import Any, ClassVar

import diffrax as dfx
import jax.numpy as jnp
from diffrax import RESULTS

from .._constraint import AbstractConstraint
from .._custom_types import Args, RealScalarLike, Residual, Y
from .._interpolation import CorrectedInterpolationFactory
from .._projection import NewtonProjection
from .._projection_info import ProjectionInfo
from .._solve.prepare import as_state, Ready, time_dtype
from .._solve.start import StartInfo
from .._solver.advance import conclude, HookState
from .._solver.base import AbstractManifoldSolver
from .._solver.execution import WrittenOut
from .._solver.frame import Frame


class Everywhere(AbstractConstraint):
    """The whole space."""

    redundant: ClassVar[bool] = False

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return jnp.zeros(0)


class Unconstrained(AbstractManifoldSolver):
    """An explicit Runge-Kutta method, whose steps are what they are: the stages written out, but
    nothing corrected, nor rejected that Diffrax would keep."""

    inner: dfx.AbstractSolver
    constraint: Everywhere = Everywhere()
    projection: NewtonProjection = NewtonProjection()
    bends_interpolant: bool = False
    bounds_error: bool = False
    corrects_output: ClassVar[bool] = False

    @property
    def interpolation_cls(self):  # pyright: ignore
        return CorrectedInterpolationFactory(self.inner.interpolation_cls, False)

    def ready(self, t0: Any, t1: Any, dt0: Any, y0: Y, saveat: dfx.SaveAt) -> Ready:
        """As `prepare`: the first step is left to the controller, as `mj.diffeqsolve` does without a hook."""
        dtype = time_dtype(t0, t1, dt0, saveat)
        start = StartInfo(jnp.zeros((), dtype), jnp.asarray(True))
        t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
        return Ready(t0, t1, dt0, as_state(y0, dtype), None, start)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> HookState:
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
        execution, memory = WrittenOut(self.inner), solver_state.memory
        step = execution.step(terms, _frame(y0, terms), t0, t1, y0, args, memory, made_jump)
        return conclude(step, t0, t1, solver_state, bounds_error=False)


def _frame(y0: Y, terms: Any) -> Frame:
    return Frame.of_state(y0, terms, lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True))))
