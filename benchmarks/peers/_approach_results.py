"""What `benchmarks.peers.approaches` measures of each way to solve a problem."""

import dataclasses
import functools
import runpy
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from manifold_jax._tools.compare.approaches import default_gain, known_approaches
from manifold_jax._tools.compare.report import sizes
from manifold_jax._tools.compare.task import as_rows
from manifold_jax._tools.compare.with_diffrax import SOLVERS
from manifold_jax.problems import Problem

from ..tools.cost import Cost, predicted_cost, stages_per_step
from ..tools.measure import interleaved, largest_difference, Timing
from ._candidates import Candidate, OfDiffrax, OfScipy, output_times, SCIPY_METHODS


# Seconds of timed runs of all methods at one tolerance; of long runs there are at least three.
TIME_BUDGET = 4.0
LEAST_REPEATS = 3
RESIDUALS = Path(__file__).parents[2] / "tests" / "numpy_residuals.py"


@dataclasses.dataclass(frozen=True)
class Row:
    """A way to solve a problem at one tolerance; `None` where a number is not known.

    - `f`, `g`, `velocity`, `G`: evaluations in the whole solve, see `Evaluations`.
    - `iterations`: of Newton per accepted step, of the correction at its end.
    - `violation_steps`, `violation_output`: the largest `|g|` at the ends of the steps and at
        the output times, by NumPy; `error`: the largest one of a component of the state.
    """

    problem: str
    method: str
    tolerance: float
    accepted: int | None = None
    rejected: int | None = None
    f: int | None = None
    g: int | None = None
    velocity: int | None = None
    G: int | None = None
    iterations: float | None = None
    violation_steps: float | None = None
    violation_output: float | None = None
    error: float | None = None
    median_ms: float | None = None
    low_ms: float | None = None
    high_ms: float | None = None
    failure: str | None = None

    @property
    def attempts(self) -> int | None:
        """Steps, accepted or not."""
        if self.accepted is None or self.rejected is None:
            return None
        return self.accepted + self.rejected


@dataclasses.dataclass(frozen=True)
class Setting:
    """What holds for a problem at all tolerances: `n` states, `m` constraints, the gain of
    stabilization, seconds to compile and the predicted cost of a step, by method."""

    n: int
    m: int
    gain: float
    compile_s: Mapping[str, float | None]
    predicted: Mapping[str, Cost | None]


def prepare(
    problem: Problem, methods: Sequence[str], solver: str, tell: Callable[[str], None]
) -> tuple[dict[str, Candidate], dict[str, str]]:
    """The candidates, and the reasons why some could not be prepared."""
    candidates: dict[str, Candidate] = {}
    failures: dict[str, str] = {}
    approaches = {approach.name: approach for approach in known_approaches()}
    scipy_methods = {f"scipy-{method.lower()}": method for method in SCIPY_METHODS}
    for name in methods:
        tell(f"{problem.name}: compiling {name}")
        if name in scipy_methods:
            candidates[name] = OfScipy.prepare(problem, scipy_methods[name])
            continue
        needs = approaches[name].needs
        if needs is not None and not needs.is_met_by(problem):
            continue
        try:
            candidates[name] = OfDiffrax.prepare(problem, approaches[name], SOLVERS[solver]())
        except Exception as error:  # one that does not apply: the others are still of interest
            failures[name] = _reason(error)
    return candidates, failures


def setting(problem: Problem, candidates: Mapping[str, Candidate], solver: str) -> Setting:
    n, m = sizes(problem)
    stages = stages_per_step(SOLVERS[solver]())
    diffrax = [name for name in candidates if not name.startswith("scipy")]
    return Setting(
        n,
        m,
        default_gain(problem),
        {name: candidate.compile_s for name, candidate in candidates.items()},
        {name: predicted_cost(name, stages, n, m) for name in diffrax},
    )


def measure(
    problem: Problem, candidates: Mapping[str, Candidate], tolerance: float, repeats: int
) -> list[Row]:
    """All candidates at one tolerance, timed at most `repeats` times. One that fails gets a row
    that says so."""
    rows, runs = {}, {}
    for name, candidate in candidates.items():
        try:
            rows[name] = _check(problem, name, candidate, tolerance)
            runs[name] = candidate.program(tolerance)
        except RuntimeError as error:
            rows[name] = Row(problem.name, name, tolerance, failure=_reason(error))
    timings = interleaved(runs, _affordable(runs, repeats)) if runs else {}
    return [_with_timing(row, timings.get(name)) for name, row in rows.items()]


def _affordable(runs: Mapping[str, Callable], repeats: int) -> int:
    """How often all of them can be timed, each after an untimed run."""
    start = time.perf_counter()
    for run in runs.values():
        run()
    seconds = 2 * (time.perf_counter() - start)
    return min(repeats, max(LEAST_REPEATS, int(TIME_BUDGET / seconds)))


def _check(problem: Problem, name: str, candidate: Candidate, tolerance: float) -> Row:
    states = candidate.states(candidate.program(tolerance)())
    examined = candidate.examine(tolerance)
    times = output_times(problem)
    known = times[-1:] if problem.reference_at_end_only else times
    reference = as_rows(problem.reference(known))
    return Row(
        problem.name,
        name,
        tolerance,
        accepted=len(examined.times),
        rejected=examined.rejected,
        **examined.evaluations._asdict(),
        iterations=examined.iterations_per_step,
        violation_steps=_violation(problem, examined.times, examined.states),
        violation_output=_violation(problem, times, states),
        error=largest_difference(states[-len(known) :], reference),
    )


def _violation(problem: Problem, times: np.ndarray, states: np.ndarray) -> float:
    """Largest `|g|` by the constraint's second definition, for the tests, in NumPy."""
    residual = _numpy_residuals()[problem.name.replace("-", "_")]
    layout = jax.vmap(jfu.ravel_pytree(problem.y0)[1])(jnp.asarray(states))
    return float(np.max(np.abs(residual(times, jtu.tree_map(np.asarray, layout)))))


@functools.cache
def _numpy_residuals() -> dict[str, Callable]:
    return runpy.run_path(str(RESIDUALS))


def _with_timing(row: Row, timing: Timing | None) -> Row:
    return row if timing is None else dataclasses.replace(row, **dataclasses.asdict(timing))


def _reason(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
