"""What devices that share the trajectories agree on."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


# Names of the axes of a mesh over which trajectories are shared out; none on one device.
Axes = tuple[str, ...]


def largest(x: Array, axes: Axes) -> Array:
    """Of all trajectories. Every process raises what one has to raise: else it would wait for it."""
    return lax.pmax(jnp.max(x), axes) if axes else jnp.max(x)


def anywhere(x: Array, axes: Axes) -> Array:
    return largest(jnp.any(x).astype(jnp.int32), axes) > 0
