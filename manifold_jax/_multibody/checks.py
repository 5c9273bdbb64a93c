"""What users give: numbers, vectors, names."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def floating(value: Any) -> Array:
    """A floating-point array; concrete ones in NumPy first, which starts no program."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return jnp.asarray(value, float)


def is_concrete(value: Any) -> bool:
    return not isinstance(value, jax.core.Tracer)


def check_vector(what: str, value: Any, size: int) -> Array:
    try:
        vector = floating(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be of shape ({size},), got {value!r}.") from None
    if vector.shape != (size,):
        raise ValueError(f"{what} must be of shape ({size},), got {vector.shape}.")
    if is_concrete(vector) and not np.all(np.isfinite(vector)):
        raise ValueError(f"{what} must be finite, got {np.asarray(vector)}.")
    return vector


def check_axis(what: str, value: Any) -> Array:
    axis = check_vector(what, value, 3)
    if is_concrete(axis) and not np.linalg.norm(axis) > 0:
        raise ValueError(f"{what} is zero: an axis needs a direction.")
    return axis


def unique_names(what: str, names: Sequence[str]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"Every {what} needs its own name; there are several called {twice}.")
    return tuple(names)
