"""Dependence of the results of one primitive on its operands, number by number."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .known_values import evaluated
from .primitives import arranged_factors, ELEMENTWISE, MOVES, sources, VANISHING


class Dependence(NamedTuple):
    """The dependence of an array of shape `S` on the inputs."""

    # On which inputs each number depends. The last column is a flag, whether the number may be other
    # than zero: for sums and moves it follows the same rule.
    depends: np.ndarray  # (*S, inputs + 1), bool
    known: np.ndarray | None = None  # the numbers, if they are constants

    @staticmethod
    def constant(known: np.ndarray, inputs: int) -> "Dependence":
        return Dependence(flagged(np.zeros((*known.shape, inputs + 1), bool), known != 0), known)

    @property
    def is_constant(self) -> bool:
        return not self.depends[..., :-1].any()


def flagged(depends: np.ndarray, nonzero: Any) -> np.ndarray:
    """Return `depends` with another flag "may be other than zero", `nonzero`."""
    depends = depends.copy()
    depends[..., -1] = nonzero
    return depends


def may_be_nonzero(depends: np.ndarray) -> np.ndarray:
    """Return the flag, shape `(*S, 1)`."""
    return depends[..., -1:]


# Larger constants are not folded: their zeros are not worth the time.
_MOST_FOLDED = 1_000_000


def known_value(equation: Any, values: list[Dependence]) -> list[np.ndarray] | None:
    """Return the results of an equation of constants, `None` if they cannot be computed."""
    size = sum(math.prod(out.aval.shape) for out in equation.outvars)
    if size > _MOST_FOLDED or any(value.known is None for value in values):
        return None
    try:
        return evaluated(equation.primitive, equation.params, [value.known for value in values])
    except Exception:  # a constant that cannot be evaluated is not known, no more
        return None


def union(values: list[Dependence]) -> np.ndarray:
    """Return all inputs on which any of the numbers depends, with the flag, shape `(inputs + 1,)`."""
    flat = [value.depends.reshape(-1, value.depends.shape[-1]).any(axis=0) for value in values]
    return functools.reduce(np.logical_or, flat)  # pyright: ignore[reportReturnType]


def _spread(depends: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(depends, (*shape, depends.shape[-1]))


def _vanishing(equation: Any, values: list[Dependence]) -> list[Dependence]:
    """Elementwise functions whose value at zeros is zero."""
    shape = equation.outvars[0].aval.shape
    return [
        Dependence(functools.reduce(np.logical_or, [_spread(x.depends, shape) for x in values]))
    ]


def _elementwise(equation: Any, values: list[Dependence]) -> list[Dependence]:
    return [Dependence(flagged(_vanishing(equation, values)[0].depends, True))]


def _multiply(equation: Any, values: list[Dependence]) -> list[Dependence]:
    """A product with a zero is zero, and depends on nothing."""
    a, b = (_spread(value.depends, equation.outvars[0].aval.shape) for value in values)
    return [Dependence((a | b) & may_be_nonzero(a) & may_be_nonzero(b))]


def _divide(equation: Any, values: list[Dependence]) -> list[Dependence]:
    a, b = (_spread(value.depends, equation.outvars[0].aval.shape) for value in values)
    return [Dependence((a | b) & may_be_nonzero(a))]


def _power(equation: Any, values: list[Dependence]) -> list[Dependence]:
    keeps_zero = equation.params["y"] > 0
    return _vanishing(equation, values) if keeps_zero else _elementwise(equation, values)


def _select(equation: Any, values: list[Dependence]) -> list[Dependence]:
    shape = equation.outvars[0].aval.shape
    which, *cases = values
    alternatives = [_spread(case.depends, shape) for case in cases]
    if which.known is not None:
        chosen = np.broadcast_to(which.known, shape).astype(int)[..., None]
        return [Dependence(np.choose(chosen, alternatives))]
    chosen_by = _spread(flagged(which.depends, False), shape)
    return [Dependence(functools.reduce(np.logical_or, alternatives) | chosen_by)]


def _moved(equation: Any, values: list[Dependence]) -> list[Dependence] | None:
    found = sources(equation, lambda i: values[i].known)
    if found is None:
        return None
    which, places = found
    rows = [values[i].depends.reshape(-1, values[i].depends.shape[-1]) for i in which]
    constant = flagged(np.zeros((1, rows[0].shape[1]), bool), True)
    table = np.concatenate([*rows, constant])
    return [Dependence(table[place]) for place in places]


def _reduced(equation: Any, values: list[Dependence]) -> list[Dependence]:
    axes = tuple(equation.params["axes"])
    return [Dependence(value.depends.any(axis=axes)) for value in values]  # pyright: ignore[reportArgumentType]


def _cumulated(equation: Any, values: list[Dependence]) -> list[Dependence]:
    axis, depends = equation.params["axis"], values[0].depends
    turn = (lambda x: np.flip(x, axis)) if equation.params.get("reverse") else (lambda x: x)
    return [Dependence(turn(np.logical_or.accumulate(turn(depends), axis=axis)))]


def _contracted(equation: Any, values: list[Dependence]) -> list[Dependence]:
    """A sum of products, of which those with a zero do not count."""
    arrays = [value.depends.astype(np.float32) for value in values]
    a, b = arranged_factors(equation, arrays)
    depends = np.einsum("bisn,bjs->bijn", a, b[..., -1]) + np.einsum(
        "bis,bjsn->bijn", a[..., -1], b
    )
    return [Dependence((depends > 0).reshape(*equation.outvars[0].aval.shape, -1))]


def _landing(equation: Any, operand: tuple, indices: np.ndarray, update: tuple) -> np.ndarray:
    """Return where each number of the update of a scatter goes: its index in the flat operand, -1 if
    it is dropped. `operand` and `update` are shapes."""
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
        places = jnp.asarray(1.0 + np.arange(math.prod(operand)).reshape(operand))
        (found,) = jax.linear_transpose(scattered, jnp.zeros(update, places.dtype))(places)
    return np.asarray(np.rint(np.asarray(found)) - 1, int).reshape(update)


def _scattered(equation: Any, values: list[Dependence]) -> list[Dependence] | None:
    operand, indices, update = values
    if indices.known is None:
        return None
    shape, number = operand.depends.shape[:-1], operand.depends.shape[-1]
    places = _landing(equation, shape, indices.known, update.depends.shape[:-1]).ravel()
    lands = places >= 0
    result = operand.depends.reshape(-1, number).copy()
    if equation.primitive.name == "scatter":  # replaces the numbers there
        result[places[lands]] = False
    np.logical_or.at(result, places[lands], update.depends.reshape(-1, number)[lands])
    return [Dependence(result.reshape(*shape, number))]


_REDUCTIONS = "reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum reduce_xor"
_CUMULATIONS = "cumlogsumexp cummax cummin cumprod cumsum"
_SCATTERS = """
    scatter scatter-add scatter-max scatter-min scatter-mul scatter-sub scatter_add scatter_max
    scatter_min scatter_mul scatter_sub
"""

RULES: dict[str, Callable[[Any, list[Dependence]], list[Dependence] | None]] = {
    **dict.fromkeys(VANISHING, _vanishing),
    **dict.fromkeys(ELEMENTWISE, _elementwise),
    **dict.fromkeys(MOVES, _moved),
    **dict.fromkeys(_REDUCTIONS.split(), _reduced),
    **dict.fromkeys(_CUMULATIONS.split(), _cumulated),
    **dict.fromkeys(_SCATTERS.split(), _scattered),
    "div": _divide,
    "dot_general": _contracted,
    "integer_pow": _power,
    "mul": _multiply,
    "select_n": _select,
}
