"""Walks through traced functions with values of any kind in the place of arrays."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jax_core
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from .._base.compat import scan_counts


def walk(function: Any, inputs: Sequence[Any], constant: Callable, apply: Callable) -> list[Any]:
    """Evaluate a jaxpr, with or without its constants, at the values `inputs`, in order. `constant(x)`
    is the value of a constant; `apply(equation, values)` returns those of the results of an equation."""
    jaxpr, constants = getattr(function, "jaxpr", function), getattr(function, "consts", ())
    known = dict(zip(jaxpr.constvars, map(constant, constants), strict=True))
    known.update(zip(jaxpr.invars, inputs, strict=True))

    def read(v: Any) -> Any:
        is_literal = isinstance(v, jax_core.Literal)
        return constant(np.asarray(v.val, v.aval.dtype)) if is_literal else known[v]  # pyright: ignore[reportAttributeAccessIssue]

    for equation in jaxpr.eqns:
        out = apply(equation, [read(v) for v in equation.invars])
        known.update(zip(equation.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def called(equation: Any) -> Any:
    """Return the function that an equation applies to exactly its operands, if it does only that."""
    shapes = lambda variables: [variable.aval.shape for variable in variables]
    kinds = jax_core.Jaxpr | jax_core.ClosedJaxpr
    inner = [p for p in equation.params.values() if isinstance(p, kinds)]
    if len(inner) != 1:
        return None
    jaxpr = getattr(inner[0], "jaxpr", inner[0])
    same = shapes(jaxpr.invars) == shapes(equation.invars)
    return inner[0] if same and shapes(jaxpr.outvars) == shapes(equation.outvars) else None


def unrolled_scan(
    equation: Any, values: list[Any], through: Callable, item: Callable, stack: Callable
) -> list[Any]:
    """Evaluate a scan iteration by iteration. `through(function, values)` evaluates the body,
    `item(value, i)` is one row, and `stack(values, aval)` puts rows together."""
    (n, m), params = scan_counts(equation), equation.params
    constants, carry, xs = values[:n], values[n : n + m], values[n + m :]
    rows: list[list[Any]] = [[]] * params["length"]
    for i in range(params["length"])[:: -1 if params["reverse"] else 1]:
        after = through(params["jaxpr"], [*constants, *carry, *(item(x, i) for x in xs)])
        carry, rows[i] = after[:m], after[m:]
    outs = enumerate(equation.outvars[m:])
    return [*carry, *(stack([row[k] for row in rows], out.aval) for k, out in outs)]


def example(shape: tuple[int, ...], dtype: Any) -> jax.ShapeDtypeStruct:
    """Return the shape and dtype of an array of one lane. Inside `jax.shard_map` the types of arrays
    name the mesh, and `eqx.filter_closure_convert` refuses types without it after one with it."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return jax.ShapeDtypeStruct(shape, dtype)
    whole = PartitionSpec(*(None for _ in shape))
    return jax.ShapeDtypeStruct(shape, dtype, sharding=NamedSharding(mesh, whole))


def num_equations(function: Callable[..., Any], *examples: Any) -> int:
    """Count the equations of the traced function, inner functions included."""
    return _length(jax.make_jaxpr(function)(*examples).jaxpr)


def _length(jaxpr: Any) -> int:
    inner = (f for e in jaxpr.eqns for f in jax_core.jaxprs_in_params(e.params))
    return len(jaxpr.eqns) + sum(map(_length, inner))
