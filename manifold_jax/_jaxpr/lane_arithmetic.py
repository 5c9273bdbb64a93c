"""Arithmetic on numbers; operations on constants are done while tracing.

Known zeros are taken to be exact: `0 x = 0` even if `x` is not finite. They are structural zeros,
as in Jacobians and tableaus.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jax import lax

from . import primitives
from .known_values import evaluated, unsharded
from .lane_arrays import Lanes
from .lane_value import LaneValue, Number, object_array


ELEMENTWISE = frozenset({*primitives.VANISHING, *primitives.ELEMENTWISE}).union(
    ("copy_p", "div", "integer_pow", "mul", "select_n")
)


def elementwise(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    aval = equation.outvars[0].aval
    operands = [np.broadcast_to(v.numbers(), aval.shape) for v in values]
    params = unsharded(equation.params)
    out = [
        apply(lanes, equation.primitive, params, aval.dtype, [x[index] for x in operands])
        for index in np.ndindex(*aval.shape)
    ]
    return [LaneValue.of_numbers(object_array(out, aval.shape), aval.dtype)]


def apply(
    lanes: Lanes, primitive: Any, params: dict[str, Any], dtype: Any, numbers: list[Number]
) -> Number:
    if all(isinstance(x, np.generic) for x in numbers):
        return evaluated(primitive, params, numbers)[0][()]
    rule = _SHORTER.get(primitive.name)
    shorter = None if rule is None else rule(lanes, params, *numbers)
    return lanes.apply(primitive, params, dtype, *numbers) if shorter is None else shorter


def _is(x: Number, value: int) -> bool:
    return isinstance(x, np.generic) and bool(x == value)


def _add(lanes: Lanes, params: Any, a: Number, b: Number) -> Number | None:
    return b if _is(a, 0) else a if _is(b, 0) else None


def _sub(lanes: Lanes, params: Any, a: Number, b: Number) -> Number | None:
    if _is(b, 0):
        return a
    return lanes.apply(lax.neg_p, {}, b.dtype, b) if _is(a, 0) else None


def _mul(lanes: Lanes, params: Any, a: Number, b: Number) -> Number | None:
    for x, y in ((a, b), (b, a)):
        if _is(x, 0):
            return x
        if _is(x, 1):
            return y
        if _is(x, -1):
            return lanes.apply(lax.neg_p, {}, y.dtype, y)
    return None


def _logical(neutral: bool) -> Callable:
    """`and` (`or`); the constant `True` (`False`) is its neutral element."""

    def rule(lanes: Lanes, params: Any, a: Number, b: Number) -> Number | None:
        for x, y in ((a, b), (b, a)):
            if isinstance(x, np.bool_):
                return y if x == neutral else x
        return None

    return rule


def _select(lanes: Lanes, params: Any, which: Number, *cases: Number) -> Number | None:
    if isinstance(which, np.generic):
        return cases[int(which)]
    return cases[0] if all(case is cases[0] for case in cases) else None


def _power(lanes: Lanes, params: Any, x: Number) -> Number | None:
    if params["y"] == 1:
        return x
    return lanes.apply(lax.mul_p, {}, x.dtype, x, x) if params["y"] == 2 else None


_SHORTER = {
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": lambda lanes, params, a, b: a if _is(b, 1) else None,
    "and": _logical(True),
    "or": _logical(False),
    "select_n": _select,
    "convert_element_type": lambda lanes, params, x: x if x.dtype == params["new_dtype"] else None,
    "integer_pow": _power,
    **dict.fromkeys(("copy", "copy_p", "stop_gradient"), lambda lanes, params, x: x),
}
