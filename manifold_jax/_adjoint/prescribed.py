"""Times that a step size controller prescribes (`jump_ts`, `step_ts`, `StepTo(ts=...)`): the ends of steps
there have derivatives, other ends of steps are held fixed."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.types import IntScalar, RealScalarLike
from .._linalg.newton import without_derivative
from .._resets.controller import ResettingController


def prescribed_times(controller: Any, dtype: Any) -> Float[Array, " prescribed"] | None:
    """Return all times that a controller prescribes, or None."""
    found = []
    while isinstance(controller, dfx.ClipStepSizeController | ResettingController):
        if isinstance(controller, dfx.ClipStepSizeController):
            found += [controller.step_ts, controller.jump_ts]
        controller = controller.controller
    if isinstance(controller, dfx.StepTo):
        found.append(controller.ts)
    found = [ts.astype(dtype) for ts in found if ts is not None and len(ts)]
    return jnp.concatenate(found) if found else None


def which_prescribed(
    times: Float[Array, " prescribed"], t: RealScalarLike
) -> tuple[Bool[Array, ""], IntScalar]:
    """Return whether steps end or begin at `t` because of one of `times`, and of which."""
    # Steps end just before a jump and begin just after it; infinity is a time that is never met.
    limits = jnp.finfo(times.dtype)
    near = jnp.abs(t - times) <= 4 * jnp.maximum(limits.eps * jnp.abs(times), limits.tiny)
    near &= jnp.isfinite(times)
    return jnp.any(near), jnp.argmax(near)


def with_prescribed(times: Float[Array, " prescribed"] | None, t: Any) -> Any:
    """Return `t`, held fixed or with the derivative of the one of `times` that it is."""
    return t if times is None else _moved(times, without_derivative(t))


@jax.custom_jvp
def _moved(times: Float[Array, " prescribed"], t: Any) -> Any:
    """Return `t`; only in forward mode is it looked for among the times, which takes as long as they are many."""
    return t


@_moved.defjvp
def _moved_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    times, t = primals
    is_one, i = which_prescribed(times, t)
    return _moved(times, t), jnp.where(is_one, tangents[0][i], 0)
