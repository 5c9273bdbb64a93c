"""The trajectories of an ensemble, shared out among devices."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from .arguments import Batch
from .solution import EnsembleSolution
from .trajectory import Equations


Inputs = tuple[Equations, Batch]


def check_mesh(mesh: Any) -> None:
    if not isinstance(mesh, Mesh):
        raise TypeError(
            "`mesh` must be None or a `jax.sharding.Mesh` of devices, e.g. "
            f'`jax.make_mesh((jax.device_count(),), ("trajectories",))`, got {type(mesh).__name__}.'
        )
    if mesh.empty or mesh.size == 0:
        raise ValueError("`mesh` has no devices; None solves on one device.")


def over_devices(
    solve: Callable[[Inputs], EnsembleSolution], inputs: Inputs, mesh: Mesh
) -> EnsembleSolution:
    """`solve` on every device, each with an equal share of the trajectories; in their order.

    Devices speak to each other only for derivatives with respect to what all trajectories have in
    common, which are added up after each has gone back through its own share."""
    equations, batch = inputs
    share = -(-batch.size // mesh.size)
    each = jtu.tree_map(lambda x: _lengthened(x, share * mesh.size), batch.each)
    common, static = eqx.partition((equations, batch.common), eqx.is_array)

    def solve_share(common: Any, each: Any) -> EnsembleSolution:
        equations, rest = eqx.combine(common, static)
        own = dataclasses.replace(batch, each=each, common=rest, size=share)
        return solve((equations, own))

    # Sharding is not part of the types of arrays outside: not for the axes of this mesh.
    mesh = Mesh(mesh.devices, mesh.axis_names)
    shared = PartitionSpec(mesh.axis_names)
    # Diffrax's loops carry values of which some start alike on all devices, and do not say so.
    solution = jax.shard_map(
        solve_share,
        mesh=mesh,
        in_specs=(PartitionSpec(), shared),
        out_specs=shared,
        check_vma=False,
    )(common, each)
    return jtu.tree_map(lambda x: x[: batch.size], solution)


def _lengthened(x: Array, size: int) -> Array:
    """By copies of the last trajectory, where it does not divide among the devices."""
    missing = size - x.shape[0]
    return jnp.concatenate([x, jnp.repeat(x[-1:], missing, axis=0)]) if missing else x
