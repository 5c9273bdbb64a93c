"""Ensembles on several devices."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from ..._base.device import platform
from ..lanes.arguments import Axes
from ..lanes.parts import Inputs
from ..lanes.solution import EnsembleSolution


def default_lanes(mesh: Mesh | None) -> int:
    """As many as a CPU's caches hold the states of, and as keep the units of other devices busy."""
    return 128 if platform(mesh) == "cpu" else 262_144


def check_mesh(mesh: Any, solver: dfx.AbstractSolver) -> None:
    if not isinstance(mesh, Mesh):
        raise TypeError(
            "`mesh` must be None or a `jax.sharding.Mesh` of devices, e.g. "
            f'`jax.make_mesh((jax.device_count(),), ("trajectories",))`, got {type(mesh).__name__}.'
        )
    if mesh.size == 0:
        raise ValueError("`mesh` has no devices. `mesh=None` solves on one device.")
    if not jax.sharding.get_abstract_mesh().empty:
        raise ValueError(
            "`mesh` cannot be used inside `jax.set_mesh` or `jax.shard_map`. Call `mj.solve_ensemble` outside, its "
            "`mesh` is enough."
        )
    # https://github.com/patrick-kidger/lineax/issues/185
    if isinstance(solver, dfx.AbstractImplicitSolver):
        raise ValueError(
            "`mesh` is for explicit solvers: the linear solves of implicit ones (by Lineax) cannot be traced for "
            f"several devices, got {type(solver).__name__}. Use an explicit solver, or `mesh=None` in one process for "
            "each device."
        )


def over_devices(
    solve: Callable[[Inputs, Axes], EnsembleSolution], inputs: Inputs, mesh: Mesh
) -> EnsembleSolution:
    """Return the results of `solve` on every device, each with an equal share of the trajectories, in
    their order.

    Nothing is sent between devices while they solve. Derivatives with respect to what all trajectories
    have in common are summed after each device has gone back through its share.
    """
    equations, batch = inputs
    # Not with explicit axes, whose sizes would have to divide the number of trajectories.
    mesh = Mesh(mesh.devices, mesh.axis_names)
    share = -(-batch.size // mesh.size)
    missing, each = share * mesh.size - batch.size, batch.each
    if missing:
        each = jtu.tree_map(lambda x: _lengthened(x, missing, mesh), each)
    common, static = eqx.partition((equations, batch.common), eqx.is_array)

    def solve_share(common: Any, each: Any) -> EnsembleSolution:
        equations, rest = eqx.combine(common, static)
        own = dataclasses.replace(batch, each=each, common=rest, size=share)
        return solve(Inputs(equations, own), mesh.axis_names)

    shared = PartitionSpec(mesh.axis_names)
    solution = jax.shard_map(
        solve_share,
        mesh=mesh,
        in_specs=(PartitionSpec(), shared),
        out_specs=shared,
        check_vma=False,  # Diffrax's loops mix values that differ between devices with others
    )(common, each)
    shortened = lambda x: _on_all(_on_all(x, mesh)[: batch.size], mesh)
    return jtu.tree_map(shortened, solution) if missing else solution


def _lengthened(x: Array, missing: int, mesh: Mesh) -> Array:
    """Pad an array with copies of the last trajectory."""
    x = _on_all(x, mesh)
    return _on_all(jnp.concatenate([x, jnp.repeat(x[-1:], missing, axis=0)]), mesh)


def _on_all(x: Array, mesh: Mesh) -> Array:
    """Replicate arrays that cannot be shared equally, instead of sending them around piece by piece."""
    return jax.lax.with_sharding_constraint(x, NamedSharding(mesh, PartitionSpec()))
