"""Primitives that only move numbers, on NumPy arrays."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def _squeeze(parameters: dict, x: np.ndarray) -> np.ndarray:
    gone = {axis % x.ndim for axis in parameters["dimensions"]}
    return x.reshape([size for axis, size in enumerate(x.shape) if axis not in gone])


def _slice(parameters: dict, x: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or (1,) * x.ndim
    bounds = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return x[tuple(slice(*bound) for bound in bounds)]


def _broadcast(parameters: dict, x: np.ndarray) -> np.ndarray:
    shape = [1] * len(parameters["shape"])
    for axis, size in zip(parameters["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), parameters["shape"])


_WITH_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda parameters, *xs: np.concatenate(xs, parameters["dimension"]),
    "copy": lambda parameters, x: x,
    "copy_p": lambda parameters, x: x,
    "reshape": lambda parameters, x: x.reshape(parameters["new_sizes"]),
    "rev": lambda parameters, x: np.flip(x, parameters["dimensions"]),
    "slice": _slice,
    "squeeze": _squeeze,
    "transpose": lambda parameters, x: x.transpose(parameters["permutation"]),
}
# By the primitive itself, with how many of its operands are moved, from the front; what follows
# says where to.
_BY_JAX = {
    "dynamic_slice": 1,
    "dynamic_update_slice": 2,
    "expand_dims": 1,
    "gather": 1,
    "pad": 2,
    "split": 1,
    "stack": None,
    "tile": 1,
    "unstack": 1,
}
MOVES = frozenset(_WITH_NUMPY) | frozenset(_BY_JAX)


def num_moved(name: str, operands: int) -> int:
    """How many of the operands are moved; the values of the others must be known."""
    number = _BY_JAX.get(name)
    return operands if number is None else number


def move(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """What the equation does to arrays of whole numbers; negative ones come from nowhere."""
    name = equation.primitive.name
    if name in _WITH_NUMPY:
        return [_WITH_NUMPY[name](equation.params, *operands[: _operands_of(name)])]
    parameters = dict(equation.params)
    if name == "gather":
        parameters["fill_value"] = -1
    return bind(equation, operands, parameters)


def _operands_of(name: str) -> int | None:
    return None if name == "concatenate" else 1


def bind(equation: Any, operands: list[np.ndarray], parameters: dict) -> list[np.ndarray]:
    """The primitive itself, on known values."""
    with jax.ensure_compile_time_eval():
        out = equation.primitive.bind(*map(jnp.asarray, operands), **parameters)
    return [np.asarray(x) for x in (out if equation.primitive.multiple_results else [out])]


def landing(equation: Any, operand: tuple, indices: np.ndarray, update: tuple) -> np.ndarray:
    """Where each number of the update of a scatter goes: its index in the flat operand, -1 if it is
    dropped. Shapes of operand and update."""
    keep = ("indices_are_sorted", "unique_indices", "mode")
    settings = {name: equation.params[name] for name in keep}

    def scattered(u: Any) -> Any:
        return lax.scatter_add(
            jnp.zeros(operand, u.dtype),
            jnp.asarray(indices),
            u,
            equation.params["dimension_numbers"],
            **settings,
        )

    with jax.ensure_compile_time_eval():
        places = jnp.asarray(1.0 + np.arange(int(np.prod(operand))).reshape(operand))
        (found,) = jax.linear_transpose(scattered, jnp.zeros(update, places.dtype))(places)
    return np.asarray(np.rint(np.asarray(found)) - 1, int).reshape(update)
