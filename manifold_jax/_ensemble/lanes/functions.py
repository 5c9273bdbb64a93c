"""What is done in each lane in the reverse sweep, as functions of one trajectory."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._adjoint.replay import memory_of, with_memory
from ..._base.compat import directed
from ..._base.types import BoolScalar, FloatScalar
from .parts import Parts
from .trajectory import Attempt, Trajectory


def step_state(trajectory: Trajectory) -> Any:
    """Return what a step depends on: the state, and what the solver remembers."""
    return trajectory.y, memory_of(trajectory.solver_state)


def smooth_part(step_state: Any) -> Any:
    """Return the leaves with respect to which a step has derivatives; the others are `None`."""
    return eqx.filter(step_state, eqx.is_inexact_array)


class Functions:
    """Functions of `(each, common, rest_each)`, see [`Parts`][], and what their names say."""

    def __init__(self, parts: Parts, solver_state: Any):
        """`solver_state`: an example."""
        self.parts = parts
        self.solver_state = jtu.tree_map(jnp.zeros_like, solver_state)

    def goes_on(self, each: Any, common: Any, rest: Any, trajectory: Trajectory) -> BoolScalar:
        equations, given = self.parts.one(each, common, rest)
        return equations.goes_on(given, trajectory)

    def attempt(self, each: Any, common: Any, rest: Any, trajectory: Trajectory) -> Attempt:
        equations, given = self.parts.one(each, common, rest)
        return equations.attempt(given, trajectory)

    def direction(self, each: Any, common: Any, rest: Any) -> FloatScalar:
        _, given = self.parts.one(each, common, rest)
        return given.direction

    def through_start(self, each: Any, common: Any, rest: Any, bar: Any) -> Any:
        """Cotangents of `each` and `common`, from that of the state before the first step."""

        def start(each: Any, common: Any) -> Any:
            equations, given = self.parts.one(each, common, rest)
            return smooth_part(step_state(equations.begin(given).trajectory))

        return jax.vjp(start, each, common)[1](bar)

    def step(
        self, each: Any, common: Any, rest: Any, start: FloatScalar, end: FloatScalar, state: Any
    ) -> tuple[Any, Callable]:
        """The data of the interpolation in a step, and what takes cotangents of the smooth part of
        the state behind it and of these data to those of `each`, `common` and `state`."""
        smooth, discrete = eqx.partition(state, eqx.is_inexact_array)

        def step(each: Any, common: Any, smooth: Any) -> Any:
            equations, given = self.parts.one(each, common, rest)
            y, memory = eqx.combine(smooth, discrete)
            y, _, dense_info, solver_state, _ = equations.solver.step(
                directed(equations.terms, given.direction),
                start,
                end,
                y,
                given.args,
                with_memory(self.solver_state, memory),
                False,
            )
            return smooth_part((y, memory_of(solver_state))), dense_info

        (_, dense_info), pullback = jax.vjp(step, each, common, smooth)
        return dense_info, pullback

    def through_interpolated(
        self,
        each: Any,
        common: Any,
        rest: Any,
        t: FloatScalar,
        start: FloatScalar,
        end: FloatScalar,
        dense_info: Any,
        bar: Any,
    ) -> Any:
        """The cotangent of `dense_info`, from that of the state interpolated at `t`."""
        equations, _ = self.parts.one(each, common, rest)
        interpolated = lambda info: equations.interpolated(t, start, end, info)
        return jax.vjp(interpolated, dense_info)[1](bar)[0]

    def through_handed_out(
        self, each: Any, common: Any, rest: Any, t: FloatScalar, y: Any, bar: Any
    ) -> Any:
        """Cotangents of `each`, `common` and `y`, from that of what is saved of it at the time `t`."""

        def value(each: Any, common: Any, y: Any) -> Any:
            equations, given = self.parts.one(each, common, rest)
            value, _ = equations.saved_value(given, t, y)
            return eqx.filter(value, eqx.is_inexact_array)

        return jax.vjp(value, each, common, y)[1](bar)
