"""Functions whose closed-over arrays are leaves of a pytree."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun


class ConvertedClosure(eqx.Module):
    """A function with closed-over arrays as leaves, made by [`convert_closure`][]."""

    constants: list[Any]
    jaxpr: Jaxpr  # a leaf, not static, so that conversions of two functions have one structure
    inputs: Any = eqx.field(static=True)  # treedef and static leaves of the arguments
    outputs: Any = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, treedef = jtu.tree_flatten(arrays)
        kinds = [(v.aval.shape, v.aval.dtype) for v in self.jaxpr.invars]  # pyright: ignore[reportAttributeAccessIssue]
        given = [(x.shape, x.dtype) for x in leaves]
        if (treedef, static) != self.inputs or given != kinds:
            raise ValueError(
                f"A function that was traced with arrays {kinds} was called with {given}, or with another structure."
            )
        out = jaxpr_as_fun(ClosedJaxpr(self.jaxpr, self.constants))(*leaves)
        out_treedef, out_static = self.outputs
        return eqx.combine(jtu.tree_unflatten(out_treedef, out), out_static)


def convert_closure(function: Callable, *examples: Any) -> Callable:
    """Return `function` with the arrays that it closes over as leaves, so that they are
    differentiated where it is passed on. It can then be called with arguments like the examples.

    `eqx.filter_closure_convert` requires arguments to vary over the same mesh axes as well, which
    inside `jax.pmap` and `jax.shard_map` differ between the first step and the next.
    """
    arrays, static = eqx.partition(examples, _is_example)
    leaves, treedef = jtu.tree_flatten(arrays)
    known: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        out = function(*eqx.combine(jtu.tree_unflatten(treedef, leaves), static))
        out_arrays, out_static = eqx.partition(out, eqx.is_array)
        out_leaves, out_treedef = jtu.tree_flatten(out_arrays)
        known.append((out_treedef, out_static))
        return out_leaves

    closed = jax.make_jaxpr(flat)(*map(_without_weak_type, leaves))
    return ConvertedClosure(closed.consts, closed.jaxpr, (treedef, static), known[0])


def _is_example(x: Any) -> bool:
    return eqx.is_array(x) or isinstance(x, jax.ShapeDtypeStruct)


def _without_weak_type(x: Any) -> Any:
    return jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
