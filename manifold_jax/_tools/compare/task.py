"""The tasks that methods solve, and the results that they return."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ...problems import Problem


# Short runs are repeated until the median settles; long ones three times only.
MIN_RUNS, MAX_RUNS = 3, 50
TIME_BUDGET = 1.0  # seconds


def median_ms(run: Callable[[], Any]) -> float:
    """Return the median duration of `run()` in milliseconds. Warm up before; `run` has to block."""
    durations: list[float] = []
    while len(durations) < MIN_RUNS or (len(durations) < MAX_RUNS and sum(durations) < TIME_BUDGET):
        start = time.perf_counter()
        run()
        durations.append(time.perf_counter() - start)
    return 1e3 * statistics.median(durations)


def compiled(function: Any, *arguments: Any) -> tuple[jax.stages.Compiled, float]:
    """Return the program of a `jax.jit` function, and the seconds it took to trace and compile."""
    start = time.perf_counter()
    program = function.lower(*arguments).compile()
    return program, time.perf_counter() - start


# Times at which solutions are compared, both ends included.
OUTPUT_POINTS = 1001


class SolveFailed(Exception):
    """Raised if a method could not solve the task; the message is the reason, for the table."""


@dataclasses.dataclass(frozen=True)
class Task:
    """A problem of the gallery with the settings that all methods share.

    `gain` (1/time) is that of the methods that stabilize.

    States are rows of arrays `(times, n)` here, the leaves of `y` one after another, so that all
    libraries are treated alike.
    """

    problem: Problem
    solver: str
    rtol: float
    atol: float
    t1: float
    gain: float

    @property
    def t0(self) -> float:
        return self.problem.t0

    @property
    def grid(self) -> np.ndarray:
        return np.linspace(self.t0, self.t1, OUTPUT_POINTS)

    def violations(self, times: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return `max_i |g_i|` at each time, absolute (unlike `mj.constraint_violation`)."""
        problem, unravel = self.problem, jfu.ravel_pytree(self.problem.y0)[1]

        def residual(t, x):
            return jfu.ravel_pytree(problem.constraint(t, unravel(x), problem.args))[0]

        g = jax.jit(jax.vmap(residual))(jnp.asarray(times), jnp.asarray(rows))
        return np.max(np.abs(np.asarray(g)), axis=1)

    def reference(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return indices into the output grid where the solution is known, and the states there."""
        indices = np.arange(OUTPUT_POINTS)
        if self.problem.reference_at_end_only:
            if self.t1 != self.problem.t1:
                return None
            indices = indices[-1:]
        return indices, as_rows(self.problem.reference(self.grid[indices]))


@dataclasses.dataclass(frozen=True)
class Run:
    """The result of a method: its solution and what it cost.

    - `output`: states on the output grid, `(OUTPUT_POINTS, n)`.
    - `step_times`, `steps`: the ends of the accepted steps and the states there.
    - `costs`: of its row in the table those of `accepted`, `rejected`, `evaluations`, `run_ms`
        (median run time, output on the grid and steps included) and `compile_s` (tracing and
        compiling the same program) that are known.
    - `max_steps`: the limit under which it ran, if there is one.
    """

    output: np.ndarray
    step_times: np.ndarray
    steps: np.ndarray
    costs: dict[str, Any]
    max_steps: int | None = None


def as_rows(ys: Any) -> np.ndarray:
    """Return a trajectory, a pytree with a leading axis for the times, as one array `(times, n)`."""
    leaves = [np.asarray(leaf) for leaf in jtu.tree_leaves(ys)]
    return np.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)
