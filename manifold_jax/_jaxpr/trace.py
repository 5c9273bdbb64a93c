"""What functions are traced with, and how long a traced function is."""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jax_core
from jax.sharding import NamedSharding, PartitionSpec


def example(shape: tuple[int, ...], dtype: Any) -> jax.ShapeDtypeStruct:
    """Return the shape and type of an array of one lane. Inside `jax.shard_map` the types of
    arrays name the mesh, and
    `eqx.filter_closure_convert` refuses those that do not where it has seen others."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.ShapeDtypeStruct(shape, dtype)
    whole = PartitionSpec(*(None for _ in shape))
    return jax.ShapeDtypeStruct(shape, dtype, sharding=NamedSharding(mesh, whole))


def num_equations(function: Callable[..., Any], *examples: Any) -> int:
    """Count the equations of the traced function, inner functions included."""
    return _length(jax.make_jaxpr(function)(*examples).jaxpr)


def _length(jaxpr: Any) -> int:
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for inner in jax_core.jaxprs_in_params(equation.params):
            total += _length(inner)
    return total
