"""Values that were computed elsewhere, with the derivative of the function that they are values of."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .closure import convert_closure
from .derivative_rule import apply_linear, ForwardRule


def known_value(function: Callable, value: Any, *args: Any) -> Any:
    """Return `value`, which is `function(*args)`, with the derivative of the function.

    Nothing is compiled for a derivative that is not needed. (JAX transposes a loop also where no
    cotangent reaches it, and 0.10 fails if one reaches only some of its results.)
    """
    return _known_value(convert_closure(function, *args), args, jax.lax.stop_gradient(value))


@ForwardRule
def _known_value(function: Callable, args: tuple, value: Any) -> Any:
    del function, args
    return value


@_known_value.define_jvp
def _known_value_jvp(value: Any, primals: tuple, tangents: tuple) -> Any:
    inputs, along = primals[:2], tangents[:2]
    structure = jtu.tree_structure(inputs)
    has_tangent = [dx is not None for dx in structure.flatten_up_to(along)]
    is_perturbed = jtu.tree_unflatten(structure, has_tangent)
    arrays, static = eqx.partition(inputs, eqx.is_array)

    def forward(arrays: Any, along: Any) -> Any:
        return eqx.filter_jvp(_evaluate, (eqx.combine(arrays, static),), (along,))[1]

    def transpose(arrays: Any, cotangents: Any) -> Any:
        perturbed, fixed = eqx.partition(eqx.combine(arrays, static), is_perturbed)
        out, pullback = eqx.filter_vjp(lambda x: _evaluate(eqx.combine(x, fixed)), perturbed)
        zero = jtu.tree_map(jnp.zeros_like, out)
        return pullback(eqx.combine(cotangents, zero))[0]

    return apply_linear(forward, transpose, value, arrays, along)


def _evaluate(inputs: tuple[Callable, tuple]) -> Any:
    function, args = inputs
    return function(*args)
