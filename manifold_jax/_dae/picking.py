"""Numbers of a vector in another order."""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


# Stretches of neighbours up to which they are cut out; more of them are picked one by one.
_MOST_STRETCHES = 16


def pick(source: Float[Array, " a"], index: np.ndarray) -> Float[Array, " n"]:
    """`source[index]`, zero where the index is negative. Cut out in stretches, through which the
    compiler sees, and whose derivative is none of the slow scatters."""
    if len(index) == 0:
        return jnp.zeros((0,), source.dtype)
    steps = np.diff(index)
    joined = np.where(index[1:] < 0, index[:-1] < 0, (steps == 1) & (index[:-1] >= 0))
    starts = np.concatenate([[0], np.nonzero(~joined)[0] + 1, [len(index)]])
    if len(starts) - 1 > _MOST_STRETCHES:
        return jnp.concatenate([source, jnp.zeros((1,), source.dtype)])[index]
    parts = [
        source[index[a] : index[a] + b - a] if index[a] >= 0 else jnp.zeros(b - a, source.dtype)
        for a, b in itertools.pairwise(starts)
    ]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)
