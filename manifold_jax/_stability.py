"""How large a gain a solver can take."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

from ._custom_types import BoolScalar, RealScalarLike


def refuse_negative(name: str, gain: RealScalarLike) -> None:
    if isinstance(gain, int | float) and not gain >= 0:
        raise ValueError(
            f"`{name}` must not be negative, got {gain}: violations would grow instead of decay. "
            "Integrating backwards needs no change of sign."
        )


def is_stable(gain: RealScalarLike, step: RealScalarLike, solver: dfx.AbstractSolver) -> BoolScalar:
    """Whether `exp(-gain t)` is approximated by something that decays."""
    gain = jnp.asarray(gain)
    # Rounding of a step at the limit itself does not count.
    return (gain >= 0) & (gain * jnp.abs(step) <= 1.0001 * stability_interval(solver))


def stability_interval(solver: dfx.AbstractSolver) -> float:
    """The largest `x` with `|R(-s)| <= 1` for all `0 <= s <= x`, `R` the stability function
    of an explicit Runge-Kutta method; infinite for other solvers."""
    tableau: Any = getattr(solver, "tableau", None)
    if not isinstance(solver, dfx.AbstractERK) or not isinstance(tableau, dfx.ButcherTableau):
        return 2.0 if isinstance(solver, dfx.Euler) else float("inf")
    stages = tableau.num_stages
    A = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    power, coefficients = np.ones(stages), [1.0]
    for _ in range(stages):
        coefficients.append(float(np.asarray(tableau.b_sol) @ power))
        power = A @ power
    R = np.polynomial.Polynomial([c * (-1) ** k for k, c in enumerate(coefficients)])
    roots = (R * R - 1).roots()
    crossings = roots.real[(np.abs(roots.imag) < 1e-6) & (roots.real > 1e-3)]
    return float(min(crossings, default=np.inf))
