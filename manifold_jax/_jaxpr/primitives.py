"""Primitives of JAX: those that vanish at zero, those that only move numbers."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .known_values import evaluated


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


# The operands that are moved; those after them say where to.
_OF_FIRST = "broadcast_in_dim copy copy_p reshape rev slice squeeze transpose"
_MOVED = dict.fromkeys(_OF_FIRST.split(), slice(1)) | {
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
