"""Which kind of device a program is compiled for."""

from typing import Any

import jax
from jax.sharding import Mesh


def platform(mesh: Mesh | None = None) -> str:
    """Return "cpu", "gpu" or "tpu": of the devices of `mesh`, else of `jax.default_device`, else of JAX's own
    choice."""
    if mesh is not None:
        return mesh.devices.flat[0].platform
    config: Any = jax.config
    chosen = config.jax_default_device
    if chosen is None:
        return jax.default_backend()
    return chosen if isinstance(chosen, str) else chosen.platform
