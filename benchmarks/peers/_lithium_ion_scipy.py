"""The same cell by SciPy, which has no algebraic equations."""

import time
from typing import Any

import jax
import jax.flatten_util as jfu
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

from ._lithium_ion_model import CUT_OFF, Parameters
from ._lithium_ion_task import CELL, LAST, TS


class Eliminated:
    """The differential unknowns alone, for SciPy: Newton's method finds the algebraic ones."""

    def __init__(self) -> None:
        self.parameters = Parameters()
        start, _ = CELL.term.consistent_state(0.0, CELL.start(self.parameters), self.parameters)
        split = lambda state: (
            {name: state[name] for name in ("negative", "positive", "salt")},
            {name: state[name] for name in ("solid", "electrolyte")},
        )
        differential, algebraic = split(start)
        self.y0, unravel = jfu.ravel_pytree(differential)
        self.guess, unravel_algebraic = jfu.ravel_pytree(algebraic)

        def rates(y: Any, z: Any) -> tuple[Any, Any]:
            state = {**unravel(y), **unravel_algebraic(z)}
            parts = split(CELL.rates(0.0, state, self.parameters))
            return jfu.ravel_pytree(parts[0])[0], jfu.ravel_pytree(parts[1])[0]

        def algebraic_at(y: Any, z: Any) -> Any:
            residual = lambda z, y: rates(y, z)[1]
            solver = optx.Newton(rtol=1e-12, atol=1e-12)
            return optx.root_find(residual, solver, z, args=y, max_steps=50, throw=False).value

        field = lambda y, z: rates(y, algebraic_at(y, z))[0]
        self.solve_algebraic = jax.jit(algebraic_at)
        self.field, self.jacobian = jax.jit(field), jax.jit(jax.jacfwd(field))
        self.voltage = jax.jit(lambda z: CELL.voltage(unravel_algebraic(z)))

    def voltage_at(self, y: Any) -> float:
        self.guess = self.solve_algebraic(y, self.guess)
        return float(self.voltage(self.guess))


def solve(tolerance: float) -> tuple[np.ndarray, float, int, float]:
    """Return voltages at `TS`, the time of the cut-off, steps and seconds."""
    of = Eliminated()

    def right(t: float, y: Any) -> np.ndarray:
        of.guess = of.solve_algebraic(y, of.guess)
        return np.asarray(of.field(y, of.guess))

    def cut_off(t: float, y: Any) -> float:
        return of.voltage_at(y) - CUT_OFF

    cut_off.terminal = True
    right(0.0, of.y0)
    jacobian = lambda t, y: np.asarray(of.jacobian(y, of.guess))
    jacobian(0.0, of.y0)
    begin = time.perf_counter()
    sol = solve_ivp(
        right,
        (0.0, LAST),
        np.asarray(of.y0),
        method="BDF",
        jac=jacobian,
        rtol=tolerance,
        atol=tolerance,
        events=cut_off,
        dense_output=True,
    )
    seconds = time.perf_counter() - begin
    V = np.array([of.voltage_at(sol.sol(t)) for t in TS])
    return V, float(sol.t_events[0][0]), sol.t.size - 1, seconds
