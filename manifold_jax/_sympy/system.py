"""A model of SymPy as a vector field on a manifold."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint, NoConstraint
from .._constraint.diagnosis import Diagnosis
from .._constraint.settings import NewtonProjection
from .._mechanics import MechanicalSystem
from .equations import name_of, Symbols
from .function import SymbolicFunction


class Model(NamedTuple):
    """The symbols of a model; `dependent` are the coordinates and speeds that Kane's method calls so."""

    q: tuple[Any, ...]
    u: tuple[Any, ...]
    parameters: tuple[Any, ...]
    inputs: tuple[Any, ...]
    dependent: tuple[Any, ...]


class SymbolicSystem(eqx.Module):
    """The equations of motion of a SymPy model, made by [`from_sympy`][].

    - `terms`, `constraint`: the vector field on the state `(q, u)`, and its manifold.
    - `mechanics`: the same as a [`MechanicalSystem`][], which has multipliers, impacts and symplectic steps; `None`
        if it is not one. It is one for a `LagrangesMethod` with constraints whose masses depend on coordinates and
        parameters alone, and whose constraints have no inputs.
    """

    terms: dfx.AbstractTerm
    constraint: AbstractConstraint
    mechanics: MechanicalSystem | None
    inputs: tuple[Callable, ...]
    model: Model = eqx.field(static=True)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The names of the numbers in `q`."""
        return tuple(map(name_of, self.model.q))

    @property
    def speeds(self) -> tuple[str, ...]:
        """The names of the numbers in `u`; of Lagrange's method `"x'"`."""
        return tuple(map(name_of, self.model.u))

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names that `args` must have."""
        return tuple(map(str, self.model.parameters))

    def args(self, values: Mapping[Any, Any]) -> dict[str, Any]:
        """Return `args` from a dictionary by symbol: `{m: 1.0}` becomes `{"m": 1.0}`.

        Names as keys are allowed, too, also those of additional numbers that only inputs need.

        **Raises:**

        `ValueError` for symbols without a value, and for symbols that the equations do not contain.
        """
        unknown = [
            str(key)
            for key in values
            if not isinstance(key, str) and str(key) not in self.parameters
        ]
        if unknown:
            raise ValueError(
                f"The equations do not contain {', '.join(unknown)}. Their symbols are {', '.join(self.parameters)}; numbers "
                "for inputs alone have strings as keys."
            )
        named = {str(key): value for key, value in values.items()}
        missing = [name for name in self.parameters if name not in named]
        if missing:
            raise ValueError(f"`values` has no number for {', '.join(missing)}.")
        return named

    def state(
        self, values: Mapping[Any, Any], args: Args = None, *, t: RealScalarLike = 0.0
    ) -> tuple[jax.Array, jax.Array]:
        """Return a consistent state `(q, u)`.

        **Arguments:**

        - `values`: numbers for coordinates and speeds, by symbol or by name; zero where there is none.
        - `args`, `t`: passed to the constraints.

        Kane's method: the independent coordinates and speeds keep their values, the dependent ones
        are solved for, from `values` as a guess. Lagrange's method: the nearest consistent state, as
        by [`consistent_state`][]. Works under `jit`, `vmap` and derivatives.

        **Raises:**

        `ValueError` for names that are neither; a `RuntimeError` if no state is found near the guess.
        """
        numbers = self._in_order(values)
        return _consistent(self.constraint, self._only_dependent(), t, numbers, args)

    def function(self, expression: Any) -> Callable[[RealScalarLike, Y, Args], jax.Array]:
        """Return a further expression of the model, such as its energy or the position of a point, as a
        function `f(t, y, args)`: for [`Invariants`][], events, inputs, or pictures.

        **Arguments:**

        - `expression`: an expression, or a matrix, of coordinates, speeds, parameters and inputs. A column
            becomes an array of shape `(n,)`.

        **Raises:**

        `ValueError` for other functions of time, such as derivatives of the coordinates in Kane's method: replace
        those by `method.kindiffdict()`.
        """
        is_column = getattr(expression, "shape", ())[1:] == (1,)
        part = tuple(expression) if is_column else expression
        inputs = dict(zip(self.model.inputs, self.inputs, strict=True))
        found = Symbols.of((part,), self.model.q + self.model.u).inputs
        if unknown := [str(symbol) for symbol in found if symbol not in inputs]:
            raise ValueError(
                f"`expression` contains {', '.join(unknown)}, which is neither a coordinate, a speed nor an input. Replace "
                "derivatives of coordinates by `method.kindiffdict()` of a `KanesMethod`."
            )
        inner = SymbolicFunction.of((part,), self.model.q, self.model.u, inputs)
        return lambda t, y, args: inner(t, y, args)[0]

    def _only_dependent(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the metric in which corrections move the dependent numbers alone: infinite weights of others."""
        if not self.model.dependent:
            return None
        weight = lambda symbols: np.array(
            [1.0 if x in self.model.dependent else np.inf for x in symbols]
        )
        return weight(self.model.q), weight(self.model.u)

    def _in_order(self, values: Mapping[Any, Any]) -> tuple[list[Any], list[Any]]:
        """Return the numbers of the state in the order of its symbols."""
        names = self.coordinates + self.speeds
        named = {key if isinstance(key, str) else _name(key): x for key, x in values.items()}
        unknown = [str(name) for name in named if name not in names]
        if unknown:
            raise ValueError(
                f"`values` has {', '.join(unknown)}, which is neither a coordinate nor a speed. The coordinates are "
                f"{', '.join(self.coordinates)}, the speeds {', '.join(self.speeds)}."
            )
        given = lambda names: [named.get(name, 0.0) for name in names]
        return given(self.coordinates), given(self.speeds)


@clear_errors
@numbers_as_arrays("numbers", "args", times=("t",))
@eqx.filter_jit
def _consistent(
    constraint: AbstractConstraint,
    metric: Y | None,
    t: RealScalarLike,
    numbers: tuple[list[Any], list[Any]],
    args: Args,
) -> Any:
    q, u = y = tuple(jnp.stack([jnp.asarray(x, float) for x in part]) for part in numbers)
    if isinstance(constraint, NoConstraint):
        return q, u
    projection = NewtonProjection(metric=metric, max_steps=50)
    consistent, info = constraint.correct(projection, t, y, args, far=True)
    diagnosis = Diagnosis.of_start(constraint, t, y, args, info)
    return diagnosis.raise_unless(info.success, consistent, "y")


def _name(key: Any) -> str:
    try:
        return name_of(key)
    except AttributeError:
        return str(key)
