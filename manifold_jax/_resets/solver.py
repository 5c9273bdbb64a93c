"""A solver whose steps end at events, where the state jumps."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from diffrax import RESULTS

from .._base.closure import convert_closure
from .._base.compat import time_direction, update_result
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from .._linalg.newton import without_derivative
from .._solver.base import AbstractManifoldSolver
from .._solver.step.hook_state import memory_of, with_memory
from .conditions import Conditions
from .history import History
from .jump import Jump, jump_at_end, vector_field
from .met import Met, Report
from .samples import SampledConditions, SearchedStep
from .search import EventSearch, Found
from .terminating import TerminatingEvents


class ResetState(eqx.Module):
    """The state of the solver inside, and what is remembered of events."""

    inner: Any
    history: History


class InterpolationToEnd(eqx.Module):
    """Builds the interpolation of a step from its `dense_info`, with the `end` in it: the dense solution
    knows the time of an event instead, which has a derivative, while ends of steps are held fixed."""

    inner: Callable[..., dfx.AbstractLocalInterpolation] = eqx.field(static=True)

    def __call__(self, *, t0, t1, end, **info) -> dfx.AbstractLocalInterpolation:
        del t1
        return self.inner(t0=t0, t1=end, **info)


def with_end(dense_info: dict[str, Any], end: RealScalarLike) -> dict[str, Any]:
    return dict(end=jnp.asarray(end), **dense_info)


class Resetting(dfx.AbstractWrappedSolver):
    """A solver, of Diffrax or a step hook, whose state jumps at events.

    A step in which a condition changes sign is rejected and made again, up to the event; there
    the state that it returns is the one after the jump.
    """

    inner: dfx.AbstractSolver
    conditions: Conditions
    terminating: TerminatingEvents | None
    t0: FloatScalar  # of the solve, in the time of Diffrax
    end: FloatScalar
    room: int = eqx.field(static=True)

    def init(self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> ResetState:
        return self.starting(self.inner.init(terms, t0, t1, y0, args))

    def starting(self, inner_state: Any) -> ResetState:
        count, dtype = len(self.conditions), jnp.result_type(self.t0)
        return ResetState(inner_state, History.initial(count, dtype))

    @eqx.filter_jit  # traced once
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
        memory = memory_of(inner)
        met = self._met(terms, t0, t1, y0, y1, memory, dense_info, history)
        once = jnp.arange(len(self.conditions), dtype=jnp.int32) == met.number
        jumps = met.ends_step & ~met.exhausted
        happened = history.happened + (once & jumps).astype(jnp.int32)
        irregular = history.irregular + (jumps & met.irregular).astype(jnp.int32)
        conditions = met.sides, met.scale, met.rates
        history = History(jumps, *conditions, happened, irregular, jumps & ~met.usable)
        result = update_result(result, met.result)
        report = Report(error, met._replace(memory=None, defined=1.0))
        inner = with_memory(inner, met.memory)
        dense_info = with_end(dense_info, t1)
        return met.after, report, dense_info, ResetState(inner, history), result

    def _met(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Y,
        y1: Y,
        memory: Any,
        dense_info: Any,
        history: History,
    ) -> Met:
        """Look for events in a step, and make the jump of one at its end. Nothing that the search
        depends on has a derivative."""
        given = jnp.asarray(t0), jnp.asarray(t1), y0, y1, dense_info, history
        given = without_derivative(given)
        held = lambda function: without_derivative(convert_closure(function, *given))(*given)

        def sample(*given: Any) -> tuple[SampledConditions, BoolScalar]:
            search, step, history = self._search(terms, *given)
            samples = SampledConditions.of(search.values, search.parts, step)
            return samples, search.may_find(step, samples, history)

        samples, may_find = held(sample)

        def find(*given: Any) -> Found:
            search, step, history = self._search(terms, *given)
            found = search.first(step, samples, history)
            if self.terminating is None:
                return found
            # An event before the reset ends the solve.
            goes_on = ~(found.ends_step & self.terminating.happen_in(step))
            happens, ends_step = found.happens & goes_on, found.ends_step & goes_on
            return found._replace(happens=happens, ends_step=ends_step)

        def look() -> Met:
            found = held(find)
            exhausted = found.ends_step & (jnp.sum(history.happened) >= self.room)
            jumps = found.ends_step & ~exhausted
            ends = jnp.asarray(t0), jnp.asarray(t1)
            jump = self.jump(terms, jumps, found.number, ends, found.time, y1, memory)
            return Met.of(found, exhausted, jump)

        idle = Met.without_event(given[1], y1, memory, history)
        met = lax.cond(may_find, look, lambda: idle)
        return met._replace(defined=~jnp.any(jnp.isnan(samples.values)))

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
        step: tuple[FloatScalar, FloatScalar],
        time: FloatScalar,
        y: Y,
        memory: Any,
    ) -> Jump:
        """Return the jump at the end of a step, or the state as it is without one."""

        def made() -> Jump:
            jump = jump_at_end(self.conditions, self.inner, terms, number, step, time, y)
            if memory is None:
                return jump
            soon = jump.time + jnp.ones_like(time)
            inner = self.inner.init(terms, jump.time, soon, jump.after, self.conditions.args)
            return jump._replace(memory=memory_of(inner))

        return lax.cond(jumps, made, lambda: Jump(time, y, y, jnp.asarray(True), memory))

    def _search(
        self, terms: Any, t0: Any, t1: Any, y0: Y, y1: Y, dense_info: Any, history: History
    ) -> tuple[EventSearch, SearchedStep, History]:
        direction = time_direction(terms)
        # Interpolation in the fraction of the step: the coefficients of samples are then known numbers.
        zero, one = np.zeros((), t0.dtype), np.ones((), t0.dtype)
        path = self.inner.interpolation_cls(t0=zero, t1=one, **dense_info)
        search = EventSearch(
            lambda t, y: self.conditions.values(t * direction, y),
            jnp.asarray(self.conditions.directions, t0.dtype),
            jnp.asarray(self.conditions.is_boolean),
            self.conditions.samples,
            self.end,
            history.happened >= self.conditions.most,
            self.conditions.next_times(self.t0, history.happened, direction),
        )
        field = vector_field(terms, self.conditions.args)
        return search, SearchedStep(t0, t1, y0, y1, path.evaluate, field), history

    @property
    def interpolation_cls(self):  # pyright: ignore
        return InterpolationToEnd(self.inner.interpolation_cls)

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


def inner_state(solver_state: Any) -> Any:
    """Return the state of the solver inside, if it is wrapped."""
    return solver_state.inner if isinstance(solver_state, ResetState) else solver_state
