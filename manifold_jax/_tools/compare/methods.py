"""The methods that are compared, and the measurements of each."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from .approaches import CONTINUOUS, known_approaches, Need, Style
from .task import Run, SolveFailed, Task
from .with_diffrax import run_diffrax
from .with_scipy import run_scipy


_BLACK = Style("#000000")


@dataclasses.dataclass(frozen=True)
class Method:
    """One way to solve a task.

    - `label`: its name in tables, in which `{solver}` is the Diffrax solver asked for.
    - `run`: solves a task; raises `SolveFailed` if it cannot.
    - `style`: in pictures.
    - `needs`: as of an [`Approach`][].
    """

    label: str
    run: Callable[[Task], Run]
    style: Style = _BLACK
    needs: Need | None = None

    @property
    def key(self) -> str:
        """Its name on the command line: `plain`, `scipy-rk45`."""
        return self.label.removesuffix(" {solver}").replace(" ", "-").lower()

    def name(self, task: Task) -> str:
        return self.label.format(solver=task.solver)


# In the order of the tables.
METHODS: tuple[Method, ...] = (
    *(
        Method(
            f"{approach.name} {{solver}}",
            functools.partial(run_diffrax, approach=approach),
            approach.style,
            approach.needs,
        )
        for approach in known_approaches()
    ),
    *(
        Method(
            f"scipy {name}",
            functools.partial(run_scipy, method=name),
            Style(colour, "dotted"),
            CONTINUOUS,
        )
        for name, colour in (("RK45", "#555555"), ("DOP853", "#888888"), ("LSODA", "#BBBBBB"))
    ),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table and of the JSON file; `None` for unknown numbers.

    Violations are the largest `|g|`, at the ends of the steps and on the output grid; `error` is the
    largest error of a state component where the solution is known.
    """

    method: str
    accepted: int | None = None
    rejected: int | None = None
    evaluations: int | None = None
    violation_steps: float | None = None
    violation_output: float | None = None
    error: float | None = None
    run_ms: float | None = None
    compile_s: float | None = None


@dataclasses.dataclass(frozen=True)
class Measurement:
    """A row of the table and the curves of the picture.

    States `(times, n)` and violations are on the output grid, errors where the solution is
    known. After a failed solve only `failure`, the reason, is set.
    """

    key: str
    row: Row
    failure: str | None = None
    max_steps: int | None = None
    states: np.ndarray | None = None
    violations: np.ndarray | None = None
    error_times: np.ndarray | None = None
    errors: np.ndarray | None = None


def measure(task: Task, method: Method) -> Measurement:
    """Solve the task with one method; a failure is a result, too."""
    key, name = method.key, method.name(task)
    try:
        run = method.run(task)
        if not (np.all(np.isfinite(run.output)) and np.all(np.isfinite(run.steps))):
            raise SolveFailed("the solution is not finite")
    except SolveFailed as error:
        return Measurement(key, Row(name), failure=str(error))
    except Exception as error:  # raised by a library: the other methods are still of interest
        reason = str(error).strip().partition("\n")[0]
        return Measurement(key, Row(name), failure=f"{type(error).__name__}: {reason}")
    violations = task.violations(task.grid, run.output)
    error_times, errors = _errors(task, run)
    row = Row(
        name,
        **run.costs,
        violation_steps=_largest(task.violations(run.step_times, run.steps)),
        violation_output=_largest(violations),
        error=None if errors is None else _largest(errors),
    )
    return Measurement(
        key,
        row,
        max_steps=run.max_steps,
        states=run.output,
        violations=violations,
        error_times=error_times,
        errors=errors,
    )


def _errors(task: Task, run: Run) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return where the solution is known, and the largest error of a component there."""
    known = task.reference()
    if known is None:
        return None, None
    indices, states = known
    return task.grid[indices], np.max(np.abs(run.output[indices] - states), axis=1)


def _largest(values: np.ndarray) -> float | None:
    largest = float(np.max(values))
    return largest if np.isfinite(largest) else None
