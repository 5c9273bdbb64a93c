"""Example 2.1 of the paper: Euler's method on a circle, with and without projection.

Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193: steps of size `h = sqrt(2 tau)` for
`x' = (x2, -x1)`, `g = |x|^2 - 1`, make one turn in `N = ceil(2 pi / atan h)` steps. Each
multiplies `|x|^2` by `1 + h^2`, so that `g(x_N) = (1 + 2 tau)^N - 1` although every step
keeps to the local tolerance `tau`.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from ..._solve import diffeqsolve
from ..._solver import Projected
from ...problems import harmonic_oscillator
from .report import number_columns


TAUS = tuple(10.0**-k for k in range(1, 9))

TITLE = "Euler's method on the circle, one turn (Sudarsan & Keerthi 1998, Example 2.1)"
NOTES = (
    "Local tolerance tau, N steps of size h = sqrt(2 tau); "
    "without projection g(x_N) = (1 + 2 tau)^N - 1.",
    "The gain is special: Euler's local error is normal to the circle to leading order.",
)


class PaperRow(NamedTuple):
    """One line of Table 1. Errors are Euclidean distances from the solution at `N h`.

    - `closed_form`, `run`: `g(x_N)` without projection, by the formula and as computed.
    - `violation`: the largest `|g|` of all steps with projection.
    - `gain`: `error / projected_error`.
    """

    tau: float
    h: float
    N: int
    closed_form: float
    run: float
    error: float
    violation: float
    projected_error: float
    gain: float


def paper_rows(taus: tuple[float, ...] = TAUS) -> Iterator[PaperRow]:
    """Yield Table 1 line by line."""
    # One limit for all lines, so that one program is compiled for all.
    limit = max(_steps_of_one_turn(math.sqrt(2 * tau)) for tau in taus)
    constraint = harmonic_oscillator().constraint
    for tau in taus:
        h = math.sqrt(2 * tau)
        N = _steps_of_one_turn(h)
        plain = _euler(dfx.Euler(), h, N, limit)
        projected = _euler(Projected(dfx.Euler(), constraint), h, N, limit)
        solution = np.array([math.cos(N * h), -math.sin(N * h)])
        error, projected_error = (np.linalg.norm(x[-1] - solution) for x in (plain, projected))
        yield PaperRow(
            tau=tau,
            h=h,
            N=N,
            closed_form=math.expm1(N * math.log1p(2 * tau)),
            run=float(_residual(plain)[-1]),
            error=float(error),
            violation=float(np.max(np.abs(_residual(projected)))),
            projected_error=float(projected_error),
            gain=float(error / projected_error),
        )


def _steps_of_one_turn(h: float) -> int:
    return math.ceil(2 * math.pi / math.atan(h))


def _residual(x: np.ndarray) -> np.ndarray:
    return x[..., 0] ** 2 + x[..., 1] ** 2 - 1


def _euler(solver: dfx.AbstractSolver, h: float, N: int, limit: int) -> np.ndarray:
    """Return the states after each of `N` steps of size `h`."""
    problem = harmonic_oscillator()
    sol = diffeqsolve(
        problem.terms,
        solver,
        jnp.asarray(0.0),
        jnp.asarray(N * h),
        jnp.asarray(h),
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(steps=True),
        max_steps=limit,
    )
    steps = int(sol.stats["num_steps"])
    if steps != N:
        raise RuntimeError(f"Expected {N} steps of size {h}, but {steps} were taken.")
    return np.asarray(sol.ys)[:N]


def _digits(count: int) -> Callable[[float], str]:
    """Format this many significant digits, with an exponent (without padding) below 1."""

    def shown(value: float) -> str:
        if 1 <= value < 10**count:
            return f"{value:#.{count}g}".rstrip(".")
        mantissa, _, exponent = f"{value:.{count - 1}e}".partition("e")
        return f"{mantissa}e{int(exponent)}"

    return shown


def _gain(value: float) -> str:
    return f"{value:.1f}" if value < 1000 else f"{value:.0f}"


_COLUMNS: dict[str, Callable[[Any], str]] = {
    "\ntau": _digits(1),
    "\nh": _digits(5),
    "\nN": str,
    "g(x_N)\nclosed form": _digits(7),
    "g(x_N)\nrun": _digits(7),
    "\nerror": _digits(5),
    "projected\nmax |g|": _digits(1),
    "projected\nerror": _digits(5),
    "\ngain": _gain,
}


def paper_table(rows: list[PaperRow]) -> Table:
    table = Table(*number_columns(_COLUMNS))
    for row in rows:
        table.add_row(*(shown(value) for shown, value in zip(_COLUMNS.values(), row, strict=True)))
    return table
