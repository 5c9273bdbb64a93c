"""Sparsity pattern of the Jacobian of a traced function, without computing derivatives.

The traced function is evaluated once with sets of inputs in the place of numbers. No dependence is
missed: all results of a primitive without a rule depend on all of its operands. Piecewise constant
functions such as comparisons and `sign` count as dependent, although their derivative is zero.
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import numpy as np

from .._base.compat import scan_counts
from .incidence_rules import Dependence, flagged, known_value, RULES, union
from .trace import called, unrolled_scan, walk


# Largest number of iterations of a scan that are evaluated one by one, so that counters are known.
_MOST_ITERATIONS = 1000


class Incidence(NamedTuple):
    """The dependence of the results of a function on its inputs."""

    depends: np.ndarray  # [i, j]: the number `i` that is returned depends on the input `j`
    unknown_primitives: dict[str, int]  # without a rule, with how often they were met


def incidence(function: Callable, *tracked: tuple[Any, np.ndarray]) -> Incidence:
    """Return the incidence of `function(*arguments)`, which returns one vector. `tracked` are pairs of
    an argument, a pytree of arrays, and of the inputs as which its numbers count: a bool array of
    shape `(numbers, inputs)`."""
    arguments = [argument for argument, _ in tracked]
    closed = jax.make_jaxpr(function)(*arguments)
    inputs = np.concatenate([inputs for _, inputs in tracked])
    values, number, start = [], inputs.shape[1], 0
    # With the flag of [`Dependence`][]: all of them may be other than zero.
    inputs = np.append(inputs, np.ones((len(inputs), 1), bool), axis=1)
    for leaf in jax.tree_util.tree_leaves(arguments):
        end = start + np.size(leaf)
        values.append(Dependence(inputs[start:end].reshape(*np.shape(leaf), number + 1)))
        start = end
    search = Search(number, Counter())
    (out,) = search.through(closed, values)
    return Incidence(out.depends[..., :-1], {k: v for k, v in search.unknown.items() if v})


class Search(NamedTuple):
    """Evaluates a traced function with a [`Dependence`][] for every array."""

    number: int  # of inputs
    unknown: Counter

    def through(self, function: Any, inputs: Sequence[Dependence]) -> list[Dependence]:
        return walk(function, inputs, self._known, self._equation)

    def _known(self, constant: Any) -> Dependence:
        try:
            if not isinstance(constant, jax.core.Tracer):
                return Dependence.constant(np.asarray(constant), self.number)
        except (TypeError, ValueError):  # e.g. random keys
            pass
        return Dependence(flagged(np.zeros((*np.shape(constant), self.number + 1), bool), True))

    def _equation(self, equation: Any, values: list[Dependence]) -> list[Dependence]:
        name = equation.primitive.name
        inner = called(equation) if name not in _CONTROL else None
        if inner is not None and not name.startswith("custom_vjp"):
            return self.through(inner, values)
        constant = all(value.is_constant for value in values)
        if constant and (known := known_value(equation, values)) is not None:
            return [Dependence.constant(value, self.number) for value in known]
        if name.startswith("custom_vjp") and not constant:
            raise TypeError(
                "The equations use a function with `jax.custom_vjp`, which cannot be differentiated forwards, as "
                "derivatives with respect to time are. Write its rule with `jax.custom_jvp`."
            )
        if name in _CONTROL:
            return _CONTROL[name](self, equation, values)
        return (RULES[name](equation, values) if name in RULES else None) or self._any(
            equation, values
        )

    def _any(self, equation: Any, values: list[Dependence]) -> list[Dependence]:
        """Let all that is returned depend on all that is given."""
        everything = union(values) if values else np.zeros(self.number + 1, bool)
        everything = flagged(everything, True)
        self.unknown[equation.primitive.name] += int(everything[:-1].any())
        shapes = [(*out.aval.shape, self.number + 1) for out in equation.outvars]
        return [Dependence(np.broadcast_to(everything, shape)) for shape in shapes]


def _either(*alternatives: list[Dependence]) -> list[Dependence]:
    return [
        Dependence(functools.reduce(np.logical_or, [value.depends for value in values]))
        for values in zip(*alternatives, strict=True)
    ]


def _also(values: list[Dependence], condition: np.ndarray) -> list[Dependence]:
    return [Dependence(value.depends | condition) for value in values]


def _cond(search: Search, equation: Any, values: list[Dependence]) -> list[Dependence]:
    index, *operands = values
    branches = equation.params["branches"]
    if index.known is not None:
        return search.through(branches[int(np.clip(index.known, 0, len(branches) - 1))], operands)
    return _also(_either(*(search.through(b, operands) for b in branches)), union([index]))


def _while(search: Search, equation: Any, values: list[Dependence]) -> list[Dependence]:
    n, m = equation.params["cond_nconsts"], equation.params["body_nconsts"]
    of_condition, of_body = values[:n], values[n : n + m]
    carry = [
        Dependence(value.depends) for value in values[n + m :]
    ]  # without the values before the loop

    def once(carry: list[Dependence]) -> list[Dependence]:
        (condition,) = search.through(equation.params["cond_jaxpr"], of_condition + carry)
        after = search.through(equation.params["body_jaxpr"], of_body + carry)
        return _also(_either(carry, after), union([condition]))

    return _until_unchanged(once, carry)


def _until_unchanged(once: Callable, carry: list[Dependence]) -> list[Dependence]:
    while True:
        after = once(carry)
        if all((a.depends == b.depends).all() for a, b in zip(after, carry, strict=True)):
            return carry
        carry = after


def _scan(search: Search, equation: Any, values: list[Dependence]) -> list[Dependence]:
    if not 0 < equation.params["length"] <= _MOST_ITERATIONS:
        return _long_scan(search, equation, values)
    item = lambda x, i: Dependence(x.depends[i], None if x.known is None else x.known[i])
    stack = lambda rows, aval: Dependence(np.stack([row.depends for row in rows]))
    return unrolled_scan(equation, values, search.through, item, stack)


def _long_scan(search: Search, equation: Any, values: list[Dependence]) -> list[Dependence]:
    """Treat all iterations alike."""
    n, m = scan_counts(equation)
    items = [Dependence(x.depends.any(axis=0)) for x in values[n + m :]]  # pyright: ignore[reportArgumentType]
    through = lambda carry: search.through(equation.params["jaxpr"], values[:n] + carry + items)
    carry = [Dependence(value.depends) for value in values[n : n + m]]
    carry = _until_unchanged(lambda c: _either(c, through(c)[:m]), carry)
    outputs = [
        Dependence(np.broadcast_to(value.depends, (*out.aval.shape, search.number + 1)))
        for value, out in zip(through(carry)[m:], equation.outvars[m:], strict=True)
    ]
    return carry + outputs


_CONTROL = {"cond": _cond, "scan": _scan, "while": _while}
