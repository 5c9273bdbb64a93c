"""Times that a step size controller prescribes (`jump_ts`, `step_ts`, `StepTo(ts=...)`): the ends of steps
there have derivatives, other ends of steps are held fixed."""

from typing import Any

import diffrax as dfx
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
    # Steps end just before a jump and begin just after it.
    limits = jnp.finfo(times.dtype)
    near = jnp.abs(t - times) <= 4 * jnp.maximum(limits.eps * jnp.abs(times), limits.tiny)
    return jnp.any(near), jnp.argmax(near)


def with_prescribed(times: Float[Array, " prescribed"] | None, t: Any) -> Any:
    """Return `t`, with the derivative of the one of `times` that it is, if any."""
    if times is None:
        return t
    is_one, i = which_prescribed(*without_derivative((times, t)))
    return t + jnp.where(is_one, times[i] - without_derivative(times[i]), 0)
