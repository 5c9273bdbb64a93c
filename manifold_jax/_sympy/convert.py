"""`from_sympy`."""

from collections.abc import Callable, Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx

from .._base.extras import require
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.constraint import NoConstraint
from .._mechanics import MechanicalSystem
from .constraint import SymbolicConstraint
from .equations import Equations, Symbols
from .field import SymbolicField
from .function import SymbolicFunction
from .system import Model, SymbolicSystem


def from_sympy(method: Any, *, inputs: Mapping[Any, Any] | None = None) -> SymbolicSystem:
    r"""The vector field and the manifold of a model of `sympy.physics.mechanics`
    (`pip install "manifold_jax[sympy]"`).

    ```python
    kane.kanes_equations(bodies, loads)
    model = mj.from_sympy(kane)
    args = model.args({m: 1.0, g: 9.81})
    y0 = model.state({q1: 0.3, u3: -5.0}, args)
    hook = mj.Projected(dfx.Tsit5(), model.constraint)
    sol = mj.diffeqsolve(model.terms, hook, 0.0, 1.0, None, y0, args, ...)
    ```

    The state is `(q, u)`, arrays in the order of `method.q` and `method.u`. `args` is a dictionary with a number
    for the name of every symbol, or an object with these attributes; all of them can be differentiated by.

    Equations are taken as they are, without simplification: subexpressions that occur more than once are evaluated
    once, and linear systems are solved numerically in each evaluation. The manifold are the configuration and velocity
    constraints of Kane's method, or the constraints of Lagrange's method with their derivatives. Corrections of a
    `KanesMethod` move to the nearest state, each number with the weight 1 unless `projection=` gives others; those of a
    `LagrangesMethod` are orthogonal in the metric of its masses, as of a [`MechanicalSystem`][].

    **Arguments:**

    - `method`: a `KanesMethod` or a `LagrangesMethod`, whose equations have been formed. Velocity constraints of Kane's method
        must include the derivatives of its configuration constraints, as SymPy asks for.
    - `inputs`: `{x: f}` for functions of time that are neither coordinates nor speeds, such as forces of motors: `f(t, y, args)`
        returns the number. Where derivatives of them occur (a base that moves), `{x: f, x.diff(): g}`.

    **Returns:**

    A [`SymbolicSystem`][].

    **Raises:**

    `ValueError` or `TypeError` for other objects, equations that have not been formed, functions of time without an input, and
    `ImportError` without SymPy.

    With bodies and joints to choose from, [`multibody`][manifold_jax.multibody.Assembly] needs no derivation in symbols, and
    its cost does not grow with the size of expressions.
    """
    require("sympy", "sympy", "`mj.from_sympy`")
    equations = Equations.of(method)
    symbols = Symbols.of(equations.parts(), equations.states)
    given = _checked_inputs(inputs, symbols.inputs)
    function = lambda *parts: SymbolicFunction.of(parts, equations.q, equations.u, given)
    mechanics = _mechanical_system(equations, function)
    if mechanics is None:
        terms, constraint = (
            dfx.ODETerm(_field(equations, function)),
            _constraint(equations, function),
        )
    else:
        terms, constraint = mechanics.terms, mechanics.constraint
    model = Model(equations.q, equations.u, symbols.parameters, tuple(given), equations.dependent)
    return SymbolicSystem(terms, constraint, mechanics, tuple(given.values()), model)


def _field(equations: Equations, function: Callable) -> SymbolicField:
    import sympy

    explicit = equations.kinematic == sympy.eye(len(equations.q))
    parts = equations.kinematic, equations.kinematic_forcing, equations.mass, equations.forcing
    return SymbolicField(function(*parts[explicit:]), explicit)


def _constraint(equations: Equations, function: Callable) -> SymbolicConstraint | NoConstraint:
    if not equations.velocities:
        return NoConstraint()
    positions = function(equations.positions) if equations.positions else None
    return SymbolicConstraint(positions, function(equations.velocities))


class _OfPositions(eqx.Module):
    """A function of `(t, q, args)`, or of `(q, args)`, from one that takes `(t, (q, u), args)`."""

    function: SymbolicFunction

    def __call__(self, *inputs: Any) -> Any:
        *time, q, args = inputs
        return self.function(time[0] if time else 0.0, (q, q), args)[0]


class _OfStates(eqx.Module):
    """A function of `(t, q, v, args)`."""

    function: SymbolicFunction

    def __call__(self, t: RealScalarLike, q: Y, v: Y, args: Args) -> Any:
        return self.function(t, (q, v), args)[0]


def _mechanical_system(equations: Equations, function: Callable) -> MechanicalSystem | None:
    """Return the equations of Lagrange's method with multipliers as a mechanical system."""
    n, h = len(equations.q), len(equations.positions)
    mass, positions = equations.mass[:n, :n], equations.positions
    if not equations.num_multipliers:
        return None
    of_mass, of_positions = (Symbols.of((part,), equations.q) for part in (mass, positions))
    # Derivatives of inputs are given separately.
    if of_mass.has_time or of_mass.inputs or of_positions.inputs:
        return None
    further = equations.velocities[h:]
    return MechanicalSystem(
        _OfPositions(function(mass)),
        _OfPositions(function(positions)) if h else None,
        _OfStates(function(equations.forcing[:n])),
        velocity_constraint=_OfStates(function(further)) if further else None,
    )


def _checked_inputs(inputs: Mapping[Any, Any] | None, needed: tuple[Any, ...]) -> dict:
    inputs = {} if inputs is None else dict(inputs)
    missing = [str(symbol) for symbol in needed if symbol not in inputs]
    if missing:
        raise ValueError(
            f"The equations contain {', '.join(missing)}, which is neither a coordinate nor a speed of `method`. Give its value "
            "by `inputs={x: lambda t, y, args: ...}`, also of derivatives, or write a symbol that does not depend on time."
        )
    unused = [str(symbol) for symbol in inputs if symbol not in needed]
    if unused:
        raise ValueError(f"`inputs` has {', '.join(unused)}, which the equations do not contain.")
    for symbol, f in inputs.items():
        check_function(f"inputs[{symbol}]", f, "x(t, y, args)")
    return inputs
