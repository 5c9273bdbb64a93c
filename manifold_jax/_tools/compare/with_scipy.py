"""SciPy's solvers on the same vector field, for comparison."""

import warnings
from typing import Any

import jax
import jax.flatten_util as jfu
import numpy as np
import scipy.integrate

from .task import median_ms, Run, SolveFailed, Task


def run_scipy(task: Task, method: str) -> Run:
    """Run `scipy.integrate.solve_ivp`, which calls the compiled vector field from Python.

    SciPy does not report rejected steps. Evaluations are those of the timed run with output on the grid
    (DOP853 needs three more per step for it); LSODA's contain the differences for its Jacobians.
    """
    problem = task.problem
    x0, unravel = jfu.ravel_pytree(problem.y0)

    @jax.jit
    def field(t, x):
        return jfu.ravel_pytree(problem.terms.vf(t, unravel(x), problem.args))[0]

    def solve(grid: np.ndarray | None) -> Any:
        with warnings.catch_warnings():
            # about tolerances that it raises, and failed steps, which the result reports, too
            warnings.simplefilter("ignore")
            return scipy.integrate.solve_ivp(
                lambda t, x: np.asarray(field(t, x)),
                (task.t0, task.t1),
                np.asarray(x0),
                method,
                t_eval=grid,
                rtol=task.rtol,
                atol=task.atol,
            )

    on_steps = solve(None)  # compiles the vector field too
    if not on_steps.success:
        raise SolveFailed(on_steps.message)
    on_grid = solve(task.grid)
    return Run(
        output=on_grid.y.T,
        step_times=on_steps.t[1:],
        steps=on_steps.y.T[1:],
        costs={
            "accepted": len(on_steps.t) - 1,
            "evaluations": int(on_grid.nfev),
            "run_ms": median_ms(lambda: solve(task.grid)),
        },
    )
