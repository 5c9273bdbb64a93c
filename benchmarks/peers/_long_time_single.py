"""What is left of single precision after a million steps of order 2."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ._long_time_task import Task


SAMPLES = 100


def every_state(build: Callable[[], Task], steps: int, double: bool, carries: bool) -> Any:
    """Return the states after all steps of order 2. Without `carries` the solver forgets, after each step, what
    rounding has taken from the state."""
    with jax.enable_x64(double):
        task = build()
        _, solver = task.methods["RATTLE 2"]
        made = dict(
            terms=task.terms, t0=0.0, t1=task.step, args=None
        )  # forces do not depend on time

        def advance(carry, _):
            y, state = carry
            y1, _, _, after, _ = solver.step(**made, y0=y, solver_state=state, made_jump=False)
            return (y1, after if carries else state), y1

        start = task.y0, solver.init(**made, y0=task.y0)
        run = jax.jit(lambda start: jax.lax.scan(advance, start, length=steps)[1])
        return task, tuple(np.asarray(leaf) for leaf in run(start))


def single_precision(build: Callable[[], Task], steps: int) -> list[dict[str, Any]]:
    """Compare with the same steps in double precision."""
    _, exact = every_state(build, steps, True, True)
    rows, unit = [], float(np.finfo(np.float32).eps)
    for carries in (True, False):
        task, (q, v) = every_state(build, steps, False, carries)
        q, v = q.astype(float), v.astype(float)
        error = np.abs(q - exact[0]).reshape(steps, -1).max(axis=1)
        out = dict(problem=task.name, compensated=carries, steps=steps)
        out["violation_in_units"] = float(task.violation(q, v).max() / unit)
        out |= dict(error=float(error.max()), end=steps * task.step)
        energy = task.conserved["energy"]
        change = np.abs(energy(q, v) - energy(*exact)).max()
        largest = [float(part.max()) for part in np.array_split(error, SAMPLES)]
        rows.append(out | dict(energy=float(change), samples=largest))
    return rows
