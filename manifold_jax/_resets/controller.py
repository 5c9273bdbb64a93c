"""Step sizes around events: steps end at them and afterwards go on as before."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .at_start import EventAtStart
from .met import Met, Report
from .record import ResetRecord


# So often a step is shortened for an event before rounding is taken for the reason that it does not end
# there; it is then made to end before the event, by so many units of rounding and more from try to try.
_MOST_ATTEMPTS = 4
_EARLIER = 16


class ResettingState(eqx.Module):
    """The state of the controller inside, the step that was shortened for an event (0 for none) and how
    often, and the resets so far."""

    inner: Any
    shortened: FloatScalar
    shortened_end: FloatScalar
    attempts: IntScalar
    record: ResetRecord


class ResettingController(dfx.AbstractStepSizeController):
    """A step size controller for a [`Resetting`][] solver."""

    controller: dfx.AbstractStepSizeController
    room: int = eqx.field(static=True)

    def wrap(self, direction: Any) -> "ResettingController":
        return ResettingController(self.controller.wrap(direction), self.room)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order) -> tuple[Any, ResettingState]:
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        zero = jnp.zeros_like(t0)
        record = ResetRecord.empty(self.room, t0, y0)
        return first, ResettingState(inner, zero, zero, jnp.zeros((), jnp.int32), record)

    def adapt_step_size(
        self, t0, t1, y0: Y, y1_candidate: Y, args, y_error: Report, error_order, controller_state
    ) -> Any:
        met, state = y_error.met, controller_state
        keep, next_t0, next_t1, made_jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error.error, error_order, state.inner
        )
        at_event = keep & met.ends_step
        aimed = keep & met.happens & ~at_event
        # Sizes have no derivatives; the time of the event has one.
        time, length = lax.stop_gradient((met.time, t1 - t0))
        stops_before, target = _next_end(met, state, jnp.asarray(t0), jnp.asarray(t1))
        stops_before &= aimed
        repeated = aimed & ~stops_before
        resumed = at_event & (state.shortened > 0)
        if has_prescribed_times(self.controller):
            resumed &= state.shortened_end > time
        following = jnp.where(resumed, self._resumed(state, time, next_t1), next_t1)
        following = jnp.where(at_event, jnp.maximum(following, time), following)
        next_t0 = jnp.where(repeated, t0, jnp.where(at_event, met.time, next_t0))
        next_t1 = jnp.where(aimed, target, following)
        if not self._is_clipped:  # the controller inside does not see steps that were shortened
            inner = _where(resumed, state.inner, inner)
        inner = _where(aimed, state.inner, inner)
        first = repeated & (state.shortened == 0)
        ends_search = keep & ~aimed & ~at_event
        kept = jnp.where(ends_search, 0, state.shortened)
        shortened = jnp.where(first, length, kept)
        end = jnp.where(first, lax.stop_gradient(t1), state.shortened_end)
        attempts = jnp.where(repeated, state.attempts + 1, 0)
        record = state.record.including(at_event, met)
        state = ResettingState(inner, shortened, end, attempts, record)
        return keep & ~repeated, next_t0, next_t1, made_jump, state, result

    @property
    def _is_clipped(self) -> bool:
        return isinstance(_innermost(self.controller), dfx.ClipStepSizeController)

    def _resumed(self, state: ResettingState, time: FloatScalar, suggested: Any) -> FloatScalar:
        """Return the end of the step after an event: as long as the one that was shortened for it, or with
        prescribed times of steps to the same end."""
        if self._is_clipped:
            return suggested
        if has_prescribed_times(self.controller):
            return state.shortened_end
        return time + state.shortened


def _next_end(
    met: Met, state: ResettingState, t0: FloatScalar, t1: FloatScalar
) -> tuple[BoolScalar, FloatScalar]:
    """Return for a step with an event that is not at its end whether it is kept nevertheless, and where the
    next one ends.

    A step is made again to end at the event. If rounding keeps steps from ending there it is made to end
    just before it, and the step after it says that the event is at its start.
    """
    t0, t1 = lax.stop_gradient((t0, t1))
    gives_up = (state.attempts >= _MOST_ATTEMPTS) & (met.target >= t0)
    part = _EARLIER * jnp.finfo(t1.dtype).eps
    part *= 4.0 ** (state.attempts - _MOST_ATTEMPTS).astype(t1.dtype)
    target = jnp.where(gives_up, met.target - part * (t1 - t0), met.target)
    stops_before = gives_up & (met.target >= t1)
    told = EventAtStart(stops_before, met.number, met.irregular, crosses=jnp.asarray(True))
    told_by = told.end_of_step(t1, met.sides.size)
    return stops_before, jnp.where(stops_before, told_by, target)


def has_prescribed_times(controller: Any) -> bool:
    """Whether the times at which steps end are prescribed, not chosen."""
    return isinstance(_innermost(controller), dfx.ConstantStepSize | dfx.StepTo)


def _innermost(controller: Any) -> Any:
    """Return the user's controller, inside the wrapper of an adjoint."""
    known = dfx.PIDController | dfx.ClipStepSizeController | dfx.ConstantStepSize | dfx.StepTo
    while not isinstance(controller, known) and hasattr(controller, "controller"):
        controller = controller.controller
    return controller


def _where(condition: Any, a: Any, b: Any) -> Any:
    select = lambda x, y: jnp.where(condition, x, y) if eqx.is_array(y) else y
    return jtu.tree_map(select, a, b)


def state_of_resets(controller_state: Any) -> ResettingState | None:
    """Return the state of the controller of a solve with resets."""
    return controller_state if isinstance(controller_state, ResettingState) else None


def record_of_resets(controller_state: Any) -> ResetRecord:
    assert isinstance(controller_state, ResettingState)
    return controller_state.record
