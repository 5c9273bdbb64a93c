"""Operations that move numbers, and sums of them."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .lane_arithmetic import add, apply, multiply
from .lane_arrays import Lanes, NotScalarError
from .lane_value import object_array, Value


# With the number of operands, from the front, that are moved; what follows says where to.
_MOVED = {
    "broadcast_in_dim": 1,
    "concatenate": None,
    "dynamic_slice": 1,
    "dynamic_update_slice": 2,
    "expand_dims": 1,
    "gather": 1,
    "pad": 2,
    "reshape": 1,
    "rev": 1,
    "scatter": (0, 2),
    "slice": 1,
    "split": 1,
    "squeeze": 1,
    "stack": None,
    "tile": 1,
    "transpose": 1,
    "unstack": 1,
}
MOVES = frozenset(_MOVED)


def move(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value] | None:
    """The primitive itself is asked where each number goes, with their indices for numbers. `None`
    if that depends on numbers that are not constants."""
    which = _MOVED[equation.primitive.name]
    if which is None or isinstance(which, int):
        which = tuple(range(len(values) if which is None else which))
    if not all(v.is_known for i, v in enumerate(values) if i not in which):
        return None
    numbers = [values[i].numbers().ravel() for i in which]
    offsets = np.cumsum([0, *(x.size for x in numbers)])
    operands = [None if i in which else v.known() for i, v in enumerate(values)]
    for offset, i in zip(offsets, which, strict=False):
        shape = values[i].shape
        # From one on: what is filled in from nowhere is zero or negative.
        indices = offset + 1 + np.arange(int(np.prod(shape)), dtype=np.int32)
        operands[i] = indices.reshape(shape).astype(np.int32)
    moved = _bind(equation, operands)
    if any((x <= 0).any() for x in moved):
        return None
    flat = np.concatenate(numbers)
    return [
        Value.of_numbers(object_array([flat[k - 1] for k in x.ravel()], x.shape), out.aval.dtype)
        for x, out in zip(moved, equation.outvars, strict=True)
    ]


def _bind(equation: Any, operands: list[Any]) -> list[np.ndarray]:
    params = dict(equation.params)
    if "sharding" in params:
        params["sharding"] = None
    with jax.ensure_compile_time_eval():
        out = equation.primitive.bind(*map(jnp.asarray, operands), **params)
    return [np.asarray(x) for x in (out if equation.primitive.multiple_results else [out])]


def iota(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    return [Value.of_constant(x) for x in _bind(equation, [])]


def platform(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value]:
    """Which of several implementations is meant for the device."""
    for i, names in enumerate(equation.params["platforms"]):
        if names is None or jax.default_backend() in names:
            return [Value.of_constant(np.int32(i))]
    raise NotScalarError("there is no implementation for this device")


# Products beyond which a matrix product stays one.
_LARGEST_DOT = 2000


def dot_general(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value] | None:
    (a_sum, b_sum), (a_batch, b_batch) = equation.params["dimension_numbers"]
    aval = equation.outvars[0].aval
    length = int(np.prod([values[0].shape[i] for i in a_sum]))
    if int(np.prod(aval.shape)) * length > _LARGEST_DOT or values[0].dtype != values[1].dtype:
        return None
    A, batch, a_free = _arranged(values[0], a_batch, a_sum)
    B, _, b_free = _arranged(values[1], b_batch, b_sum)
    zero = np.zeros((), aval.dtype)[()]

    def entry(k: int, i: int, j: int) -> Any:
        products = (multiply(lanes, x, y) for x, y in zip(A[k, i], B[k, j], strict=True))
        return functools.reduce(lambda s, p: add(lanes, s, p), products, zero)

    shape = A.shape[0], A.shape[1], B.shape[1]
    out = object_array([entry(*index) for index in np.ndindex(*shape)], shape)
    return [Value.of_numbers(out.reshape((*batch, *a_free, *b_free)), aval.dtype)]


def _arranged(value: Value, batch: Any, summed: Any) -> tuple[np.ndarray, list[int], list[int]]:
    """Arrange a value with axes `(batch, free, summed)`."""
    x = value.numbers()
    free = [i for i in range(x.ndim) if i not in (*batch, *summed)]
    sizes = [[x.shape[i] for i in axes] for axes in (batch, free, summed)]
    x = np.transpose(x, (*batch, *free, *summed))
    return x.reshape([int(np.prod(size)) for size in sizes]), sizes[0], sizes[1]


_REDUCTIONS = {
    "reduce_sum": lax.add_p,
    "reduce_prod": lax.mul_p,
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
}
REDUCTIONS = frozenset(_REDUCTIONS)


def reduce(lanes: Lanes, equation: Any, values: list[Value]) -> list[Value] | None:
    primitive, aval = _REDUCTIONS[equation.primitive.name], equation.outvars[0].aval
    if primitive in (lax.and_p, lax.or_p) and aval.dtype != bool:
        return None
    x, axes = values[0].numbers(), equation.params["axes"]
    kept = [i for i in range(x.ndim) if i not in axes]
    x = np.transpose(x, (*kept, *axes)).reshape(*aval.shape, -1)
    if x.shape[-1] == 0:
        return None
    combine = lambda a, b: apply(lanes, primitive, {}, aval.dtype, [a, b])
    out = [functools.reduce(combine, x[index]) for index in np.ndindex(*aval.shape)]
    return [Value.of_numbers(object_array(out, aval.shape), aval.dtype)]
