"""The equations of motion of a method of `sympy.physics.mechanics`, and the symbols in them."""

from typing import Any, NamedTuple

from .compat import (
    constraints_of_kane,
    dependents_of_kane,
    holonomic_of_lagrange,
    time_symbol,
)


class Equations(NamedTuple):
    """`K(q, t) q' = k`, `M(q, t) (u', multipliers) = f`, and the constraints, in SymPy's expressions.

    - `q`, `u`: the coordinates and speeds, functions of time. `u` are `q'` in Lagrange's method.
    - `kinematic`, `kinematic_forcing`, `mass`, `forcing`: `K`, `k`, `M`, `f`.
    - `positions`, `velocities`: constraints on `q` and on `(q, u)`, zero on the manifold. The first
        ones of Lagrange's method include the derivatives of `positions`.
    - `dependent`: the coordinates and speeds that Kane's method calls dependent.
    - `num_multipliers`: those of Lagrange's method, the last unknowns of `M`.
    """

    q: tuple[Any, ...]
    u: tuple[Any, ...]
    kinematic: Any
    kinematic_forcing: tuple[Any, ...]
    mass: Any
    forcing: tuple[Any, ...]
    positions: tuple[Any, ...]
    velocities: tuple[Any, ...]
    dependent: tuple[Any, ...]
    num_multipliers: int

    @staticmethod
    def of(method: Any) -> "Equations":
        _check_method(method)
        mass, forcing = _full_matrices(method)
        if _is_kane(method):
            positions, velocities = constraints_of_kane(method)
            dependent = tuple(x for part in dependents_of_kane(method) for x in part)
            _check_constraints_of_kane(positions, velocities)
        else:
            positions, velocities = holonomic_of_lagrange(method), method.coneqs
            dependent = ()
        q, u = tuple(method.q), tuple(method.u)
        n = len(q)
        return Equations(
            q,
            u,
            kinematic=mass[:n, :n],
            kinematic_forcing=tuple(forcing[:n]),
            mass=mass[n:, n:],
            forcing=tuple(forcing[n:]),
            positions=tuple(positions),
            velocities=tuple(velocities),
            dependent=dependent,
            num_multipliers=mass.shape[0] - n - len(u),
        )

    @property
    def states(self) -> tuple[Any, ...]:
        return self.q + self.u

    def parts(self) -> tuple[Any, ...]:
        of_motion = self.kinematic, self.kinematic_forcing, self.mass, self.forcing
        return (*of_motion, self.positions, self.velocities)


class Symbols(NamedTuple):
    """What stands for numbers in expressions, apart from the coordinates and speeds: the symbol of time,
    the parameters in the order of their names, and functions of time, which are inputs."""

    time: Any
    parameters: tuple[Any, ...]
    inputs: tuple[Any, ...]
    has_time: bool  # apart from functions of time

    @staticmethod
    def of(parts: tuple[Any, ...], states: tuple[Any, ...]) -> "Symbols":
        t = time_symbol()
        symbols, functions = _leaves([entry for part in parts for entry in entries_of(part)])
        undefined = sorted(str(f) for f in functions if not _is_of_time(f, t))
        if undefined:
            raise ValueError(
                f"The equations contain {', '.join(undefined)}, a function without a definition. Functions of time alone can "
                "be `inputs`; write others out as expressions."
            )
        free, inputs = symbols - {t}, functions - set(states)
        parameters = tuple(sorted(free, key=str))
        names = [str(p) for p in parameters]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(
                f"The equations contain several symbols of the name {', '.join(repeated)}, which differ in their assumptions. "
                "Values in `args` go by name: create each symbol once."
            )
        return Symbols(t, parameters, tuple(sorted(inputs, key=name_of)), t in symbols)


def entries_of(part: Any) -> list[Any]:
    """Return the entries of a matrix row by row, those of a tuple, or an expression alone."""
    import sympy

    several = isinstance(part, tuple) or getattr(part, "shape", ())
    return [*part] if several else [sympy.sympify(part)]


def _leaves(entries: list[Any]) -> tuple[set[Any], set[Any]]:
    """Return the symbols, and the undefined functions and their derivatives, each as a whole.

    Subexpressions are visited once: written out, those of a bicycle have 400 000 operations.
    """
    from sympy import Derivative
    from sympy.core.function import AppliedUndef

    symbols, functions, visited, stack = set(), set(), set(), [*entries]
    while stack:
        expression = stack.pop()
        if expression in visited:
            continue
        visited.add(expression)
        if isinstance(expression, Derivative | AppliedUndef):
            functions.add(expression)
        elif expression.is_Symbol:
            symbols.add(expression)
        else:
            stack.extend(expression.args)
    return symbols, functions


def _is_of_time(function: Any, t: Any) -> bool:
    """Whether this is `x(t)` or a derivative of it, and not a function of coordinates."""
    from sympy import Derivative

    if isinstance(function, Derivative):
        return set(function.variables) == {t} and _is_of_time(function.expr, t)
    return function.args == (t,)


def name_of(symbol: Any) -> str:
    """Return the name without `(t)`: `"q1"`, and `"q1'"` for its derivative."""
    from sympy import Derivative

    if isinstance(symbol, Derivative):
        return name_of(symbol.expr) + "'" * symbol.derivative_count
    return symbol.name


def _is_kane(method: Any) -> bool:
    from sympy.physics.mechanics import KanesMethod

    return isinstance(method, KanesMethod)


def _check_method(method: Any) -> None:
    from sympy.physics.mechanics import KanesMethod, LagrangesMethod

    if not isinstance(method, KanesMethod | LagrangesMethod):
        raise TypeError(
            "`method` must be a `KanesMethod` or a `LagrangesMethod` of `sympy.physics.mechanics`, got "
            f"{type(method).__name__}. Of a `System` pass its `eom_method`, of a `JointsMethod` its `method`."
        )


def _full_matrices(method: Any) -> tuple[Any, Any]:
    formed = "method.kanes_equations(bodies, loads)"
    if not _is_kane(method):
        formed = "method.form_lagranges_equations()"
    try:
        return method.mass_matrix_full, method.forcing_full
    except ValueError:
        raise ValueError(
            f"The equations of `method` have not been formed. Call `{formed}` before."
        ) from None


def _check_constraints_of_kane(positions: Any, velocities: Any) -> None:
    if len(velocities) < len(positions):
        raise ValueError(
            f"`method` has {len(positions)} `configuration_constraints`, but {len(velocities)} `velocity_constraints`: these "
            "must include the time derivatives of those, or the motion leaves them. Add the derivatives, and a dependent "
            "speed for each."
        )
