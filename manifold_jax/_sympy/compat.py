"""Private names of SymPy, of version 1.13 and later, and nothing else.

A `KanesMethod` does not give its constraints under a public name, a `LagrangesMethod` only their
derivatives.
"""

from typing import Any


def time_symbol() -> Any:
    """Return the symbol `t` of `dynamicsymbols`."""
    from sympy.physics.mechanics import dynamicsymbols

    return dynamicsymbols._t


def constraints_of_kane(method: Any) -> tuple[Any, Any]:
    """Return the configuration constraints and the velocity constraints, in the speeds."""
    if not method._k_nh:
        return method._f_h, method._f_nh
    return method._f_h, method._k_nh * method.u + method._f_nh


def dependents_of_kane(method: Any) -> tuple[Any, Any]:
    """Return the dependent coordinates and the dependent speeds."""
    return method._qdep, method._udep


def holonomic_of_lagrange(method: Any) -> Any:
    return method._hol_coneqs
