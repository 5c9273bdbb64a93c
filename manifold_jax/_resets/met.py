"""The event that a step meets, as the solver reports it to the step size controller."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.compat import nonlinear_failure
from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .history import History
from .jump import Jump
from .search import Found


class Met(NamedTuple):
    """The event that a step meets. All leaves are real numbers, few of them: a branch copies them."""

    numbers: Float[Array, " 7"]
    sides: Float[Array, " resets"]
    scale: Float[Array, " resets"]
    rates: Float[Array, " resets"]
    time: FloatScalar
    before: Y
    after: Y
    memory: Any
    defined: BoolScalar | bool = True

    @staticmethod
    def of(found: Found, exhausted: BoolScalar, jump: Jump) -> "Met":
        real = lambda x: jnp.asarray(x, found.target.dtype)
        flags = found.happens, found.ends_step, exhausted
        numbers = *flags, found.number, jump.success, found.irregular
        numbers = jnp.stack([found.target, *map(real, numbers)])
        of_conditions = found.sides, found.scale, found.rates
        return Met(numbers, *of_conditions, jump.time, jump.before, jump.after, jump.memory)

    @staticmethod
    def without_event(t: FloatScalar, y: Y, memory: Any, history: History) -> "Met":
        numbers = jnp.asarray([0, 0, 0, 0, 0, 1, 0], t.dtype)
        unknown = jnp.zeros_like(history.scale)
        return Met(numbers, history.sides, unknown, unknown, t, y, y, memory)

    @property
    def target(self) -> FloatScalar:
        return self.numbers[0]

    @property
    def happens(self) -> BoolScalar:
        return self.numbers[1] > 0

    @property
    def ends_step(self) -> BoolScalar:
        return self.numbers[2] > 0

    @property
    def exhausted(self) -> BoolScalar:
        return self.numbers[3] > 0

    @property
    def number(self) -> IntScalar:
        return self.numbers[4].astype(jnp.int32)

    @property
    def usable(self) -> BoolScalar:
        return self.numbers[5] > 0

    @property
    def irregular(self) -> BoolScalar:
        return self.numbers[6] > 0

    @property
    def result(self) -> RESULTS:
        success = RESULTS.where(self.usable, RESULTS.successful, nonlinear_failure())
        result = RESULTS.where(self.exhausted, RESULTS.max_steps_reached, success)  # pyright: ignore[reportArgumentType]
        return RESULTS.where(self.defined, result, RESULTS.nonfinite_input)  # pyright: ignore[reportArgumentType]


class Report(NamedTuple):
    """The error estimate of a step, and what the step size controller has to know of the event in it.
    Diffrax hands it on as the error estimate."""

    error: Y | None
    met: Met
