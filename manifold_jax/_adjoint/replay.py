"""A solve as functions of single steps and of the values saved in them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.closure import convert_closure
from .._base.compat import Differentiable, LoopState, Progress, start_of_last, with_resets_put
from .._base.types import Args, FloatScalar, IntScalar, RealScalarLike, Y
from .._constraint.projection_info import ProjectionInfo
from .._resets.controller import ResettingController, state_of_resets
from .._resets.solver import inner_state, ResetState, Resetting, with_end
from .._solver.base import AbstractManifoldSolver
from .._solver.step.execution import execution_of, ExplicitStep
from .._solver.step.frame import StepFrame
from .._solver.step.hook_state import memory_of, with_memory


class State(NamedTuple):
    """Everything that a step depends on: the state of the equation, and the solver's memory."""

    y: Y
    memory: Any


class ResetOutputs(NamedTuple):
    """The times of resets and the states before and after them; where the last step begins, with events."""

    rows: Any
    last_start: FloatScalar | None


class Event(NamedTuple):
    """The time of an event, which has a derivative, and the states before and after it."""

    time: FloatScalar
    before: Y
    after: Y


class Saving(eqx.Module):
    """One `SubSaveAt`: which rows it has, and the functions that compute them."""

    offset: int = eqx.field(static=True)  # 1 if the first row is that of `t0`, else 0
    num_times: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    end: bool = eqx.field(static=True)
    at_state: Callable  # (t, y)
    in_step: Callable | None  # (t, start, end, dense_info)


class Replay(eqx.Module):
    """A solve as functions of single steps, pytrees whose leaves are the arrays that they close over."""

    step: Callable  # (start, end, jumped, reset, state) -> next state, dense_info or None, event or None
    savings: list[Saving]

    @staticmethod
    def build(solve: "Solve", saveat: dfx.SaveAt, t: Array, start: State, dense: bool) -> "Replay":
        """Build the functions; `t` and `start` are examples, `dense` whether `dense_info` is needed."""
        subs = subs_of(saveat)
        interpolates = dense or any(sub.ts is not None for sub in subs)

        def step(start, end, jumped, reset, state):
            after, dense_info = solve.attempt(start, end, jumped, state)
            after, event = solve.reset(start, end, reset, state, after)
            if solve.resetting is not None:
                dense_info = with_end(dense_info, end)
            return after, dense_info if interpolates else None, event

        jumped, reset = t != t if solve.jumps else False, None
        if solve.resetting is not None:
            reset = jnp.zeros((), jnp.int32)
        example = t, t, jumped, reset, start
        step = convert_closure(step, *example)
        _, dense_info, _ = eqx.filter_eval_shape(step, *example)

        def saving(sub: dfx.SubSaveAt) -> Saving:
            def at_state(t, y):
                return sub.fn(t, y, solve.args)

            def in_step(t, start, end, dense_info):
                solver = solve.solver if solve.resetting is None else solve.resetting
                interpolation = solver.interpolation_cls(t0=start, t1=end, **dense_info)
                return at_state(t, interpolation.evaluate(t))

            times = t, t, t
            between = None if sub.ts is None else convert_closure(in_step, *times, dense_info)
            num_times = 0 if sub.ts is None else len(sub.ts)
            at_end = (
                sub.t1 and sub.steps != 1
            )  # if every step is saved, the last row is one of those
            at_state_ = convert_closure(at_state, t, start.y)
            return Saving(int(sub.t0), num_times, sub.steps, at_end, at_state_, between)

        return Replay(step, [saving(sub) for sub in subs])


class Solve(NamedTuple):
    """The arguments that all steps have in common."""

    terms: Any
    solver: dfx.AbstractSolver
    args: Args
    solver_state: Any  # that of the first step, for the parts that steps do not depend on
    remembers: bool  # whether steps begin with the memory of the step before
    jumps: bool  # whether steps may begin after jumps of the field
    resetting: Resetting | None = None  # if the state may jump at events

    @staticmethod
    def of(
        terms: Any,
        solver: Any,
        args: Args,
        init_state: LoopState,
        controller: Any,
        memory_is_used: bool,
    ) -> "Solve":
        """Describe a solve; `memory_is_used` says whether anything but the next step depends on the
        memory after a step, or the first step on a memory from elsewhere. If not, steps of explicit
        methods evaluate the field at their start again: then the field at their end, which would be
        remembered, need not be differentiated."""
        begin, resetting = Progress.of(init_state), None
        if isinstance(solver, Resetting):
            resetting, solver = solver, solver.inner
        example = begin.tprev, begin.tnext, begin.y, args
        if isinstance(solver, AbstractManifoldSolver):
            execution = solver.execution(solver.prepare_terms(terms), *example)
            remembers = memory_is_used or not isinstance(execution, ExplicitStep)
        else:  # the step of a solver of Diffrax itself is written out, and then has no memory
            remembers = not isinstance(execution_of(solver, terms, *example), ExplicitStep)
        jumps = may_jump(controller, begin.made_jump)
        solver_state = lax.stop_gradient(begin.solver_state)
        solver_state = inner_state(solver_state)
        return Solve(terms, solver, args, solver_state, remembers, jumps, resetting)

    def state(self, loop_state: LoopState) -> State:
        now = Progress.of(loop_state)
        return State(now.y, memory_of(inner_state(now.solver_state)) if self.remembers else None)

    def attempt(
        self, start: RealScalarLike, end: RealScalarLike, jumped: Any, state: State
    ) -> tuple[State, Any]:
        """Return the state after a step, and the data of its interpolation."""
        terms, solver, args, y = self.terms, self.solver, self.args, state.y
        if not self.remembers and not isinstance(solver, AbstractManifoldSolver):
            unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True)))
            frame = StepFrame.of_state(y, terms, unchanged)
            step = ExplicitStep(solver).step(terms, frame, start, end, y, args, None, False)
            return State(step.y1, None), step.dense_info
        solver_state = with_memory(self.solver_state, state.memory)
        y1, _, dense_info, solver_state, _ = solver.step(
            terms, start, end, y, args, solver_state, jumped
        )
        return State(y1, memory_of(solver_state) if self.remembers else None), dense_info

    def reset(
        self, start: Any, end: Any, number: IntScalar | None, state: State, after: State
    ) -> tuple[State, Event | None]:
        """Return the state after the reset at the end of a step, and its event; `number` is -1 where there
        is none."""
        if self.resetting is None or number is None:
            return after, None
        y = self.resetting.end_of_step(start, end, state.y, after.y)
        which = jnp.maximum(number, 0)
        jump = self.resetting.jump(
            self.terms, number >= 0, which, (start, end), end, y, after.memory
        )
        return State(jump.after, jump.memory), Event(jump.time, jump.before, jump.after)


def subs_of(saveat: dfx.SaveAt) -> list[dfx.SubSaveAt]:
    return jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))


def may_jump(controller: Any, made_jump: Any) -> bool:
    if made_jump is not False:
        return True
    while isinstance(controller, dfx.ClipStepSizeController):
        if controller.jump_ts is not None:
            return True
        controller = controller.controller
    if isinstance(controller, ResettingController):
        return may_jump(controller.controller, made_jump)
    known = dfx.ConstantStepSize | dfx.StepTo | dfx.PIDController
    return not isinstance(controller, known)


def outputs_of(final_state: LoopState, remembers: bool) -> Differentiable:
    """Return the differentiable part of a final state; of the solver's state, what steps depend on."""
    found = Differentiable.of(final_state)
    memory = memory_of(inner_state(found.solver_state)) if remembers else None
    resets = state_of_resets(Progress.of(final_state).controller_state)
    if resets is not None:
        found = found._replace(resets=ResetOutputs(resets.record.rows, start_of_last(final_state)))
    return found._replace(solver_state=memory)


def with_outputs(final_state: LoopState, outputs: Differentiable) -> LoopState:
    given = Differentiable.of(final_state).solver_state
    memory = outputs.solver_state
    solver_state = given if memory is None else _with_memory(given, memory)
    new = outputs._replace(solver_state=solver_state).put_into(final_state)
    resets = state_of_resets(Progress.of(new).controller_state)
    if resets is None:
        return new
    resets = eqx.tree_at(lambda s: s.record.rows, resets, outputs.resets.rows)
    return with_resets_put(new, resets, outputs.resets.last_start)


def _with_memory(solver_state: Any, memory: Any) -> Any:
    inner = with_memory(inner_state(solver_state), memory)
    if isinstance(solver_state, ResetState):
        return dataclasses.replace(solver_state, inner=inner)
    return inner
