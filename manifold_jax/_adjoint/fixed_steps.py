"""Forward mode at the steps that were made, as in reverse mode: their ends are those of the record and
are held fixed, except for the end of the solve and the times that the controller prescribes."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._base.compat import LoopState, Progress, with_controller_state, with_next_time
from .._base.types import IntScalar
from .._linalg.newton import without_derivative
from .._resets.controller import has_prescribed_times, ResettingController
from .prescribed import prescribed_times, with_prescribed
from .record import Record


class SizesHeldFixed(dfx.AbstractStepSizeController):
    """Wraps a controller; the step sizes it chooses have no derivatives."""

    controller: dfx.AbstractStepSizeController

    def wrap(self, direction: Any) -> "SizesHeldFixed":
        return SizesHeldFixed(self.controller.wrap(direction))

    def init(self, *args: Any) -> Any:
        return self.controller.init(*args)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state) -> Any:
        fixed = without_derivative((t0, t1, y0, y1_candidate, args, y_error, error_order, state))
        controller = without_derivative(self.controller)
        keep, next_t0, next_t1, jump, state, result = controller.adapt_step_size(*fixed)
        # A step begins at the end of the one before, which may be the end of the solve, or after a jump.
        moved = lambda t: with_prescribed(prescribed_times(self.controller, t.dtype), t)
        begun = moved(next_t0)
        start = jnp.where(next_t0 == fixed[1], t1, jnp.where(next_t0 == fixed[0], t0, begun))
        return keep, start, moved(next_t1), jump, state, result


class MadeSteps(eqx.Module):
    """The steps of a solve, rejected ones included, in their order."""

    starts: Float[Array, " steps"]  # infinite after the last step
    ends: Float[Array, " steps"]  # negative infinity for rejected steps
    after_jump: Bool[Array, " steps"]

    @staticmethod
    def none(record: Record) -> "MadeSteps":
        """Return what a solve is given that is not a repetition."""
        steps = record.sizes.blocks * record.sizes.block
        infinite = jnp.full(steps, jnp.inf, jnp.result_type(record.times))
        return MadeSteps(infinite, -infinite, jnp.zeros(steps, bool))

    @staticmethod
    def of(record: Record) -> "MadeSteps":
        columns = lax.stop_gradient(jnp.asarray(record.times))
        columns = columns.reshape(-1, columns.shape[-1]).T
        starts = jnp.where(columns[0] > -jnp.inf, columns[0], jnp.inf)
        after_jump = columns[2] > 0 if record.jumps else jnp.zeros(len(starts), bool)
        return MadeSteps(starts, columns[1], after_jump)


class Choice(NamedTuple):
    """What a controller chooses after a step; whether it is that of a solve that was made already, and
    whether that made no more steps."""

    keep: Bool[Array, ""]
    start: Float[Array, ""]
    end: Float[Array, ""]
    after_jump: Bool[Array, ""]
    repeats: Bool[Array, ""]
    none_left: Bool[Array, ""]


@jax.custom_jvp
def _first_end(own: Any, made: MadeSteps) -> Any:
    """Return where the first step ends; in forward mode as the record says."""
    return own


@_first_end.defjvp
def _first_end_made(primals: Any, tangents: Any) -> tuple[Any, Any]:
    own, made = primals
    return jnp.where(made.ends[0] > -jnp.inf, made.ends[0], own), jnp.zeros_like(tangents[0])


@jax.custom_jvp
def _choice(own: Choice, step: tuple[Any, Any], number: IntScalar, made: MadeSteps) -> Choice:
    """Return the controller's own choice after the step `number`, but in forward mode, which repeats a solve,
    that of the record.

    The repeated step is rounded differently. Where errors are as small as rounding, the next one would
    have quite another size, while values saved at the ends of steps and events in them are those of
    the first solve. Rejected steps are repeated, too, from which second derivatives know the rows of
    the record; where such a step ends does not matter.
    """
    return own


@_choice.defjvp
def _choice_made(primals: Any, tangents: Any) -> tuple[Choice, Any]:
    own, (t0, t1), number, made = primals
    keep = made.ends[number] > -jnp.inf
    following = jnp.minimum(number + 1, len(made.starts) - 1)
    none_left = (following == number) | (made.starts[following] == jnp.inf)
    end = jnp.where(made.ends[following] > -jnp.inf, made.ends[following], own.end)
    choice = Choice(
        keep,
        jnp.where(none_left, jnp.where(keep, t1, t0), made.starts[following]),
        jnp.where(none_left, t1, end),
        made.after_jump[following] & ~none_left,
        jnp.ones_like(none_left),
        none_left,
    )
    return choice, jtu.tree_map(jnp.zeros_like, tangents[0])


class Numbered(eqx.Module):
    """The state of a controller, and the number of steps so far."""

    inner: Any
    steps: IntScalar

    @staticmethod
    def first(inner: Any) -> "Numbered":
        return Numbered(inner, jnp.zeros((), jnp.int32))


class StepsOfRecord(dfx.AbstractStepSizeController):
    """Wraps a controller; in forward mode the steps are those that were made. Its state is [`Numbered`][]."""

    controller: SizesHeldFixed
    made: MadeSteps
    end: Any  # of the solve

    def wrap(self, direction: Any) -> "StepsOfRecord":
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, *args: Any) -> Any:
        first, inner = self.controller.init(*args)
        return first, Numbered.first(inner)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state) -> Any:
        step = t0, t1, y0, y1_candidate, args, y_error, error_order
        keep, start, end, after_jump, inner, result = self.controller.adapt_step_size(
            *step, state.inner
        )
        own = Choice(*map(jnp.asarray, (keep, start, end, after_jump, False, False)))
        own, ends = without_derivative((own, (t0, t1)))
        # Not zero derivatives but none: a Brownian motion refuses any with respect to its times.
        choice = without_derivative(_choice(own, ends, state.steps, self.made))
        times = prescribed_times(self.controller.controller, choice.end.dtype)
        begun = with_prescribed(times, choice.start)
        start = jnp.where(choice.start == t1, t1, jnp.where(choice.start == t0, t0, begun))
        end = jnp.where(choice.end == self.end, self.end, with_prescribed(times, choice.end))
        if after_jump is not False:
            after_jump = choice.after_jump
        RESULTS = dfx.RESULTS
        unfinished = choice.none_left & (start < self.end)
        of_record = RESULTS.where(unfinished, RESULTS.max_steps_reached, RESULTS.successful)
        result = RESULTS.where(choice.repeats, of_record, result)
        return choice.keep, start, end, after_jump, Numbered(inner, state.steps + 1), result


def numbered(controller: Any, state: LoopState) -> LoopState:
    """Return the state of a solve before its first step, as this controller needs it."""
    if not isinstance(controller, StepsOfRecord):
        return state
    inner = Progress.of(state).controller_state
    return with_controller_state(state, Numbered.first(inner))


def unnumbered(state: LoopState) -> LoopState:
    """Return the final state of a solve as Diffrax knows it."""
    numbered = Progress.of(state).controller_state
    return with_controller_state(state, numbered.inner) if isinstance(numbered, Numbered) else state


def with_steps_held_fixed(
    controller: dfx.AbstractStepSizeController, made: MadeSteps | None, end: Any
) -> dfx.AbstractStepSizeController:
    """Return a controller whose steps have no derivatives, and in forward mode are those that were made
    where it chose their sizes; the times of resets have derivatives."""
    if isinstance(controller, ResettingController):
        # These look for the resets again, and end steps where they are found.
        inside = SizesHeldFixed(controller.controller)
        return eqx.tree_at(lambda c: c.controller, controller, inside)
    fixed = SizesHeldFixed(controller)
    if made is None or has_prescribed_times(controller):
        return fixed
    return StepsOfRecord(fixed, made, end)


def with_end_held_fixed(
    state: LoopState, t1: Any, made: MadeSteps | None, prescribed: Any
) -> LoopState:
    """Hold the end of the first step fixed, unless it is the end of the solve or one of the prescribed times."""
    tnext = lax.stop_gradient(Progress.of(state).tnext)
    first = tnext if made is None else without_derivative(_first_end(tnext, made))
    return with_next_time(state, jnp.where(first == t1, t1, with_prescribed(prescribed, first)))


def event_of_controller(
    event: dfx.Event | None, controller: dfx.AbstractStepSizeController
) -> dfx.Event | None:
    """Return the event with the original controller, whose tolerances Diffrax's own event functions ask
    for, instead of the wrapped one. (`mj.diffeqsolve` tells them by itself, `diffrax.diffeqsolve` not.)"""
    if event is None:
        return None

    own = {"stepsize_controller": controller}
    wrap = lambda cond_fn: lambda *args, **kwargs: cond_fn(*args, **kwargs | own)
    cond_fn = jtu.tree_map(wrap, event.cond_fn, is_leaf=callable)
    return dfx.Event(cond_fn, event.root_finder, event.direction)
