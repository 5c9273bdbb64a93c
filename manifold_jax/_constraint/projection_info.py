"""The report of a correction."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar, IntScalar, Y
from .correction import CorrectionRoot


class ProjectionInfo(eqx.Module):
    """Report of a projection.

    - `multipliers`: `lambda` of shape `(m,)` in `W (p - y) + G(y)^T lambda = 0`.
    - `iterations`: the number of Newton iterations.
    - `residual`: the scaled residual at the returned point, `max_i |g_i| / scale_i`.
    - `correction`: the distance moved, `max_j |p_j - y_j| / (|y_j| + 1)`.
    - `full_rank`: whether the rows of the Jacobian at `y` were linearly independent.
    - `success`: whether the returned point is on the manifold. If not, it is `y` itself.
    """

    multipliers: Float[Array, " m"]
    iterations: IntScalar
    residual: FloatScalar
    correction: FloatScalar
    full_rank: BoolScalar
    success: BoolScalar

    def __repr__(self) -> str:
        """Show numbers if they are known, that is, not while tracing."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        if not all(_is_known(value) for value in values.values()):
            return eqx.tree_pformat(self)
        known = ", ".join(f"{name}={_number(values[name])}" for name in reversed(values))
        return f"ProjectionInfo({known})"

    @staticmethod
    def of_nothing(y: Y, success: BoolScalar) -> "ProjectionInfo":
        """Report that a state was left as it was."""
        dtype = jnp.result_type(*jtu.tree_leaves(y))
        zero = jnp.zeros((), dtype)
        none = jnp.zeros((0,), dtype)
        return ProjectionInfo(
            none, jnp.zeros((), jnp.int32), zero, zero, jnp.asarray(True), success
        )

    @staticmethod
    def of_formula(y: Y, p: Y, residual: FloatScalar, success: BoolScalar) -> "ProjectionInfo":
        """Report the correction by a formula, without iterations and multipliers. `residual` is the
        scaled residual at the point `p` to which `y` was moved."""

        def distance(a: Array, b: Array) -> FloatScalar:
            return jnp.max(jnp.abs(b - a) / (jnp.abs(a) + 1), initial=0.0)

        distances = jtu.tree_leaves(jtu.tree_map(distance, y, p))
        correction = jax.lax.stop_gradient(functools.reduce(jnp.maximum, distances))
        return dataclasses.replace(
            ProjectionInfo.of_nothing(y, success), residual=residual, correction=correction
        )

    @staticmethod
    def of_parts(*parts: "ProjectionInfo") -> "ProjectionInfo":
        """Combine the reports of parts of a state that were corrected separately."""
        joined = lambda combine, name: functools.reduce(combine, [getattr(p, name) for p in parts])
        return ProjectionInfo(
            multipliers=jnp.concatenate([part.multipliers for part in parts]),
            iterations=joined(jnp.add, "iterations"),
            residual=joined(jnp.maximum, "residual"),
            correction=joined(jnp.maximum, "correction"),
            full_rank=joined(jnp.logical_and, "full_rank"),
            success=joined(jnp.logical_and, "success"),
        )

    @staticmethod
    def of_correction(x: Float[Array, " n"], *roots: CorrectionRoot) -> "ProjectionInfo":
        """Report the correction of `x`, whose parts have been moved to these roots."""
        moved = jnp.concatenate([root.p for root in roots]) - x
        correction = jnp.max(jnp.abs(moved) / (jnp.abs(x) + 1))
        return ProjectionInfo(
            multipliers=-jnp.concatenate([root.z for root in roots]),
            iterations=functools.reduce(jnp.add, [root.iterations for root in roots]),
            residual=functools.reduce(jnp.maximum, [root.residual for root in roots]),
            correction=jax.lax.stop_gradient(correction),
            full_rank=functools.reduce(jnp.logical_and, [root.full_rank for root in roots]),
            success=functools.reduce(jnp.logical_and, [root.success for root in roots]),
        )


def _is_known(value: Any) -> bool:
    return eqx.is_array_like(value) and not isinstance(value, jax.core.Tracer)


def _number(value: Any) -> str:
    short: Any = {"float_kind": lambda x: f"{x + 0.0:.3g}"}
    return np.array2string(np.asarray(value), separator=", ", threshold=20, formatter=short)
