"""Python's numbers among the arguments of compiled functions."""

import functools
import inspect
from collections.abc import Callable, Hashable
from typing import Any, cast, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu


Function = TypeVar("Function", bound=Callable)
Number = TypeVar("Number")


def numbers_as_arrays(*names: str, times: tuple[str, ...] = ()) -> Callable[[Function], Function]:
    """Wrap a function made by `equinox.filter_jit`, which compiles anew for every other value of a
    Python number: those in the arguments with these names become arrays, weakly typed like Python's
    numbers. Integers, which may be shapes or exponents, stay as they are, except in `times`."""

    def decorate(function: Function) -> Function:
        parameters = list(inspect.signature(function).parameters)

        def converted(name: str, value: Any) -> Any:
            if name in times:
                return _time_as_array(value)
            return with_arrays(_checked(name, value)) if name in names else value

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            args = (*map(converted, parameters, args), *args[len(parameters) :])
            return function(*args, **{name: converted(name, x) for name, x in kwargs.items()})

        return cast(Function, call)

    return decorate


def _checked(name: str, tree: Any) -> Any:
    """Refuse objects that JAX can neither flatten nor compare with those of another call."""
    for leaf in jtu.tree_leaves(tree):
        if eqx.is_array_like(leaf) or isinstance(leaf, Hashable):
            continue
        kind = type(leaf).__name__
        raise TypeError(
            f"`{name}` has a {kind}, into which JAX cannot look. Make {kind} an `equinox.Module` or a `typing.NamedTuple`, "
            f"or register it: `@jax.tree_util.register_dataclass` above `@dataclasses.dataclass`."
        )
    return tree


def by_precision(given: Number | None, dtype: Any, double: float, single: float) -> Number | float:
    """Return a tolerance, or if none is given the default for numbers of this type."""
    return (double if dtype == jnp.float64 else single) if given is None else given


def with_arrays(tree: Any) -> Any:
    """Return `tree` with an array in place of every real or complex number of Python."""
    is_number = lambda x: type(x) in (float, complex)
    return jtu.tree_map(lambda x: _as_array(x) if is_number(x) else x, tree)


def _time_as_array(t: Any) -> Any:
    return _as_array(float(t)) if type(t) in (int, float) else t


def _as_array(number: float | complex) -> Any:
    """Keep the number under `jax.jit`: it is part of that program, and constants make a better one."""
    array = jnp.asarray(number)
    return number if isinstance(array, jax.core.Tracer) else array
