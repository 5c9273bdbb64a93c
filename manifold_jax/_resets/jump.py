"""One reset: the time of its event and the states before and after it, with their derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.compat import time_direction, undirected
from .._base.known_value import known_value
from .._base.rejection import is_finite
from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .._rosenbrock import MassMatrixTerm
from .._solver.base import AbstractManifoldSolver
from .._solver.unconstrained import Unconstrained
from .at_start import EventAtStart
from .conditions import Conditions


class Jump(NamedTuple):
    """The time of an event in the time of Diffrax, the states before and after it, and whether the
    latter is usable: finite, and on the manifold."""

    time: FloatScalar
    before: Y
    after: Y
    success: BoolScalar
    memory: Any = None  # of the solver, for the step that begins there


def jump_at_end(
    conditions: Conditions,
    solver: dfx.AbstractSolver,
    terms: Any,
    number: IntScalar,
    step: tuple[FloatScalar, FloatScalar],
    time: FloatScalar,
    y: Y,
) -> Jump:
    """Make the reset `number` at the end of a step, with the derivative of the time of its event.

    The step ends in the state `y`, at a time that is held fixed as that of every other step. The event
    is at `time`, equal to it up to rounding, and by an amount that depends on parameters. That of a step of
    negative length is at its start, which may depend on parameters.
    """
    direction = time_direction(terms)
    start, end = step
    told = EventAtStart.told_by(*lax.stop_gradient(step), len(conditions))
    end = jnp.where(told.happens, start, lax.stop_gradient(end))
    is_caused = told.happens & ~told.crosses & ~conditions.is_known(number)

    def shifted(end: FloatScalar, y: Y) -> tuple[FloatScalar, Y]:
        def distance(t: FloatScalar, y: Y) -> FloatScalar:
            # What another jump causes happens at the time of that.
            crossed = conditions.distance(number, t * direction, y)
            return jnp.where(is_caused, t - end, crossed)

        return _time_and_state_of_event(conditions, terms, distance, end, y)

    time, before = known_value(shifted, (time, y), end, y)
    after = conditions.jump(number, time * direction, before)
    after, success = _consistent(conditions, solver, terms, time * direction, after)
    return Jump(time, before, after, success & is_finite(after))


def _time_and_state_of_event(
    conditions: Conditions,
    terms: Any,
    distance: Callable[[FloatScalar, Y], FloatScalar],
    end: FloatScalar,
    y: Y,
) -> tuple[FloatScalar, Y]:
    """Return `end` and `y` as functions of everything that the event depends on.

    The event is at `end + d`, where `d` is the zero of `distance(end + d, flow_d(y))` near 0, and the
    flow over such a small time is a step of the classical method of Runge and Kutta: its first four
    derivatives with respect to `d` are exact, as are those of `d` after four iterations
    `d - distance / rate` from 0.
    """
    field = vector_field(terms, conditions.args)
    rate = jax.jvp(distance, (end, y), (jnp.ones_like(end), field(end, y)))[1]
    rate = lax.stop_gradient(jnp.where(rate == 0, 1, rate))
    y = conditions.refuse_derivative(end, y)

    def flow(d: FloatScalar) -> Y:
        def stage(velocity: Y, fraction: FloatScalar) -> tuple[Y, Y]:
            ahead = lambda a, b: a + (fraction * d * b).astype(a.dtype)
            velocity = field(end + fraction * d, jtu.tree_map(ahead, y, velocity))
            velocity = jtu.tree_map(lambda a, b: b.astype(a.dtype), y, velocity)
            return velocity, velocity

        fractions = jnp.asarray([0, 0.5, 0.5, 1], d.dtype)
        _, velocities = lax.scan(stage, jtu.tree_map(jnp.zeros_like, y), fractions)
        mean = lambda v: (v[0] + 2 * v[1] + 2 * v[2] + v[3]) / 6
        return jtu.tree_map(lambda a, v: a + (d * mean(v)).astype(a.dtype), y, velocities)

    def iterate(carry: tuple, _: Any) -> tuple[tuple, None]:
        following, *_ = carry
        state = flow(following)
        value = distance(end + following, state)
        # Its value is the rounding of the search and changes nothing.
        value = value - lax.stop_gradient(value)
        return (following - value / rate, following, state), None

    start = jnp.zeros_like(end), jnp.zeros_like(end), y
    (_, d, state), _ = lax.scan(iterate, start, None, length=5)
    return end + d, state


def vector_field(terms: Any, args: Any) -> Any:
    """Return the vector field in the time of Diffrax."""
    term = undirected(terms)
    if isinstance(term, MassMatrixTerm):
        direction = time_direction(terms)

        def derivative(t: FloatScalar, y: Y) -> Y:
            velocity = term.derivative(t * direction, y, args)
            return jtu.tree_map(lambda v: (v * direction).astype(v.dtype), velocity)

        return derivative

    def field(t: FloatScalar, y: Y) -> Y:
        return terms.vf_prod(t, y, args, terms.contr(t, t + jnp.ones_like(t)))

    return field


def _consistent(
    conditions: Conditions, solver: Any, terms: Any, t: FloatScalar, y: Y
) -> tuple[Y, BoolScalar]:
    """Return a state on the manifold, at the true time; algebraic equations are solved from it."""
    success, args = jnp.asarray(True), conditions.args
    term = undirected(terms)
    if isinstance(term, MassMatrixTerm):
        y, info = term.consistent_state(t, y, args, throw=False)
        success &= info.success
    if isinstance(solver, AbstractManifoldSolver) and not isinstance(solver, Unconstrained):
        y, info = solver.correct(t, y, args)
        success &= info.success
    return y, success
