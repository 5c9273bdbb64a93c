"""Primitives of JAX: their values for known operands, and those that only move numbers."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


# Elementwise primitives: those whose value at zeros is zero, and others.
VANISHING = """
    abs add add_any asin asinh atan atanh cbrt ceil convert_element_type copy erf expm1 floor imag
    log1p max min neg real reduce_precision round sign sin sinh sqrt square stop_gradient sub tan tanh
""".split()
ELEMENTWISE = """
    acos acosh and atan2 bessel_i0e bessel_i1e clamp complex conj cos cosh digamma eq erf_inv erfc exp
    exp2 ge gt igamma igamma_grad_a igammac is_finite le lgamma log logistic lt ne nextafter not or
    polygamma pow regularized_incomplete_beta rem rsqrt xor zeta
""".split()


def _slice(parameters: dict, x: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, parameters["start_indices"], parameters["limit_indices"], strides))]


def _reshape(parameters: dict, x: np.ndarray) -> np.ndarray:
    order = parameters["dimensions"]  # in which the axes are read
    return (x if order is None else x.transpose(order)).reshape(parameters["new_sizes"])


def _broadcast(parameters: dict, x: np.ndarray) -> np.ndarray:
    shape, own = parameters["shape"], parameters["broadcast_dimensions"]
    new = tuple(axis for axis in range(len(shape)) if axis not in own)
    return np.broadcast_to(np.expand_dims(x, new), shape)


_MOVED_BY_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda parameters, *xs: np.concatenate(xs, parameters["dimension"]),
    "copy": lambda parameters, x: x,
    "copy_p": lambda parameters, x: x,
    "reshape": _reshape,
    "rev": lambda parameters, x: np.flip(x, parameters["dimensions"]),
    "slice": _slice,
    "squeeze": lambda parameters, x: np.squeeze(x, tuple(parameters["dimensions"])),
    "transpose": lambda parameters, x: x.transpose(parameters["permutation"]),
}
_COMPUTED_BY_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "div": np.divide,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "sub": np.subtract,
}


def evaluated(primitive: Any, params: dict, operands: Sequence[Any]) -> list[np.ndarray]:
    """Return the results for known operands, by NumPy where that is quicker."""
    name = primitive.name
    if name in _MOVED_BY_NUMPY:
        return [_MOVED_BY_NUMPY[name](params, *operands)]
    rounds = name == "div" and not np.issubdtype(operands[0].dtype, np.inexact)  # towards zero
    if name in _COMPUTED_BY_NUMPY and not rounds:
        with np.errstate(all="ignore"):
            return [np.asarray(_COMPUTED_BY_NUMPY[name](*operands))]
    with jax.ensure_compile_time_eval():
        out = primitive.bind(*map(jnp.asarray, operands), **unsharded(params))
    return [np.asarray(x) for x in (out if primitive.multiple_results else [out])]


def unsharded(params: dict) -> dict:
    """Return the parameters of the primitive for arrays of a single device."""
    return {**params, "sharding": None} if "sharding" in params else params


# The operands that are moved; those after them say where to.
_MOVED = dict.fromkeys(_MOVED_BY_NUMPY, slice(1)) | {
    "concatenate": slice(None),
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "expand_dims": slice(1),
    "gather": slice(1),
    "pad": slice(2),
    "scatter": slice(0, 3, 2),
    "split": slice(1),
    "stack": slice(None),
    "tile": slice(1),
    "unstack": slice(1),
}
MOVES = frozenset(_MOVED)


def sources(
    equation: Any, known: Callable[[int], np.ndarray | None]
) -> tuple[Sequence[int], list[np.ndarray]] | None:
    """Return which operands are moved, and for each number of the results its index among all
    numbers of these, negative where a constant is filled in. `None` if that depends on operands
    that are not known.

    Found by applying the primitive to indices instead of numbers.
    """
    which = range(len(equation.invars))[_MOVED[equation.primitive.name]]
    start, operands = 0, []
    for i, variable in enumerate(equation.invars):
        if i in which:
            end = start + math.prod(variable.aval.shape)
            operands.append(np.arange(start, end, dtype=np.int32).reshape(variable.aval.shape))
            start = end
        else:
            operands.append(known(i))
    if any(operand is None for operand in operands):
        return None
    is_gather = equation.primitive.name == "gather"
    params = {**equation.params, "fill_value": -1} if is_gather else equation.params
    return which, evaluated(equation.primitive, params, operands)


def arranged_factors(equation: Any, factors: Sequence[Any]) -> list[Any]:
    """Return the factors of a `dot_general` with their axes rearranged: one that both have in common,
    one of the factor's own, one that is summed over, and trailing ones absent in arrays of numbers."""
    out = []
    axes = equation.params["dimension_numbers"]
    for variable, x, summed, batch in zip(equation.invars, factors, *axes, strict=True):
        ndim = variable.aval.ndim
        free = [i for i in range(ndim) if i not in (*batch, *summed)]
        sizes = [math.prod(x.shape[i] for i in group) for group in (batch, free, summed)]
        x = x.transpose(*batch, *free, *summed, *range(ndim, x.ndim))
        out.append(x.reshape(*sizes, *x.shape[ndim:]))
    return out
