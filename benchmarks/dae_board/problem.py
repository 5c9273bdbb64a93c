"""What a problem of the DAE board consists of."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax.tree_util as jtu
import numpy as np


class BoardProblem(NamedTuple):
    """`F(t, x, x', args) = 0` with a published or elementary solution.

    - `start`: a guess at `t = 0`; what follows from the equations is corrected.
    - `end`: of some of the unknowns at `t1`, NaN for what is not published.
    - `floor`: errors are relative to the published number, or to this where that is larger.
    - `jumps`: times at which a derivative of `F` by time jumps.
    - `parameter`: the number in `args`, a mapping, by which is differentiated; over the time
      `short` and with the tolerance `short_tolerance`, if those are given. Empty where that takes
      too long to compile.
    - `form`: that of the reduction.
    - `for_casadi(casadi)`: the equations as CasADi reduces them, and the start of its integrator.
    """

    residual: Callable[..., Any]
    start: Any
    args: dict[str, Any]
    t1: float
    end: Mapping[str, Any]
    parameter: str
    solver: str = "Rodas5P"
    rtol: float = 1e-9
    atol: float = 1e-9
    floor: float = 0.0
    jumps: tuple[float, ...] = ()
    dt0: float | None = None
    short: float | None = None
    short_tolerance: float | None = None
    form: Literal["ode", "index-1"] = "ode"
    for_casadi: Callable[..., Any] | None = None

    def digits(self, x: Any) -> float:
        """Correct ones of the worst number."""
        worst = 0.0
        for name, published in self.end.items():
            published = np.asarray(published, float)
            size = np.maximum(np.abs(published), self.floor)
            error = np.abs(np.asarray(x[name]) - published) / size
            known = ~np.isnan(published)
            worst = max(worst, float(np.max(error[known])))
        return -float(np.log10(max(worst, 1e-16)))


def as_arrays(tree: Any) -> Any:
    return jtu.tree_map(lambda leaf: np.asarray(leaf, float), tree)
