"""Checks of arguments while tracing, and faults that are found at run time."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.compat import is_okay


def check_function(name: str, function: Any, shape: tuple[int, ...], why: str, *inputs: Any):
    """Refuse what is not a function of `inputs` that returns real arrays of this shape."""
    if not callable(function):
        raise TypeError(
            f"`{name}` must be a function `{name}(x, args)`, got {type(function).__name__}."
        )
    out = eqx.filter_eval_shape(function, *inputs)
    if getattr(out, "shape", None) != shape:
        got = f"shape {out.shape}" if hasattr(out, "shape") else type(out).__name__
        raise ValueError(f"`{name}` must return one array of shape {shape} ({why}), got {got}.")
    if not jnp.issubdtype(out.dtype, jnp.floating):
        raise TypeError(f"`{name}` must return real floating-point numbers, got {out.dtype}.")


def check_counts(least: int, **counts: Any) -> None:
    for name, count in counts.items():
        if not isinstance(count, int) or count < least:
            raise ValueError(f"`{name}` must be an integer of at least {least}, got {count!r}.")


def as_curve_start(x0: Any, parameter: int) -> Float[Array, " k"]:
    """Return the unknowns of a curve as an array; `parameter` is the number of one of them."""
    if not hasattr(x0, "dtype") or x0.ndim != 1 or x0.size < 2:
        raise ValueError(
            "`x0` must be one array of shape (n + 1,), the unknowns including the parameter, got "
            f"{getattr(x0, 'shape', type(x0).__name__)}. Ravel other structures with "
            "`jax.flatten_util.ravel_pytree`."
        )
    if not -x0.size <= parameter < x0.size:
        raise ValueError(
            f"`parameter` must be the index of one of the {x0.size} components of `x0`, got {parameter}."
        )
    return jnp.asarray(x0)


def as_direction(direction: Any, x0: Float[Array, " k"], parameter: int) -> Float[Array, " k"]:
    """Return the direction as a vector; a number is the direction of the parameter."""
    direction = jnp.asarray(direction, x0.dtype)
    if direction.shape not in ((), x0.shape):
        raise ValueError(
            f"`direction` must be 1, -1 or a vector of shape {x0.shape} like `x0`, got shape {direction.shape}."
        )
    return direction if direction.ndim else jnp.zeros_like(x0).at[parameter].set(direction)


def raise_if_failed(out: Any, faults: Bool[Array, " faults"], messages: tuple[str, ...]) -> Any:
    """Attach the message of the first fault, or else that of `out.result`, to `out`."""
    faulty = jnp.any(faults)
    out = eqx.branched_error_if(out, faulty, jnp.argmax(faults), list(messages))
    return out.result.error_if(out, ~is_okay(out.result) & ~faulty)
