"""Calls, branches and loops."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._base.compat import scan_counts
from .lane_arithmetic import apply
from .lane_arrays import Lanes
from .lane_value import object_array, Value


Evaluate = Callable[[Lanes, Any, list[Value]], list[Value]]

# Repetitions that are written out.
_LONGEST_WRITTEN_OUT = 16


def call(evaluate: Evaluate, lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    params = equation.params
    inner = params.get("jaxpr", params.get("call_jaxpr", params.get("fun_jaxpr")))
    return evaluate(lanes, inner, values)


def linear_solve(
    evaluate: Evaluate, lanes: Lanes, equation: Any, values: list[Value]
) -> list[Value]:
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    before = lengths.matvec + lengths.vecmat
    constants = values[before : before + lengths.solve]
    return evaluate(lanes, jaxprs.solve, constants + values[sum(lengths) :])


def cond(evaluate: Evaluate, lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    """All branches, unless it is known which is taken."""
    which, *operands = values
    branches = equation.params["branches"]
    if which.is_known:
        return evaluate(lanes, branches[int(which.known())], operands)
    number = which.numbers()[()]
    outs = [evaluate(lanes, branch, operands) for branch in branches]
    chosen = []
    for cases in zip(*outs, strict=True):
        value = cases[0]
        for k, case in enumerate(cases[1:], 1):
            here = apply(lanes, lax.ge_p, {}, bool, [number, number.dtype.type(k)])
            value = _selected(lanes, here, case, value)
        chosen.append(value)
    return chosen


def scan(
    evaluate: Evaluate, lanes: Lanes, equation: Any, values: list[Value]
) -> list[Value] | None:
    params, length = equation.params, equation.params["length"]
    if length > _LONGEST_WRITTEN_OUT:
        return None
    num_consts, num_carry = scan_counts(equation)
    consts, carry = values[:num_consts], values[num_consts : num_consts + num_carry]
    stacked = [x.numbers() for x in values[num_consts + num_carry :]]
    dtypes = [x.dtype for x in values[num_consts + num_carry :]]
    rows = []
    for i in reversed(range(length)) if params["reverse"] else range(length):
        taken = [x[i] if x.ndim > 1 else object_array([x[i]], ()) for x in stacked]
        xs = [Value.of_numbers(x, dtype) for x, dtype in zip(taken, dtypes, strict=True)]
        out = evaluate(lanes, params["jaxpr"], [*consts, *carry, *xs])
        carry = out[:num_carry]
        rows.append(out[num_carry:])
    if params["reverse"]:
        rows.reverse()
    avals = [v.aval for v in equation.outvars[num_carry:]]
    columns = zip(*rows, strict=True) if rows else [[] for _ in avals]
    ys = []
    for column, aval in zip(columns, avals, strict=True):
        flat = [x for row in column for x in row.numbers().ravel()]
        ys.append(Value.of_numbers(object_array(flat, aval.shape), aval.dtype))
    return [*carry, *ys]


def while_loop(evaluate: Evaluate, lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    """Evaluate a loop for as long as any lane goes on; the others keep what they have."""
    params = equation.params
    m, n = params["cond_nconsts"], params["body_nconsts"]
    cond_consts, body_consts, start = values[:m], values[m : m + n], values[m + n :]
    cond_consts, body_consts = (
        [value.entering(lanes) for value in values] for values in (cond_consts, body_consts)
    )
    entering = lambda values: [value.entering(lanes) for value in values]
    shapes = [(v.shape, v.dtype) for v in start]
    flat = [x for v in start for x in v.columns(lanes)]

    def unflatten(flat: list[Any]) -> list[Value]:
        out, k = [], 0
        for shape, dtype in shapes:
            size = int(np.prod(shape))
            out.append(Value.of_numbers(object_array(flat[k : k + size], shape), dtype))
            k += size
        return out

    def goes_on(values: list[Value]) -> jax.Array:
        (out,) = evaluate(lanes, params["cond_jaxpr"], [*entering(cond_consts), *values])
        return out.columns(lanes)[0]

    def body(carry: tuple[jax.Array, list[jax.Array]]) -> tuple[jax.Array, list[jax.Array]]:
        active, flat = carry
        with lanes.inside():
            new = evaluate(lanes, params["body_jaxpr"], [*entering(body_consts), *unflatten(flat)])
            numbers = [x for v in new for x in v.columns(lanes)]
            flat = [lax.select(active, a, b) for a, b in zip(numbers, flat, strict=True)]
            return active & goes_on(unflatten(flat)), flat

    active = goes_on(unflatten(flat))
    _, flat = lax.while_loop(lambda carry: jnp.any(carry[0]), body, (active, flat))
    return unflatten(flat)


def _selected(lanes: Lanes, here: Any, a: Value, b: Value) -> Value:
    pairs = zip(a.numbers().ravel(), b.numbers().ravel(), strict=True)
    out = [apply(lanes, lax.select_n_p, {}, a.dtype, [here, y, x]) for x, y in pairs]
    return Value.of_numbers(object_array(out, a.shape), a.dtype)
