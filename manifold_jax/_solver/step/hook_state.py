"""The state that all step hooks carry from step to step, and the decision whether a step is rejected."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array

from ..._base.compat import is_okay, nonlinear_failure, update_result
from ..._base.rejection import is_repeatable, rejecting
from ..._base.types import BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from ..._constraint.projection_info import ProjectionInfo
from .execution import Step


class StepStatistics(eqx.Module):
    """Totals over the accepted steps of a solve. Corrections and displacements are those of the
    component that moved most, `|change| / (|y| + 1)`."""

    iterations: IntScalar
    largest_correction: FloatScalar
    correction: FloatScalar
    displacement: FloatScalar

    @staticmethod
    def zero(y: Y) -> "StepStatistics":
        zero = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(y)))
        return StepStatistics(jnp.zeros((), jnp.int32), zero, zero, zero)

    @property
    def correction_share(self) -> FloatScalar:
        moved = self.displacement > 0
        return jnp.where(moved, self.correction / jnp.where(moved, self.displacement, 1), 0)

    def including(self, y0: Y, y1: Y, info: ProjectionInfo) -> "StepStatistics":
        dtype = self.correction.dtype
        correction = info.correction.astype(dtype)
        return StepStatistics(
            self.iterations + info.iterations,
            jnp.maximum(self.largest_correction, correction),
            self.correction + correction,
            self.displacement + _distance(y0, y1, dtype),
        )


def _distance(y0: Y, y1: Y, dtype: Any) -> FloatScalar:
    def largest(a: Array, b: Array) -> FloatScalar:
        return jnp.max(jnp.abs(b - a) / (jnp.abs(a) + 1), initial=0.0).astype(dtype)

    leaves = jtu.tree_leaves(jax.lax.stop_gradient(jtu.tree_map(largest, y0, y1)))
    return functools.reduce(jnp.maximum, leaves)


class HookState(eqx.Module):
    """Carried from step to step: the memory of the execution, the size of the first step that was tried
    (the scale of time near t = 0), the totals, and the result of the last step."""

    memory: Any
    first_step: FloatScalar
    statistics: StepStatistics
    result: RESULTS

    @staticmethod
    def initial(memory: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y) -> "HookState":
        first_step = jnp.abs(jnp.asarray(t1) - t0)
        return HookState(memory, first_step, StepStatistics.zero(y0), RESULTS.successful)


def conclude(
    step: Step,
    t0: RealScalarLike,
    t1: RealScalarLike,
    state: HookState,
    bounds_error: bool,
    rejects: bool = True,
) -> tuple[Y, Y | None, dict[str, Any], HookState, RESULTS]:
    """Return the results of a solver's `step`. A step that could not be corrected is rejected; with
    `bounds_error` the error estimate is raised to the size of the correction. Without a constraint no
    step is rejected here that the method itself accepts."""
    corrected = RESULTS.where(step.info.success, RESULTS.successful, nonlinear_failure())
    result, error = update_result(step.result, corrected), step.error
    if error is not None and rejects:
        repeatable = is_repeatable(t0, t1, state.first_step)
        if bounds_error:
            error = _at_least(error, step.raw, step.y1, repeatable)
        error = rejecting(error, is_okay(result), repeatable)
    correction = jtu.tree_map(jnp.subtract, step.y1, step.raw)
    dense_info = dict(corrected=step.y1, correction=correction, **step.dense_info)
    statistics = state.statistics.including(step.y0, step.y1, step.info)
    state = HookState(step.memory, state.first_step, statistics, result)
    return step.y1, error, dense_info, state, result


def _at_least(error: Y, raw: Y, y1: Y, repeatable: BoolScalar) -> Y:
    """Raise an error estimate to the correction, a lower bound of the local error (Sudarsan & Keerthi
    1998, 3.4).

    Unless the step started off the manifold: then no step is small enough, and the smallest one is
    accepted.
    """

    def raised(e: Array, a: Array, b: Array) -> Array:
        bound = jax.lax.stop_gradient(jnp.abs(a - b))
        return jnp.where(repeatable, jnp.maximum(jnp.abs(e), bound), e)

    return jtu.tree_map(raised, error, y1, raw)


def memory_of(solver_state: Any) -> Any:
    """Return the memory of a hook without its statistics, which no step depends on."""
    return solver_state.memory if isinstance(solver_state, HookState) else solver_state


def with_memory(solver_state: Any, memory: Any) -> Any:
    if isinstance(solver_state, HookState):
        return dataclasses.replace(solver_state, memory=memory)
    return memory
