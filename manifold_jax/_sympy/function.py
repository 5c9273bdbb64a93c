"""Expressions of SymPy as functions of JAX."""

import builtins
import dis
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.special as jsp

from .._base.errors import listed
from .._base.shapes import shapes
from .._base.types import Args, RealScalarLike, Y
from .equations import entries_of, name_of, Symbols


# By the names of SymPy, which would take those of `math` for some. Derivatives contain `polygamma`.
_SPECIAL = {
    "Ei": jsp.expi,
    "erf": jsp.erf,
    "erfc": jsp.erfc,
    "erfinv": jsp.erfinv,
    "factorial": lambda x: jsp.gamma(x + 1),  # that of JAX is zero for negative numbers
    "gamma": jsp.gamma,
    "loggamma": jsp.gammaln,
    "polygamma": jsp.polygamma,
}


class SymbolicFunction(eqx.Module):
    """Expressions, tuples and matrices of them as a function `f(t, (q, u), args)`, which returns a tuple of
    arrays.

    Subexpressions that occur more than once are evaluated once. `inputs` are those that occur.
    """

    evaluate: Callable = eqx.field(static=True)  # of time, states, parameters and inputs: numbers
    sizes: tuple[int, int] = eqx.field(static=True)  # of q and u
    parameters: tuple[str, ...] = eqx.field(static=True)
    result_shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[Callable, ...]

    @staticmethod
    def of(
        parts: tuple[Any, ...],
        q: tuple[Any, ...],
        u: tuple[Any, ...],
        inputs: Mapping[Any, Callable],
    ) -> "SymbolicFunction":
        """Build the function; `inputs` may contain more than those that occur."""
        symbols = Symbols.of(parts, q + u)
        evaluate = _lambdified(parts, symbols, q + u)
        return SymbolicFunction(
            evaluate,
            (len(q), len(u)),
            tuple(map(str, symbols.parameters)),
            tuple(_shape(part) for part in parts),
            tuple(map(name_of, symbols.inputs)),
            tuple(inputs[symbol] for symbol in symbols.inputs),
        )

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> tuple[jax.Array, ...]:
        q, u = self._checked(y)
        dtype = jnp.result_type(q, u)
        number = lambda x: jnp.asarray(x, dtype)
        parameters = [number(x) for x in values_of(self.parameters, args)]
        inputs = [
            number(_scalar(f"`inputs` of {name}", function(t, y, args)))
            for name, function in zip(self.input_names, self.inputs, strict=True)
        ]
        flat = self.evaluate(number(t), [*q, *u], parameters, inputs)
        numbers, results = iter(flat), []
        for shape in self.result_shapes:
            entries = [number(next(numbers)) for _ in range(math.prod(shape))]
            array = jnp.stack(entries) if entries else jnp.zeros(0, dtype)
            results.append(array.reshape(shape))
        return tuple(results)

    def _checked(self, y: Any) -> tuple[jax.Array, jax.Array]:
        expected = tuple((size,) for size in self.sizes)
        if not (isinstance(y, tuple) and shapes(y) == expected):
            raise ValueError(
                f"`y` must be the pair `(q, u)` of coordinates and speeds, of the shapes {expected}, got {shapes(y)}. Take "
                "`y0` from the method `state` of the system."
            )
        q, u = (jnp.asarray(part) for part in y)
        return q, u


def values_of(names: tuple[str, ...], args: Args) -> list[Any]:
    """Return the values of the parameters in `args`, a mapping or an object with attributes."""
    if isinstance(args, Mapping):
        found = {name: args[name] for name in names if name in args}
    else:
        found = {name: getattr(args, name) for name in names if hasattr(args, name)}
    missing = [name for name in names if name not in found]
    if missing:
        raise ValueError(
            f"`args` has no value for {', '.join(missing)}. It must be a dictionary with a number for the name of every symbol, "
            f"here {', '.join(names)}, or an object with these attributes."
        )
    return [_scalar(f"`args` for {name}", found[name]) for name in names]


def _scalar(what: str, value: Any) -> Any:
    if not eqx.is_array_like(value) or jnp.shape(value) != ():
        raise ValueError(
            f"{what} must be one number, got {shapes(value)}. For many values use `jax.vmap` or `mj.solve_ensemble`."
        )
    return value


def _shape(part: Any) -> tuple[int, ...]:
    return (len(part),) if isinstance(part, tuple) else tuple(getattr(part, "shape", ()))


def _lambdified(parts: tuple[Any, ...], symbols: Symbols, states: tuple[Any, ...]) -> Callable:
    """Return the entries of all parts as one function of JAX.

    Symbols are renamed, as their names need not be identifiers. The order of subexpressions is
    that in which they are found: `cse` would take twice the time to sort them.
    """
    import sympy

    groups = (symbols.time,), states, symbols.parameters, symbols.inputs
    renamed = {symbol: sympy.Dummy() for group in groups for symbol in group}
    known = dict(renamed)
    entries = [_replaced(x, known) for part in parts for x in entries_of(part)]
    shared, entries = sympy.cse(entries, order="none", list=False)
    time, *rest = [[renamed[symbol] for symbol in group] for group in groups]
    done = lambda _: (shared, entries)
    modules = [_SPECIAL, "jax"]
    function = sympy.lambdify([*time, *rest], entries, modules=modules, cse=done)  # pyright: ignore[reportArgumentType]
    _check_names(function)
    return jax.jit(function)  # traced once: a solve calls it forty times


def _check_names(function: Any) -> None:
    """Refuse names that nothing defines: functions that SymPy cannot write in JAX it writes as they are."""
    used = {x.argval for x in dis.get_instructions(function) if x.opname == "LOAD_GLOBAL"}
    missing = sorted(used - function.__globals__.keys() - vars(builtins).keys())
    if missing:
        raise ValueError(
            f"The expressions contain {listed(missing)}, for which there is no function of JAX. Rewrite the expression, for instance "
            "by its method `doit` or `rewrite`, or write `f = dynamicsymbols('f')` instead and give "
            "`inputs={f: lambda t, y, args: ...}`, a function of JAX."
        )


def _replaced(expression: Any, known: dict[Any, Any]) -> Any:
    """Return `expression.xreplace(known)`, with each subexpression replaced once; `known` is extended."""
    if expression not in known:
        args = [_replaced(arg, known) for arg in expression.args]
        changed = any(new is not old for new, old in zip(args, expression.args, strict=True))
        known[expression] = expression.func(*args) if changed else expression
    return known[expression]
