"""The interpreter: a traced function, evaluated with numbers instead of arrays."""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jax_core
import jax.tree_util as jtu
import numpy as np

from . import lane_control as control, lane_structure as structure
from .lane_arithmetic import ELEMENTWISE, elementwise
from .lane_arrays import Lanes, NotScalarError
from .lane_value import Value
from .trace import example


_CALLS = frozenset(
    "jit pjit closed_call core_call custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr remat2 "
    "checkpoint call_with_derivative_rule".split()
)
_CONTROL = {
    "cond": control.cond,
    "custom_linear_solve": control.linear_solve,
    "linear_solve": control.linear_solve,
    "scan": control.scan,
    "while": control.while_loop,
}
_OTHERS = {
    "dot_general": structure.dot_general,
    "iota": structure.iota,
    "platform_index": structure.platform,
}
# Numbers of an array beyond which it stays one.
_LARGEST_ARRAY = 1000


def call_in_lanes(lanes: Lanes, function: Callable, *args: Any) -> Any:
    """`function(*args)` in every lane. Leaves of `args` are [`Value`][]s, those of what is returned,
    too. What the function closes over is the same in every lane."""
    leaves, treedef = jtu.tree_flatten(args)
    examples = jtu.tree_unflatten(treedef, [example(v.shape, v.dtype) for v in leaves])
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*examples)
    out = evaluate(lanes, closed, leaves)
    return jtu.tree_unflatten(jtu.tree_structure(shape), out)


def evaluate(lanes: Lanes, function: Any, values: list[Value]) -> list[Value]:
    """A jaxpr, with or without its constants."""
    jaxpr, constants = getattr(function, "jaxpr", function), getattr(function, "consts", [])
    known: dict[Any, Value] = {}

    def read(v: Any) -> Value:
        if isinstance(v, jax_core.Literal):
            return Value.of_constant(np.asarray(v.val, v.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
        return known[v]

    for v, c in zip(jaxpr.constvars, constants, strict=True):
        known[v] = Value.of_constant(c)
    for v, x in zip(jaxpr.invars, values, strict=True):
        known[v] = x
    for equation in jaxpr.eqns:
        out = _evaluated(lanes, equation, [read(v) for v in equation.invars])
        known.update(zip(equation.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _evaluated(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    name = equation.primitive.name
    if any(jax.dtypes.issubdtype(v.aval.dtype, jax.dtypes.extended) for v in equation.outvars):  # pyright: ignore[reportPrivateImportUsage]
        raise NotScalarError(f"`{name}` makes random keys")
    if name in _CALLS:
        return control.call(evaluate, lanes, equation, values)
    out = None
    if name in _CONTROL:
        out = _CONTROL[name](evaluate, lanes, equation, values)
    elif (
        max((v.aval.size for v in (*equation.outvars, *equation.invars)), default=0)
        <= _LARGEST_ARRAY
    ):
        rule = _rule(name)
        out = None if rule is None else rule(lanes, equation, values)
    return _on_whole_arrays(lanes, equation, values) if out is None else out


def _rule(name: str) -> Callable | None:
    if name in ELEMENTWISE:
        return elementwise
    if name in structure.MOVES:
        return structure.move
    if name in structure.REDUCTIONS:
        return structure.reduce
    return _OTHERS.get(name)


def _on_whole_arrays(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    """What there is no rule for: the operation itself, mapped over the lanes."""
    lanes.whole.add(equation.primitive.name)
    lanes.count_operations(1)

    def bind(*operands: jax.Array) -> list[jax.Array]:
        out = equation.primitive.bind(*operands, **equation.params)
        return list(out) if equation.primitive.multiple_results else [out]

    if not values:
        return [Value.of_constant(x) for x in bind()]
    out = jax.vmap(bind, in_axes=-1, out_axes=-1)(*(v.whole(lanes) for v in values))
    return [Value.of_whole(x) for x in out]
