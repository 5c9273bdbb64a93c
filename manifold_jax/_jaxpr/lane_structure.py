"""Primitives that move numbers, and sums of them."""

import functools
import math
from typing import Any

import numpy as np
from jax import lax

from .._base import device
from .known_values import evaluated
from .lane_arithmetic import apply
from .lane_arrays import Lanes, NotScalarError
from .lane_value import LaneValue, object_array
from .primitives import arranged_factors, sources


def move(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue] | None:
    """Move numbers. Returns `None` if the destinations depend on numbers that are not constants, or if other
    numbers than those of the operand come in."""
    known = lambda i: values[i].known() if values[i].is_known else None
    found = sources(equation, known)
    if found is None or any((place < 0).any() for place in found[1]):
        return None
    which, places = found
    numbers = np.concatenate([values[i].numbers().ravel() for i in which])
    return [
        LaneValue.of_numbers(numbers[place.ravel()].reshape(place.shape), out.aval.dtype)
        for place, out in zip(places, equation.outvars, strict=True)
    ]


def iota(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    return [LaneValue.of_constant(x) for x in evaluated(equation.primitive, equation.params, [])]


def platform(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    """Choose the implementation for the device among several."""
    for i, names in enumerate(equation.params["platforms"]):
        if names is None or device.platform() in names:
            return [LaneValue.of_constant(np.int32(i))]
    raise NotScalarError("there is no implementation for this device")


# Matrix products with more multiplications than this stay whole.
_LARGEST_DOT = 2000


def dot_general(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue] | None:
    aval = equation.outvars[0].aval
    length = math.prod(values[0].shape[i] for i in equation.params["dimension_numbers"][0][0])
    if math.prod(aval.shape) * length > _LARGEST_DOT or values[0].dtype != values[1].dtype:
        return None
    A, B = arranged_factors(equation, [value.numbers() for value in values])
    zero = np.zeros((), aval.dtype)[()]

    def combine(primitive: Any, *numbers: Any) -> Any:
        return apply(lanes, primitive, {}, aval.dtype, list(numbers))

    def entry(k: int, i: int, j: int) -> Any:
        products = map(functools.partial(combine, lax.mul_p), A[k, i], B[k, j])
        return functools.reduce(functools.partial(combine, lax.add_p), products, zero)

    indices = np.ndindex(A.shape[0], A.shape[1], B.shape[1])
    return [
        LaneValue.of_numbers(object_array([entry(*i) for i in indices], aval.shape), aval.dtype)
    ]


REDUCTIONS = {
    "reduce_sum": lax.add_p,
    "reduce_prod": lax.mul_p,
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
}


def reduce(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue] | None:
    primitive, aval = REDUCTIONS[equation.primitive.name], equation.outvars[0].aval
    if primitive in (lax.and_p, lax.or_p) and aval.dtype != bool:
        return None
    x, axes = values[0].numbers(), equation.params["axes"]
    kept = [i for i in range(x.ndim) if i not in axes]
    x = np.transpose(x, (*kept, *axes)).reshape(*aval.shape, -1)
    if x.shape[-1] == 0:
        return None
    combine = lambda a, b: apply(lanes, primitive, {}, aval.dtype, [a, b])
    out = [functools.reduce(combine, x[index]) for index in np.ndindex(*aval.shape)]
    return [LaneValue.of_numbers(object_array(out, aval.shape), aval.dtype)]
