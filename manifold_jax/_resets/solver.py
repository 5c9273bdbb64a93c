"""A solver whose steps end at events, where the state jumps."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.compat import nonlinear_failure, time_direction, update_result
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from .._linalg.newton import without_derivative
from .._solver.base import AbstractManifoldSolver
from .conditions import Conditions
from .jump import Jump, jump_at_end
from .search import Found, History, Search, Step


class Report(NamedTuple):
    """The error estimate of a step, and what the step size controller has to know of the event in it.
    Diffrax hands it on as the error estimate; all its leaves are real numbers."""

    error: Y | None
    happens: Float[Array, ""]  # 1 if there is an event in the step or just after it
    ends_step: Float[Array, ""]  # 1 if it is at the end of the step
    number: Float[Array, ""]
    target: FloatScalar
    time: FloatScalar
    before: Y
    after: Y


class ResetState(eqx.Module):
    """The state of the solver inside, and what is remembered of events."""

    inner: Any
    history: History


class Resetting(dfx.AbstractWrappedSolver):
    """A solver, of Diffrax or a step hook, whose state jumps at events.

    A step in which a condition changes sign is rejected and made again, up to the event; there
    the state that it returns is the one after the jump.
    """

    inner: dfx.AbstractSolver
    conditions: Conditions
    t0: FloatScalar  # of the solve, in the time of Diffrax
    end: FloatScalar
    max_resets: int = eqx.field(static=True)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> ResetState:
        return self.starting(self.inner.init(terms, t0, t1, y0, args))

    def starting(self, inner_state: Any) -> ResetState:
        count, dtype = len(self.conditions), jnp.result_type(self.t0)
        return ResetState(inner_state, History.initial(count, dtype))

    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: ResetState,
        made_jump: Any,
    ) -> tuple[Y, Report, dict[str, Any], ResetState, RESULTS]:
        y1, error, dense_info, inner, result = self.inner.step(
            terms, t0, t1, y0, args, solver_state.inner, made_jump
        )
        y1 = self.end_of_step(t0, t1, y0, y1)
        history = solver_state.history
        found = self._search(terms, t0, t1, y0, y1, dense_info, history)
        total = jnp.sum(history.happened)
        exhausted = found.ends_step & (total >= self.max_resets)
        jumps = found.ends_step & ~exhausted
        jump = self.jump(terms, jumps, found.number, jnp.asarray(t1), found.time, y1)
        result = update_result(result, _result(found, jump, exhausted))
        once = jnp.arange(len(self.conditions), dtype=jnp.int32) == found.number
        happened = history.happened + (once & jumps).astype(jnp.int32)
        history = History(jumps, found.sides, happened)
        real = lambda x: jnp.asarray(x, found.target.dtype)
        report = Report(
            error,
            real(found.happens),
            real(jumps | exhausted),
            real(found.number),
            found.target,
            jump.time,
            jump.before,
            jump.after,
        )
        return jump.after, report, dense_info, ResetState(inner, history), result

    def end_of_step(self, t0: RealScalarLike, t1: RealScalarLike, y0: Y, y1: Y) -> Y:
        """Return the state at the end of a step; one of negative length only says that an event is at its
        start."""
        backwards = jnp.asarray(t1) < t0
        return jtu.tree_map(lambda a, b: jnp.where(backwards, a, b), y0, y1)

    def jump(
        self,
        terms: Any,
        jumps: BoolScalar,
        number: IntScalar,
        end: FloatScalar,
        time: FloatScalar,
        y: Y,
    ) -> Jump:
        """Return the jump at the end of a step, or the state as it is without one."""
        return lax.cond(
            jumps,
            lambda: jump_at_end(self.conditions, self.inner, terms, number, end, time, y),
            lambda: Jump(time, y, y, jnp.asarray(True)),
        )

    def _search(
        self, terms: Any, t0: Any, t1: Any, y0: Y, y1: Y, dense_info: Any, history: History
    ) -> Found:
        """Look for events in a step; nothing that this depends on has a derivative."""
        direction = time_direction(terms)

        def search(t0, t1, y0, y1, dense_info, history) -> Found:
            path = self.inner.interpolation_cls(t0=t0, t1=t1, **dense_info)
            plain = self._plain_solver.interpolation_cls(t0=t0, t1=t1, **dense_info)
            step = Step(t0, t1, y0, y1, path.evaluate, plain.evaluate)
            known = self.conditions.next_times(self.t0, history.happened, direction)
            return Search(
                lambda t, y: self.conditions.values(t * direction, y),
                jnp.asarray(self.conditions.directions, t0.dtype),
                jnp.asarray(self.conditions.is_boolean),
                self.conditions.samples,
                self.end,
                history.happened >= self.conditions.most,
                known,
            ).first(step, history)

        given = jnp.asarray(t0), jnp.asarray(t1), y0, y1, dense_info, history
        given = without_derivative(given)
        return without_derivative(convert_closure(search, *given))(*given)

    @property
    def _plain_solver(self) -> Any:
        if not isinstance(self.inner, AbstractManifoldSolver):
            return self.inner
        return eqx.tree_at(lambda s: s.bends_interpolant, self.inner, False)

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.inner.interpolation_cls

    # Diffrax looks at the type and at some attributes of the innermost solver.
    @property
    def solver(self) -> dfx.AbstractSolver:  # pyright: ignore
        return self.inner.solver if isinstance(self.inner, AbstractManifoldSolver) else self.inner

    @property
    def term_structure(self):  # pyright: ignore
        return self.inner.term_structure

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore
        return self.inner.term_compatible_contr_kwargs

    @property
    def root_finder(self):
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps  # pyright: ignore

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


def _result(found: Found, jump: Jump, exhausted: BoolScalar) -> RESULTS:
    result = RESULTS.where(jump.success, RESULTS.successful, nonlinear_failure())
    result = RESULTS.where(exhausted, RESULTS.max_steps_reached, result)  # pyright: ignore[reportArgumentType]
    return RESULTS.where(found.defined, result, RESULTS.nonfinite_input)  # pyright: ignore[reportArgumentType]
