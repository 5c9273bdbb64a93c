"""Location of events after the solve: of several in one step, the first one ends it."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from diffrax import RESULTS
from jaxtyping import Array, Bool, Float

from .._base.closure import convert_closure
from .._base.compat import (
    Ending,
    LastStep,
    nonlinear_failure,
    Progress,
    SaveState,
    time_direction,
    unvmap_any,
    update_result,
)
from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .._linalg.newton import root_of_step
from .._resets.controller import state_of_resets
from .._resets.terminating import has_happened
from .._solver.base import AbstractManifoldSolver


class LocatingAdjoint(dfx.AbstractAdjoint):
    """Wraps the adjoint of a solve with events that have a root finder.

    Diffrax looks for the root of a single event, the first one in the order of `cond_fn` whose sign has
    changed in the last step. Here the roots of all events whose sign has changed are found, and the
    earliest ends the solve. The derivative of its time is that of the implicit function.
    """

    adjoint: dfx.AbstractAdjoint

    def loop(self, *, event: Any, **given: Any) -> Any:
        unlocated = dfx.Event(event.cond_fn, None, event.direction)
        final_state, statistics = self.adjoint.loop(event=unlocated, **given)
        progress, old = Progress.of(final_state), Ending.of(final_state)
        jump = last_jump(final_state)
        last_step = _EventsInStep(event, LastStep.of(final_state), given, jump)
        located = last_step.happened & (progress.num_steps > 0)
        new = lax.cond(
            unvmap_any(located),
            lambda: _ending(old, progress.num_accepted_steps, last_step, located),
            lambda: old,
        )
        return new.put_into(final_state), statistics


# Keyword arguments that Diffrax passes to an event function, besides time, state and `args`.
EVENT_KEYWORDS = ("saveat", "solver", "terms", "t0", "t1", "dt0", "stepsize_controller")
EVENT_KEYWORDS += ("max_steps",)


class _EventsInStep:
    """The step in which a solve ended, and the events in it."""

    def __init__(
        self, event: dfx.Event, step: LastStep, given: dict[str, Any], jump: "JumpAtEnd | None"
    ):
        self.args, self.root_finder = given["args"], event.root_finder
        self.given = {name: given[name] for name in EVENT_KEYWORDS}
        self.events = jtu.tree_leaves(event.cond_fn, is_leaf=callable)
        self.directions = jtu.tree_leaves(event.direction, is_leaf=lambda x: x is None)
        self.after = [jnp.asarray(v) for v in jtu.tree_leaves(step.values)]
        self.mask = jnp.stack(jtu.tree_leaves(step.mask))
        self.happened = jnp.any(self.mask)
        self.start = step.start
        if jump is None:  # otherwise the step may begin at a reset
            self.start = lax.stop_gradient(step.start)
        self.end = lax.stop_gradient(step.end)
        self.interpolation = given["solver"].interpolation_cls(
            t0=self.start, t1=self.end, **step.dense_info
        )
        self.jump = jump

    def first(self) -> tuple[FloatScalar, Y, Bool[Array, " events"], RESULTS]:
        """Return the time of the first event and the state there, which one it was, and whether its root
        was found. An event whose sign was changed by a reset is at the time of that."""
        if self.jump is None:
            changed = self._changed() if len(self.events) > 1 else self.mask
            return self._first_of(changed)
        inside = self._changed()
        jumped = self.jump.at_end & ~jnp.any(inside)
        t, y, which, result = self._first_of(jnp.where(jumped, self.mask, inside))
        each = jnp.arange(len(self.events))
        which = jnp.where(jumped, each == jnp.argmax(self.mask), which)
        t = jnp.where(jumped, self.jump.time, t)
        y = jtu.tree_map(lambda a, b: jnp.where(jumped, a, b), self.jump.y, y)
        return t, y, which, RESULTS.where(jumped, RESULTS.successful, result)

    def _first_of(
        self, changed: Bool[Array, " events"]
    ) -> tuple[FloatScalar, Y, Bool[Array, " events"], RESULTS]:
        times, results = jax.vmap(self._root)(jnp.arange(len(self.events)), changed)
        order = jnp.where(changed, lax.stop_gradient(times), jnp.inf)
        i = jnp.argmin(order)
        result = RESULTS.promote(jtu.tree_map(lambda x: x[i], results))
        _, success = self._state(times[i])
        result = update_result(result, RESULTS.where(success, result, nonlinear_failure()))
        y = self.interpolation.evaluate(times[i])
        return times[i], y, jnp.arange(len(self.events)) == i, result

    def _state(self, t: FloatScalar) -> tuple[Y, BoolScalar | bool]:
        """Return the state on the manifold, and whether it could be moved there."""
        solver, y = self.given["solver"], self.interpolation.evaluate(t)
        if not (isinstance(solver, AbstractManifoldSolver) and solver.corrects_output):
            return y, True
        time = t * time_direction(self.given["terms"])
        y, info = solver.correct(time, y, self.args)
        return y, info.success

    def _values(self, t: FloatScalar) -> Float[Array, " events"]:
        """Return the values of the event functions; for Boolean conditions, the time left in the step."""
        y, _ = self._state(t)

        def value(event, after):
            if after.dtype == bool:
                return self.end - t
            return event(t=t, y=y, args=self.args, **self.given).astype(t.dtype)

        return jnp.stack([value(*of) for of in zip(self.events, self.after, strict=True)])

    def _changed(self) -> Bool[Array, " events"]:
        """Return which events have happened in this step, not only the first in their order."""
        before = self._values(self.start)
        if self.jump is None:
            each = zip(before, self.after, self.directions, strict=True)
            return jnp.stack([has_happened(*of) for of in each]) | self.mask
        # Before the jump; a Boolean condition ends the solve after it.
        end = zip(self._values(self.end), self.after, strict=True)
        at_end = self.jump.at_end
        after = [a if a.dtype == bool else jnp.where(at_end, v, a) for v, a in end]
        each = zip(before, after, self.directions, strict=True)
        return jnp.stack([has_happened(*of) for of in each]) & (self.mask | at_end)

    def _root(self, i: IntScalar, changed: BoolScalar) -> tuple[FloatScalar, optx.RESULTS]:
        def value(t, _):  # its root is the end of the step if the event has not happened
            there = self._values(jnp.where(changed, t, self.end))[i]
            return jnp.where(changed, there, self.end - t)

        options = dict(lower=self.start, upper=self.end)
        root = optx.root_find(value, self.root_finder, self.end, options=options, throw=False)  # pyright: ignore[reportArgumentType]

        def step(t):
            there, rate = jax.jvp(lambda t: value(t, None), (t,), (jnp.ones_like(t),))
            return -there / jnp.where(rate == 0, 1, rate)

        at = lax.stop_gradient(root.value)
        return root_of_step(convert_closure(step, at), at), root.result


class JumpAtEnd(NamedTuple):
    """Whether the last step of a solve ended with a reset, and then its time and the state after it."""

    at_end: BoolScalar
    time: FloatScalar
    y: Y


def last_jump(final_state: Any) -> JumpAtEnd | None:
    progress = Progress.of(final_state)
    resets = state_of_resets(progress.controller_state)
    if resets is None:
        return None
    last = jnp.maximum(resets.record.number - 1, 0)
    times = resets.record.rows[0]
    at_end = progress.solver_state.history.after_reset & (resets.record.number > 0)
    return JumpAtEnd(at_end, times[last], progress.y)


def _ending(
    old: Ending, num_accepted: IntScalar, last_step: _EventsInStep, located: BoolScalar
) -> Ending:
    """Return how the solve ends with its first event, if there is one."""
    t, y, first, found = last_step.first()
    mask = jtu.tree_unflatten(jtu.tree_structure(old.event_mask), list(first))

    def saved(sub: dfx.SubSaveAt, state: SaveState) -> SaveState:
        value = sub.fn(t, y, last_step.args)
        empty = jnp.inf * time_direction(last_step.given["terms"])
        return _saved_until(sub, state, num_accepted, (t, value), (empty, jnp.inf))  # pyright: ignore[reportArgumentType]

    is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
    subs = last_step.given["saveat"].subs
    save_state = jtu.tree_map(saved, subs, old.save_state, is_leaf=is_sub)
    result = RESULTS.where(found == RESULTS.successful, old.result, found)
    new = Ending(mask, save_state, result)
    return jtu.tree_map(lambda a, b: jnp.where(located, a, b), new, old)


def _saved_until(
    sub: dfx.SubSaveAt,
    state: SaveState,
    num_accepted: IntScalar,
    end: tuple[FloatScalar, Any],
    empty: tuple[FloatScalar, float],
) -> SaveState:
    """Return the rows before the event, and that of the event if the end is saved."""
    t, value = end
    num_times = 0 if sub.ts is None else jnp.sum(sub.ts <= t)
    # Without the row of the last step.
    num_steps = (num_accepted - 1) // sub.steps if sub.steps else 0
    ends = sub.t1 | (num_accepted % sub.steps == 0) if sub.steps else sub.t1
    count = int(sub.t0) + num_times + num_steps
    row = jnp.arange(len(state.ts))

    def rows(old: Array, new: Any, empty: Any) -> Array:
        spread = lambda where: where.reshape(-1, *[1] * (old.ndim - 1))
        is_end = spread((row == count) & ends)
        rest = jnp.where(is_end, jnp.asarray(new, old.dtype), jnp.asarray(empty, old.dtype))
        return jnp.where(spread(row < count), old, rest)

    return SaveState(
        saveat_ts_index=jnp.asarray(num_times, jnp.result_type(state.saveat_ts_index)),
        ts=rows(state.ts, t, empty[0]),
        ys=jtu.tree_map(lambda old, new: rows(old, new, empty[1]), state.ys, value),
        save_index=jnp.asarray(
            jnp.where(ends, count + 1, count), jnp.result_type(state.save_index)
        ),
    )
