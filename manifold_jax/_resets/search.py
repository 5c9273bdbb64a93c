"""The first event in a step, found by the signs of its conditions at samples of dense output."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .bracket import root_in_bracket


# Beyond its end a step is searched for this part of its length: the event at which it was meant to end
# may come a little later.
_BEYOND = 0.01
_PERTURBATIONS = 4


class Step(NamedTuple):
    """An attempted step in the time of Diffrax, and its dense output."""

    t0: FloatScalar
    t1: FloatScalar
    y0: Y
    y1: Y
    path: Callable[[FloatScalar], Y]
    plain_path: Callable[[FloatScalar], Y]  # whose slope is that of the solver's own interpolant

    @property
    def length(self) -> FloatScalar:
        return self.t1 - self.t0


class History(eqx.Module):
    """What a solve remembers of its events from step to step."""

    after_reset: BoolScalar  # whether the step begins at an event, or is the first one
    # The conditions just before the last jump: their values, infinite where only the sign is known, and NaN
    # for the one that caused it, which may have any sign after it.
    sides: Float[Array, " resets"]
    happened: Int[Array, " resets"]  # how often each has happened

    @staticmethod
    def initial(count: int, dtype: Any) -> "History":
        return History(jnp.asarray(True), jnp.zeros(count, dtype), jnp.zeros(count, jnp.int32))


class Found(NamedTuple):
    """The first event in or just after a step."""

    happens: BoolScalar
    number: IntScalar  # of the reset
    target: FloatScalar  # where a step has to end so that the event is at its end
    ends_step: BoolScalar  # whether this step ends there
    time: FloatScalar  # of the event, if it does
    sides: Float[Array, " resets"]  # as in [`History`][]
    defined: BoolScalar  # whether no condition was NaN


class Search(NamedTuple):
    """The settings of a search: the values of the conditions at a time of Diffrax, and their kinds."""

    values: Callable[[FloatScalar, Y], Float[Array, " resets"]]
    directions: Float[Array, " resets"]  # 1, -1, or 0 for both
    is_boolean: Bool[Array, " resets"]
    samples: int
    end: FloatScalar  # of the solve
    ignored: Bool[Array, " resets"]
    known_times: Float[Array, " resets"]  # the next one; infinity for conditions

    def first(self, step: Step, history: History) -> Found:
        """Return the first event of a step.

        Nothing is computed but the signs of the conditions if none of them changes.
        """
        times, values = self._sampled(step)
        signs = jnp.sign(values)
        changed = jnp.any(self._crosses(signs[:-1], signs[1:]))
        soon = step.t1 + _BEYOND * step.length
        is_due = jnp.any(self.known_times <= soon) | (step.t1 < step.t0) | history.after_reset
        defined = ~jnp.any(jnp.isnan(values))
        nothing = Found(
            jnp.asarray(False),
            jnp.zeros((), jnp.int32),
            step.t1,
            jnp.asarray(False),
            step.t1,
            values[self.samples],
            defined,
        )
        return lax.cond(
            changed | is_due,
            lambda: self._analyzed(step, history, times, values)._replace(defined=defined),
            lambda: nothing,
        )

    def _sampled(self, step: Step) -> tuple[Float[Array, " samples"], Float[Array, "samples m"]]:
        """Return the conditions at the ends of equal parts of the step, and once beyond its end."""
        fractions = np.append(np.arange(self.samples + 1) / self.samples, 1 + _BEYOND)
        times = step.t0 + step.length * jnp.asarray(fractions, step.t0.dtype)
        times = times.at[self.samples].set(step.t1)
        states = jax.vmap(step.path)(times)
        states = jtu.tree_map(
            lambda ys, y0, y1: ys.at[0].set(y0).at[self.samples].set(y1), states, step.y0, step.y1
        )
        return times, jax.vmap(self.values)(times, states)

    def _crosses(self, before: Array, after: Array) -> Array:
        up, down = (before < 0) & (after >= 0), (before > 0) & (after <= 0)
        return (up & (self.directions >= 0)) | (down & (self.directions <= 0))

    def _analyzed(self, step: Step, history: History, times: Array, values: Array) -> Found:
        noise = self._noise(step, values[self.samples])
        before, start, on_surface = self._start(step, history, values, noise)
        is_known = jnp.isfinite(self.known_times)
        # A jump changed the sign, or the state leaves the surface on which it began: at once.
        at_once = (before != 0) & (start != 0) & self._crosses(before, start)
        resting = on_surface & (start == 0) & self._crosses(-jnp.sign(values[1]), values[1])
        at_once = jnp.where(is_known, self.known_times <= step.t0, at_once | resting)
        signs = jnp.sign(values).at[0].set(start)
        crossings = self._crosses(signs[:-1], signs[1:])
        place, found = jnp.argmax(crossings, axis=0), jnp.any(crossings, axis=0)
        roots = self._roots(step, times, values, place, found & ~at_once, on_surface)
        soon = step.t1 + _BEYOND * step.length
        roots = jnp.where(is_known & (self.known_times <= soon), self.known_times, roots)
        roots = jnp.where(at_once, step.t0, roots)
        rounding = jnp.finfo(step.t1.dtype).eps * jnp.maximum(jnp.abs(step.t0), jnp.abs(step.t1))
        at_end = roots >= self.end - 200 * rounding  # of the solve, where nothing happens any more
        roots = jnp.where(self.ignored | at_end, jnp.inf, roots)
        rate = jnp.abs(values[self.samples] - values[self.samples - 1]) * self.samples
        noise_in_time = noise / jnp.maximum(rate, 1e3 * noise + jnp.finfo(rate.dtype).tiny)
        noise_in_time = jnp.where(self.is_boolean, 1e-12, noise_in_time)
        tolerance = 16 * rounding + jnp.abs(step.length) * noise_in_time
        tolerance = jnp.where(is_known, 4 * rounding, tolerance)
        return self._chosen(step, roots, at_once, signs, place, tolerance, values[self.samples])

    def _start(self, step: Step, history: History, values: Array, noise: Array) -> tuple:
        """Return the signs just before and just after the start of the step, and which conditions are
        zero there up to rounding; the sign of these is that of their rate of change."""
        largest = jnp.max(jnp.abs(values[1 : self.samples + 1]), axis=0)
        is_zero = lambda v: (jnp.abs(v) <= 4 * noise) | (jnp.abs(v) <= 1e-6 * largest)
        on_surface = history.after_reset & is_zero(values[0])
        on_surface &= ~self.is_boolean & ~jnp.isfinite(self.known_times)
        along = lambda t: self.values(t, step.plain_path(t))
        rate = jax.jvp(along, (step.t0,), (jnp.ones_like(step.t0),))[1]
        rate = jnp.where(jnp.abs(rate * step.length) <= 1e-10 * largest, 0, rate)
        start = jnp.where(on_surface, jnp.sign(rate), jnp.sign(values[0]))
        # One that was zero before the jump as well is taken to have been on the side it can leave.
        touching = jnp.where(on_surface, -self.directions, 0)
        before = jnp.where(is_zero(history.sides), touching, jnp.sign(history.sides))
        unknown = jnp.isnan(history.sides) | ~history.after_reset
        return jnp.where(unknown, 0, before), start, on_surface

    def _noise(self, step: Step, end: Array) -> Float[Array, " resets"]:
        """Return how much rounding of the state may change the conditions at the end of the step."""
        random = np.random.default_rng(0)

        def perturbed(leaf: Array) -> Array:
            signs = random.choice([-1.0, 1.0], (_PERTURBATIONS, *leaf.shape))
            eps = 16 * jnp.finfo(leaf.dtype).eps
            return leaf * (1 + eps * jnp.asarray(signs, leaf.dtype))

        states = jtu.tree_map(perturbed, step.y1)
        values = jax.vmap(lambda y: self.values(step.t1, y))(states)
        return jnp.where(self.is_boolean, 0, jnp.max(jnp.abs(values - end), axis=0))

    def _roots(
        self, step: Step, times: Array, values: Array, place: Array, found: Array, on_surface: Array
    ) -> Float[Array, " resets"]:
        """Return the times at which conditions change sign between samples `place` and `place + 1`."""
        each = jnp.arange(place.size)
        # A condition that is zero at the start has another root, that of its value by the time passed.
        deflated = on_surface & (place == 0)

        def value(t: Float[Array, " resets"]) -> Float[Array, " resets"]:
            at = jax.vmap(lambda t: self.values(t, step.path(t)))(t)[each, each]
            return jnp.where(deflated, at * step.length / (t - step.t0), at)

        right = times[place + 1], values[place + 1, each]
        right = right[0], jnp.where(deflated, right[1] * step.length / (right[0] - step.t0), right[1])
        left = times[place], jnp.where(deflated, -right[1], values[place, each])
        roots = root_in_bracket(value, left, right, found)
        return jnp.where(found, roots, jnp.inf)

    def _chosen(
        self,
        step: Step,
        roots: Array,
        at_once: Array,
        signs: Array,
        place: Array,
        tolerance: Array,
        end: Array,
    ) -> Found:
        """Choose the earliest event: of several at one time the first."""
        near = (jnp.abs(roots - step.t1) <= tolerance) & ~at_once
        earliest = jnp.min(roots)
        happens = jnp.isfinite(earliest)
        is_at_end = jnp.any(near & (roots == earliest))
        # Those at the same time are all that are at the end of the step, or all at its start.
        same = jnp.where(is_at_end, near, roots == earliest)
        number = jnp.argmax(same & happens).astype(jnp.int32)
        place = jnp.minimum(place, self.samples)
        infinite = lambda sign: jnp.where(sign == 0, 0, sign * jnp.inf)
        before = jnp.where(near, infinite(signs[place, jnp.arange(place.size)]), end)
        target = jnp.maximum(_before(earliest), _after(step.t0))
        unit = _unit(step.t0)
        target = jnp.where(at_once[number], step.t0 - (number + 1).astype(unit.dtype) * unit, target)
        # A step of negative length is one that says which event happens at its start.
        told = jnp.round((step.t0 - step.t1) / unit).astype(jnp.int32) - 1
        backwards = step.t1 < step.t0
        number = jnp.where(backwards, jnp.clip(told, 0, place.size - 1), number)
        return Found(
            happens | backwards,
            number,
            target,
            is_at_end | backwards,
            jnp.where(backwards, step.t0, _after(step.t1)),
            jnp.where(backwards, infinite(signs[0]), before).at[number].set(jnp.nan),
            jnp.asarray(True),
        )


def _before(t: FloatScalar) -> FloatScalar:
    return jnp.nextafter(t, jnp.asarray(-jnp.inf, t.dtype))


def _after(t: FloatScalar) -> FloatScalar:
    return jnp.nextafter(t, jnp.asarray(jnp.inf, t.dtype))


def _unit(t: FloatScalar) -> FloatScalar:
    """Return a length that is negligible at this time, by which steps of negative length count."""
    info = jnp.finfo(t.dtype)
    return jnp.maximum(2 * info.eps * jnp.abs(t), jnp.sqrt(jnp.asarray(info.tiny, t.dtype)))
