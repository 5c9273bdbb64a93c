"""What the thresholds in the code come from, for the installed JAX.

`python -m benchmarks.speed.thresholds --json benchmarks/results/thresholds.json`

Ratios of run times, interleaved, medians:

- steps with stages in a loop / written out (`LARGEST_UNROLLED` in `_solver/explicit.py`), for
  mechanisms of more and more equations, alone and in a batch, and the same ratio of compile times;
- a gradient in a batch without / with the division that keeps XLA from computing stages again
  (`derivative_once` in the same file);
- a gradient whose steps are recorded in large blocks / in small ones (`_adjoint/record.py`).
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import typer
from rich.table import Table

import manifold_jax as mj
from manifold_jax._adjoint import record
from manifold_jax._jaxpr.trace import num_equations
from manifold_jax._solver.step import explicit

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    make_console,
    use_double_precision,
    write_json,
)


TOLERANCE, BATCH = 1e-6, 256
PROBLEMS = {
    "pendulum": mj.problems.pendulum,
    "rigid body": mj.problems.rigid_body,
    "slider-crank": mj.problems.slider_crank,
    "double pendulum": mj.problems.double_pendulum,
}


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Equations of all stages, and time of the second way over that of the first."""

    what: str
    equations: int
    single: float
    batch: float
    compiling: float


@contextmanager
def changed(module: Any, **values: Any) -> Iterator[None]:
    old = {name: getattr(module, name) for name in values}
    try:
        for name, value in values.items():
            setattr(module, name, value)
        jax.clear_caches()
        yield
    finally:
        for name, value in old.items():
            setattr(module, name, value)
        jax.clear_caches()


def end(problem: Any, factor: Any) -> Any:
    """A number that depends on the end of a solve, for another start."""
    sol = mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        problem.t0,
        problem.t0 + 0.5 * (problem.t1 - problem.t0),
        None,
        jax.tree.map(lambda leaf: factor * leaf, problem.y0),
        problem.args,
        stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        throw=False,
    )
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(sol.ys))


def equations(problem: Any) -> int:
    """As `explicit_step` counts them."""
    f = lambda y: problem.terms.vf(jnp.asarray(problem.t0), y, problem.args)
    stages = len(dfx.Tsit5().tableau.c)
    return stages * num_equations(f, problem.y0)


def compare(
    what: str, problem: Any, function: Callable, first: Any, second: Any, repeats: int
) -> Comparison:
    """`first` and `second` are contexts in which `function` is compiled."""
    factors = jnp.linspace(0.98, 1.02, BATCH)
    runs: dict[str, dict[str, Any]] = {"single": {}, "batch": {}}
    seconds = {}
    for name, context in (("first", first), ("second", second)):
        with context:
            runs["single"][name], compiling = compiled(function, jnp.asarray(1.0))
            runs["batch"][name], _ = compiled(jax.vmap(function), factors)
        seconds[name] = compiling.process_s
    ratio = {}
    for kind, programs in runs.items():
        times = interleaved(programs, repeats)
        ratio[kind] = times["second"].median_ms / times["first"].median_ms
    compiling = seconds["second"] / seconds["first"]
    return Comparison(what, equations(problem), ratio["single"], ratio["batch"], compiling)


def comparisons(repeats: int) -> Iterator[Comparison]:
    unrolled = functools.partial(changed, explicit)
    for name, build in PROBLEMS.items():
        problem = build()
        written_out, looped = unrolled(LARGEST_UNROLLED=10**9), unrolled(LARGEST_UNROLLED=0)
        solve = functools.partial(end, problem)
        yield compare(f"loop / written out: {name}", problem, solve, written_out, looped, repeats)
    problem = mj.problems.pendulum()
    gradient, as_it_is = (
        jax.grad(functools.partial(end, problem)),
        functools.partial(changed, explicit),
    )
    without = changed(explicit, derivative_once=lambda y, like: y)
    yield compare(
        "gradient, without / with division", problem, gradient, as_it_is(), without, repeats
    )
    large = changed(record, _SMALL=0)
    yield compare("gradient, large / small blocks", problem, gradient, as_it_is(), large, repeats)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    repeats: Annotated[int, typer.Option(min=3, help="Timed runs per program.")] = 15,
) -> None:
    """Measure what the thresholds in the code come from (a few minutes)."""
    use_double_precision()
    console = make_console()
    table = Table(title=f"Ratios of times, jaxlib {jax.lib.__version__}", title_justify="left")
    for heading in ("", "equations", "single", f"batch of {BATCH}", "compiling"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    rows = []
    for row in comparisons(repeats):
        rows.append(row)
        figures = (f"{x:.2f}" for x in (row.single, row.batch, row.compiling))
        table.add_row(row.what, str(row.equations), *figures)
    console.print(table)
    if json is not None:
        settings = {"tolerance": TOLERANCE, "batch": BATCH, "solver": "projected Tsit5"}
        rows = [dataclasses.asdict(row) for row in rows]
        write_json(json, dict(settings=settings, environment=environment(), rows=rows))


if __name__ == "__main__":
    typer.run(main)
