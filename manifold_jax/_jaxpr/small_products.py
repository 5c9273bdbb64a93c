"""Functions of small arrays: what is known while tracing is computed then, matrix products are sums."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .known_values import evaluated
from .primitives import arranged_factors
from .trace import called, walk


def with_sums(function: Callable, *args: Any) -> Any:
    """Return `function(*args)`, faster inside a loop that is compiled for a CPU.

    Every matrix product is computed as a sum of products: XLA hands even small ones to a library, which
    takes microseconds, while sums become part of the operations around them. All that does not depend on
    traced values is computed at once; XLA would compute parts of it in every iteration. `args` and the
    result are pytrees of arrays.
    """
    known: list[Any] = []
    leaves, structure = jtu.tree_flatten(args)

    def flat(*leaves: Any) -> list[Any]:
        out, tree = jtu.tree_flatten(function(*jtu.tree_unflatten(structure, leaves)))
        known.append(tree)
        return out

    closed = jax.make_jaxpr(flat)(*leaves)
    return jtu.tree_unflatten(known[0], walk(closed, leaves, lambda x: x, _apply))


def _apply(equation: Any, values: list[Any]) -> list[Any]:
    inner = called(equation)
    if inner is not None and equation.primitive.name in ("jit", "pjit"):
        return walk(inner, values, lambda x: x, _apply)
    if equation.primitive.name == "dot_general":
        a, b = arranged_factors(equation, values)
        product = jnp.sum(a[:, :, None] * b[:, None], axis=-1)
        out = equation.outvars[0].aval
        return [product.reshape(out.shape).astype(out.dtype)]
    if not any(isinstance(x, jax.core.Tracer) for x in values):
        return evaluated(equation.primitive, equation.params, list(map(np.asarray, values)))
    out = equation.primitive.bind(*values, **equation.params)
    return list(out) if equation.primitive.multiple_results else [out]
