"""What functions are traced with."""

from typing import Any

import jax
from jax.sharding import NamedSharding, PartitionSpec


def example(shape: tuple[int, ...], dtype: Any) -> jax.ShapeDtypeStruct:
    """Of an array of one lane. Inside `jax.shard_map` the types of arrays name the mesh, and
    `eqx.filter_closure_convert` refuses those that do not where it has seen others."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.ShapeDtypeStruct(shape, dtype)
    whole = PartitionSpec(*(None for _ in shape))
    return jax.ShapeDtypeStruct(shape, dtype, sharding=NamedSharding(mesh, whole))
