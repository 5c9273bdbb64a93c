"""Which numbers that a function returns depend on which of the numbers it is given.

The traced function is walked through once with sets of inputs in the place of numbers. What depends
on a number is never missed: a primitive without a rule makes all it returns depend on all it gets.
Also what is piecewise constant counts, as comparisons and `sign`: their value matters even where
their derivative is zero.
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import numpy as np
from jax.extend import core

from .._base.compat import scan_counts
from .incidence_rules import known_value, RULES, union, Value


# Iterations of a scan that are walked through one by one, so that counters are known.
_MOST_ITERATIONS = 1000


class Incidence(NamedTuple):
    """`depends[i, j]`: the number `i` that is returned depends on the input `j`. And the primitives
    without a rule of their own, with how often they were met."""

    depends: np.ndarray
    unknown_primitives: dict[str, int]


def incidence(function: Callable, *tracked: tuple[Any, np.ndarray]) -> Incidence:
    """Return the incidence of `function(*arguments)`, which returns one vector. For each argument,
    a pytree of arrays,
    the inputs as which its numbers count: a bool array of shape `(numbers, inputs)`."""
    arguments = [argument for argument, _ in tracked]
    closed = jax.make_jaxpr(function)(*arguments)
    values, number = [], tracked[0][1].shape[1]
    for argument, inputs in tracked:
        start = 0
        for leaf in jax.tree_util.tree_leaves(argument):
            size, shape = int(np.size(leaf)), np.shape(leaf)
            depends = inputs[start : start + size].reshape(*shape, number)
            values.append(Value(np.concatenate([depends, np.ones((*shape, 1), bool)], axis=-1)))
            start += size
    walk = Walk(number, Counter())
    (out,) = walk.through(closed, values)
    return Incidence(out.depends[..., :-1], {k: v for k, v in walk.unknown.items() if v})


class Walk(NamedTuple):
    """Through a traced function, in the order of execution."""

    number: int  # of inputs
    unknown: Counter

    def through(self, closed: Any, inputs: Sequence[Value]) -> list[Value]:
        jaxpr, constants = (
            (closed.jaxpr, closed.consts) if hasattr(closed, "consts") else (closed, ())
        )
        environment: dict[Any, Value] = {}

        def read(variable: Any) -> Value:
            if isinstance(variable, core.Literal):
                return self._known(variable.val)
            return environment[variable]

        for variable, constant in zip(jaxpr.constvars, constants, strict=True):
            environment[variable] = self._known(constant)
        environment.update(zip(jaxpr.invars, inputs, strict=True))
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(v) for v in equation.invars])
            environment.update(zip(equation.outvars, results, strict=True))
        return [read(variable) for variable in jaxpr.outvars]

    def _known(self, constant: Any) -> Value:
        try:
            if not isinstance(constant, jax.core.Tracer):
                return Value.constant(np.asarray(constant), self.number)
        except (TypeError, ValueError):  # random keys, for instance
            pass
        depends = np.zeros((*np.shape(constant), self.number + 1), bool)
        depends[..., -1] = True
        return Value(depends)

    def _equation(self, equation: Any, values: list[Value]) -> list[Value]:
        name = equation.primitive.name
        inner = _called(equation) if name not in _CONTROL else None
        if inner is not None and not name.startswith("custom_vjp"):
            return self.through(inner, values)
        constant = all(value.is_constant for value in values)
        if constant and (known := known_value(equation, values)) is not None:
            return [Value.constant(value, self.number) for value in known]
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

    def _any(self, equation: Any, values: list[Value]) -> list[Value]:
        """All that is returned depends on all that is given."""
        everything = np.append(union(values)[:-1] if values else np.zeros(self.number, bool), True)
        self.unknown[equation.primitive.name] += int(everything[:-1].any())
        shapes = [(*out.aval.shape, self.number + 1) for out in equation.outvars]
        return [Value(np.broadcast_to(everything, shape)) for shape in shapes]


def _called(equation: Any) -> Any:
    """The function that an equation applies to exactly its operands, if that is what it does."""
    shapes = lambda variables: [variable.aval.shape for variable in variables]
    inner = [p for p in equation.params.values() if isinstance(p, core.Jaxpr | core.ClosedJaxpr)]
    if len(inner) != 1:
        return None
    jaxpr = getattr(inner[0], "jaxpr", inner[0])
    same = shapes(jaxpr.invars) == shapes(equation.invars)
    return inner[0] if same and shapes(jaxpr.outvars) == shapes(equation.outvars) else None


def _either(*alternatives: list[Value]) -> list[Value]:
    return [
        Value(functools.reduce(np.logical_or, [value.depends for value in values]))
        for values in zip(*alternatives, strict=True)
    ]


def _also(values: list[Value], condition: np.ndarray) -> list[Value]:
    return [Value(value.depends | condition) for value in values]


def _forgotten(values: list[Value]) -> list[Value]:
    return [Value(value.depends) for value in values]


def _cond(walk: Walk, equation: Any, values: list[Value]) -> list[Value]:
    index, *operands = values
    branches = equation.params["branches"]
    if index.known is not None:
        return walk.through(branches[int(np.clip(index.known, 0, len(branches) - 1))], operands)
    return _also(_either(*(walk.through(b, operands) for b in branches)), union([index]))


def _while(walk: Walk, equation: Any, values: list[Value]) -> list[Value]:
    n, m = equation.params["cond_nconsts"], equation.params["body_nconsts"]
    of_condition, of_body, carry = values[:n], values[n : n + m], _forgotten(values[n + m :])

    def once(carry: list[Value]) -> list[Value]:
        (condition,) = walk.through(equation.params["cond_jaxpr"], of_condition + carry)
        after = walk.through(equation.params["body_jaxpr"], of_body + carry)
        return _also(_either(carry, after), union([condition]))

    return _until_unchanged(once, carry)


def _until_unchanged(once: Callable, carry: list[Value]) -> list[Value]:
    while True:
        after = once(carry)
        if all((a.depends == b.depends).all() for a, b in zip(after, carry, strict=True)):
            return carry
        carry = after


def _scan(walk: Walk, equation: Any, values: list[Value]) -> list[Value]:
    parameters = equation.params
    (n, m), length = scan_counts(equation), parameters["length"]
    constants, carry, xs = values[:n], values[n : n + m], values[n + m :]
    if not 0 < length <= _MOST_ITERATIONS:
        return _long_scan(walk, equation, constants, carry, xs)
    order = range(length)[::-1] if parameters["reverse"] else range(length)
    outputs: list[list[Value]] = [[]] * length
    for i in order:
        items = [Value(x.depends[i], None if x.known is None else x.known[i]) for x in xs]
        after = walk.through(parameters["jaxpr"], [*constants, *carry, *items])
        carry, outputs[i] = after[:m], after[m:]
    stacked = [
        Value(np.stack([value.depends for value in column]))
        for column in zip(*outputs, strict=True)
    ]
    return carry + stacked


def _long_scan(
    walk: Walk, equation: Any, constants: list[Value], carry: list[Value], xs: list[Value]
) -> list[Value]:
    """All iterations alike."""
    items = [Value(x.depends.any(axis=0)) for x in xs]  # pyright: ignore[reportArgumentType]
    through = lambda carry: walk.through(equation.params["jaxpr"], constants + carry + items)
    m = len(carry)
    carry = _until_unchanged(lambda c: _either(c, through(c)[:m]), _forgotten(carry))
    outputs = [
        Value(np.broadcast_to(value.depends, (*out.aval.shape, walk.number + 1)))
        for value, out in zip(through(carry)[m:], equation.outvars[m:], strict=True)
    ]
    return carry + outputs


_CONTROL = {"cond": _cond, "scan": _scan, "while": _while}
