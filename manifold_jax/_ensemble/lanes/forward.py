"""Forward mode of many trajectories in lanes: each is advanced together with its tangent."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from ..._adjoint.replay import with_memory
from ..._base.types import BoolScalar, FloatScalar
from .functions import smooth_part, step_state
from .parts import in_steps, Inputs, Parts
from .rows import saved_rows
from .schedule import Run, Schedule
from .trajectory import Attempt, Outcome, Start, Trajectory


class Given(NamedTuple):
    """What a trajectory has of its own, and its tangent."""

    each: Any
    rest: Any
    tangent: Any
    direction: FloatScalar


class Moving(NamedTuple):
    """A trajectory with the tangent of what its next step depends on."""

    trajectory: Trajectory
    tangent: Any


class Ended(NamedTuple):
    outcome: Outcome
    tangent: Any


class Tangents:
    """[`Equations`][] for pairs of what they are for and its tangent, with the same steps."""

    def __init__(self, parts: Parts, common_tangent: Any):
        self.parts, self.common_tangent = parts, common_tangent
        self.saveat = parts.rest[0].saveat

    def given(self, each: Any, rest: Any, tangent: Any) -> Given:
        _, given = self.parts.one(each, self.parts.common, rest)
        return Given(each, rest, tangent, given.direction)

    def _along(self, function: Any, given: Given, x: Any, dx: Any) -> tuple[Any, Any, Any]:
        """Differentiate along a tangent, of `function(equations, given, x) -> (smooth, aux)`:
        `smooth`, its tangent, `aux`."""

        def value(each: Any, common: Any, x: Any) -> Any:
            return function(*self.parts.one(each, common, given.rest), x)

        at, along = (given.each, self.parts.common, x), (given.tangent, self.common_tangent, dx)
        return jax.jvp(value, at, along, has_aux=True)

    def begin(self, given: Given) -> Start:
        def begin(equations, given, _):
            start = equations.begin(given)
            return smooth_part(step_state(start.trajectory)), start

        _, tangent, start = self._along(begin, given, None, None)
        return start._replace(trajectory=Moving(start.trajectory, tangent))

    def goes_on(self, given: Given, moving: Moving) -> BoolScalar:
        equations, primal = self.parts.one(given.each, self.parts.common, given.rest)
        return equations.goes_on(primal, moving.trajectory)

    def attempt(self, given: Given, moving: Moving) -> Attempt:
        before = moving.trajectory
        smooth, discrete = eqx.partition(step_state(before), eqx.is_inexact_array)

        def attempt(equations, given, smooth):
            y, memory = eqx.combine(smooth, discrete)
            state = with_memory(before.solver_state, memory)
            tried = equations.attempt(given, before._replace(y=y, solver_state=state))
            return (smooth_part(step_state(tried.trajectory)), tried.dense_info), tried

        _, (tangent, dense_tangent), tried = self._along(attempt, given, smooth, moving.tangent)
        after = Moving(tried.trajectory, tangent)
        return tried._replace(trajectory=after, dense_info=(tried.dense_info, dense_tangent))

    def state_of(self, moving: Moving) -> tuple[Any, Any]:
        return moving.trajectory.y, moving.tangent[0]

    def interpolated(
        self, t: FloatScalar, start: FloatScalar, end: FloatScalar, dense_info: Any
    ) -> tuple[Any, Any]:
        equations = in_steps(self.parts.rest[0])
        interpolated = lambda info: equations.interpolated(t, start, end, info)
        info, tangent = dense_info
        return jax.jvp(interpolated, (info,), (tangent,))

    def saved_value(self, given: Given, t: FloatScalar, y: Any) -> tuple[Any, BoolScalar]:
        def value(equations, given, y):
            value, success = equations.saved_value(given, t, y)
            return eqx.filter(value, eqx.is_inexact_array), (value, success)

        _, tangent, (value, success) = self._along(value, given, *y)
        return (value, tangent), success

    def outcome(self, given: Given, moving: Moving) -> Ended:
        equations, primal = self.parts.one(given.each, self.parts.common, given.rest)
        return Ended(equations.outcome(primal, moving.trajectory), moving.tangent[0])


def tangents_in_lanes(inputs: Inputs, tangents: Any, lanes: int, limit: int) -> tuple[Any, Any]:
    """Return the tangents of times and values; `tangents` of the inputs have `None` where there is
    none."""
    is_none = lambda x: x is None
    differentiated = jtu.tree_map(lambda x: x is not None, tangents, is_leaf=is_none)
    parts = Parts.of(inputs, differentiated)
    along = Parts.of(tangents, differentiated)
    equations = Tangents(parts, along.common)
    given = parts.each, parts.rest_each, along.each
    run = Schedule(equations, given, lambda x: equations.given(*x), lanes, limit).run()
    values, values_tangent = run.values or (None, None)
    reached = jnp.arange(run.rows.size) if values is None else _reached(run, values)
    values_tangent = jtu.tree_map(lambda x: jnp.where(_like(reached, x), x, 0), values_tangent)
    smooth_values, others = eqx.partition(values, eqx.is_inexact_array)
    start, outcome = run.start.trajectory, run.outcome.outcome

    def saved(each: Any, common: Any, first: Any, last: Any, smooth_values: Any) -> Any:
        equations, batch = parts.inputs(each, common)
        values = eqx.combine(smooth_values, others)
        begun = Start(start.trajectory._replace(y=first), run.start.correction)
        new = run._replace(start=begun, outcome=outcome._replace(y=last), values=values)
        return eqx.filter(saved_rows(equations.saveat.subs, batch, new), eqx.is_inexact_array)

    at = parts.each, parts.common, start.trajectory.y, outcome.y, smooth_values
    along = along.each, along.common, start.tangent[0], run.outcome.tangent, values_tangent
    return jax.jvp(saved, at, along)[1]


def _reached(run: Run, values: Any) -> Array:
    return jnp.arange(jtu.tree_leaves(values)[0].shape[1])[None] < run.rows[:, None]


def _like(mask: Array, x: Array) -> Array:
    return mask.reshape(*mask.shape, *(1,) * (x.ndim - mask.ndim))
