"""The first event in a step, found by the signs of its conditions at samples of dense output."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .at_start import EventAtStart
from .bracket import root_in_bracket
from .history import History
from .samples import BEYOND, SampledConditions, SearchedStep
from .sensitivity import Sensitivity
from .simultaneous import (
    end_of_step,
    is_same_time,
    rounding_of_events,
    rounding_of_times,
    time_after,
)


class Found(NamedTuple):
    """The first event in or just after a step."""

    happens: BoolScalar
    ends_step: BoolScalar  # whether this step ends there
    irregular: BoolScalar  # whether it has no derivative: several at one time, or only touched
    number: IntScalar  # of the reset
    target: FloatScalar  # where a step has to end so that the event is at its end
    time: FloatScalar  # of the event, if it is at the end of this step
    sides: Float[Array, " resets"]  # of the conditions just before the jump, as in [`History`][]
    scale: Float[Array, " resets"]
    rates: Float[Array, " resets"]


class EventSearch(NamedTuple):
    """The settings of a search: the values of the conditions at a time of Diffrax, and their kinds."""

    values: Callable[[FloatScalar, Y], Float[Array, " resets"]]
    directions: Float[Array, " resets"]  # 1, -1, or 0 for both
    is_boolean: Bool[Array, " resets"]
    parts: int
    end: FloatScalar  # of the solve
    ignored: Bool[Array, " resets"]
    known_times: Float[Array, " resets"]  # the next one; infinity for conditions

    @property
    def is_known(self) -> Bool[Array, " resets"]:
        return jnp.isfinite(self.known_times)

    def may_find(
        self, step: SearchedStep, samples: SampledConditions, history: History
    ) -> BoolScalar:
        """Whether the step needs to be looked at: most steps have no event."""
        signs = jnp.sign(samples.values)
        changes = jnp.any(self._crosses(signs[:-1], signs[1:]))
        is_known = jnp.any(self.known_times <= step.t1 + BEYOND * step.length)
        return changes | is_known | step.is_negative | jnp.any(history.remembers)

    def first(self, step: SearchedStep, samples: SampledConditions, history: History) -> Found:
        """Return the first event of a step."""
        sensitivity = Sensitivity.of(self.values, self.is_boolean, step)
        noise, rate = sensitivity.noise, sensitivity.rate
        small = jnp.maximum(4 * noise, 1e3 * jnp.finfo(noise.dtype).eps * history.scale)
        before, start, on_surface = self._start(step, samples, rate, history, small)
        # A jump changed the sign, or the state leaves the surface on which it began: at once.
        leaves = (before != 0) & (start != 0) & self._crosses(before, start)
        first = _first_sign(samples.inside, small)
        rests = on_surface & (start == 0) & self._crosses(-first, first)
        # One that touched zero goes back to where it came from.
        rests &= ~(jnp.isnan(history.sides) & (jnp.sign(history.rates) == -first))
        at_once = jnp.where(self.is_known, self.known_times <= step.t0, leaves | rests)
        largest = jnp.max(jnp.abs(samples.inside), axis=0)
        stays = on_surface & (largest <= small)  # in a step so short that its values are rounding
        signs = jnp.where(stays, start, jnp.sign(samples.values).at[0].set(start))
        crossings = self._crosses(signs[:-1], signs[1:])
        place, found = jnp.argmax(crossings, axis=0), jnp.any(crossings, axis=0)
        roots = self._roots(step, samples, place, found & ~at_once, on_surface)
        hop, is_short = sensitivity.hop(step.length, largest)
        hops = on_surface & ~at_once & is_short & self._crosses(start, -start)
        roots = jnp.where(hops, step.t0 + hop, roots)
        roots = jnp.where(self.is_known, self.known_times, roots)
        roots = jnp.where(at_once, step.t0, roots)
        is_far = (roots > step.t1 + BEYOND * step.length) & ~at_once
        at_end = roots >= self.end - 200 * rounding_of_times(
            step
        )  # of the solve, where nothing happens any more
        roots = jnp.where(self.ignored | at_end | is_far, jnp.inf, roots)
        tolerance = rounding_of_events(step, samples, noise, self.is_boolean)
        next_known = jnp.min(self.known_times)
        # Steps of Boolean conditions are not sharp enough to be moved to another time.
        is_moved = is_same_time(step, roots, next_known, tolerance) & ~self.is_boolean
        is_at_known = self.is_known | is_moved
        roots = jnp.where(is_moved & ~self.is_known, next_known, roots)
        # At a known time the value is the one after the jump: a step that ends there is made again.
        exactly = step.t1 == end_of_step(roots, step.t0)
        is_end = jnp.where(is_at_known, exactly, jnp.abs(roots - step.t1) <= tolerance)
        near = is_end & ~at_once
        irregular = self._is_irregular(samples, near & ~hops, at_once & on_surface)
        come_from = signs[place, jnp.arange(place.size)]
        waiting = jnp.where(leaves, _infinite(before), _infinite(start))
        same = self._was_true(history) | (jnp.isnan(history.sides) & (start == 0))
        waiting = jnp.where(same, history.sides, waiting)
        sides = jnp.where(stays, _infinite(start), _sides_at_end(samples, small))
        # What jumps have caused already, or is at the same time, stays so until its own jump.
        sides = jnp.where(near, _infinite(come_from), sides)
        sides = jnp.where(step.is_negative, waiting, sides)
        scale, rates = self._sizes(step, samples, history, near, stays)
        found = self._chosen(step, roots, near, at_once, irregular, sides)
        return found._replace(scale=jnp.where(found.ends_step | stays, scale, 0), rates=rates)

    def _sizes(
        self,
        step: SearchedStep,
        samples: SampledConditions,
        history: History,
        near: Array,
        stays: Array,
    ) -> tuple[Array, Array]:
        """Return the largest values and the rates of change that are remembered after a step."""
        largest = jnp.max(jnp.abs(samples.inside), axis=0)
        # What a condition is at its event is zero, whatever is left of it there.
        left_over = jnp.abs(samples.end) / (500 * jnp.finfo(largest.dtype).eps)
        largest = jnp.where(near, jnp.maximum(largest, left_over), largest)
        says_nothing = step.is_negative | stays
        scale = jnp.maximum(largest, jnp.where(says_nothing, history.scale, 0))
        rates = (samples.end - samples.before_end) * self.parts / step.length
        return scale, jnp.where(says_nothing, history.rates, rates)

    def _crosses(self, before: Array, after: Array) -> Array:
        up, down = (before < 0) & (after >= 0), (before > 0) & (after <= 0)
        directions = jnp.broadcast_to(self.directions, up.shape)
        return (up & (directions >= 0)) | (down & (directions <= 0))

    def _start(
        self,
        step: SearchedStep,
        samples: SampledConditions,
        rate: Array,
        history: History,
        small: Array,
    ) -> tuple[Array, ...]:
        """Return the signs just before and just after the start of the step, and which conditions are
        zero there up to rounding; the sign of these is that of their rate of change."""
        largest = jnp.max(jnp.abs(samples.inside), axis=0)
        caused = jnp.isnan(history.sides)
        # Two bodies in contact touch up to the error of the solve. What was moving is where its value says.
        rested = jnp.abs(history.rates) <= 1e-3 * jnp.abs(rate)
        small = jnp.maximum(small, jnp.where(caused | rested, 1e-6 * largest, 0))
        is_zero = lambda v: jnp.abs(v) <= small
        on_surface = history.remembers & is_zero(samples.values[0])
        on_surface &= ~self.is_boolean & ~self.is_known
        # A Boolean condition may still be false where its event was taken to be.
        late = 32 * rounding_of_times(step) + 1e-10 * jnp.abs(step.length)
        soon = self.values(step.t0 + late, step.path(late / step.length))
        first = jnp.where(self._was_true(history), soon, samples.values[0])
        start = jnp.sign(jnp.where(on_surface, rate, first))
        # One that was zero before the jump as well is taken to have been on the side it can leave.
        touching = jnp.where(on_surface, -self.directions, 0)
        before = jnp.where(is_zero(history.sides), touching, jnp.sign(history.sides))
        unknown = caused | ~history.remembers
        return jnp.where(unknown, 0, before), start, on_surface

    def _was_true(self, history: History) -> Bool[Array, " resets"]:
        """Return which Boolean conditions have become true, or are taken to be."""
        return self.is_boolean & (jnp.isnan(history.sides) | (history.sides > 0))

    def _roots(
        self,
        step: SearchedStep,
        samples: SampledConditions,
        place: Array,
        found: Array,
        on_surface: Array,
    ) -> Float[Array, " resets"]:
        """Return the times at which conditions change sign between samples `place` and `place + 1`."""
        each = jnp.arange(place.size)
        fractions = jnp.asarray(samples.fractions, step.t0.dtype)
        # A condition that is zero at the start has another root, that of its change by the time passed.
        deflated = on_surface & (place == 0)

        def value(s: Float[Array, " resets"]) -> Float[Array, " resets"]:
            at = lambda s: self.values(step.t0 + s * step.length, step.path(s))
            values = jax.vmap(at)(s)[each, each]
            return jnp.where(deflated, (values - samples.values[0]) / s, values)

        right, end = fractions[place + 1], samples.values[place + 1, each]
        end = jnp.where(deflated, (end - samples.values[0]) / right, end)
        start = jnp.where(deflated, -end, samples.values[place, each])
        roots = root_in_bracket(value, (fractions[place], start), (right, end), found)
        return jnp.where(found, step.t0 + roots * step.length, jnp.inf)

    def _is_irregular(self, samples: SampledConditions, near: Array, touching: Array) -> Array:
        """Return which events have no derivative: more than one at a time, or zeros with almost no slope."""
        # That at the end of the parabola through three samples.
        a, b, end = BEYOND, 1 / self.parts, samples.end
        right, left = (samples.beyond - end) / a, (end - samples.before_end) / b
        grazes = jnp.abs((right * b + left * a) / (a + b)) <= 1e-3 * jnp.max(
            jnp.abs(samples.inside), axis=0
        )
        # Known times that coincide do so for all parameters; no crossing does.
        several = (jnp.sum(near) > 1) & jnp.any(near & ~self.is_known)
        grazes &= ~self.is_boolean & ~self.is_known
        return jnp.where(near, grazes | several, touching)

    def _chosen(
        self,
        step: SearchedStep,
        roots: Array,
        near: Array,
        at_once: Array,
        irregular: Array,
        sides: Array,
    ) -> Found:
        """Choose the earliest event: of several at one time the first."""
        earliest = jnp.min(roots)
        happens = jnp.isfinite(earliest)
        is_at_end = jnp.any(near & (roots == earliest))
        # Those at the same time are all that are at the end of the step, or all at its start.
        same = jnp.where(is_at_end, near, roots == earliest)
        number = jnp.argmax(same & happens).astype(jnp.int32)
        target = end_of_step(earliest, step.t0)
        at_start = EventAtStart(
            at_once[number], number, irregular[number], crosses=jnp.asarray(False)
        )
        target = jnp.where(at_start.happens, at_start.end_of_step(step.t0, roots.size), target)
        told = EventAtStart.told_by(step.t0, step.t1, roots.size)
        is_told = told.happens
        number = jnp.where(is_told, told.number, number)
        ends_step = is_at_end | is_told
        unknown = jnp.where(ends_step, jnp.nan, sides)
        return Found(
            happens | is_told,
            ends_step,
            jnp.where(is_told, told.irregular, irregular[number]),
            number,
            target,
            jnp.where(is_told, step.t0, time_after(step.t1)),
            jnp.where(jnp.arange(sides.size, dtype=number.dtype) == number, unknown, sides),
            jnp.zeros_like(sides),
            jnp.zeros_like(sides),
        )


def _infinite(sign: Array) -> Array:
    """Return infinity of this sign: a side that is known, but no value."""
    return jnp.where(sign == 0, 0, sign * jnp.inf)


def _sides_at_end(samples: SampledConditions, small: Array) -> Float[Array, " resets"]:
    """Return the values at the end; one that is zero to rounding there comes from where it was before."""
    is_zero = jnp.abs(samples.end) <= small
    return jnp.where(is_zero, _infinite(jnp.sign(samples.before_end)), samples.end)


def _first_sign(values: Float[Array, "samples resets"], small: Array) -> Float[Array, " resets"]:
    """Return the sign of the first value of each condition that is larger than rounding, 0 without one."""
    signs = jnp.where(jnp.abs(values) > small[None, :], jnp.sign(values), 0)
    return signs[jnp.argmax(signs != 0, axis=0), jnp.arange(values.shape[1])]
