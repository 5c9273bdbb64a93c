"""The approaches to a manifold side by side: section 4 of the paper with counts and times.

`python -m benchmarks.peers.approaches --json FILE --plot FILE`

Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, compare projection (perturbation),
stabilization and local coordinates (parameterization). Here with one Runge-Kutta method of
Diffrax at tolerances from 1e-3 to 1e-10, next to SciPy.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import typer
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from manifold_jax._tools.compare.approaches import known_approaches
from manifold_jax._tools.compare.with_diffrax import SOLVERS
from manifold_jax.problems import ALL

from ..tools.measure import environment, make_console, use_double_precision, write_json
from ..tools.work_precision import write_figure
from ._approach_results import measure, prepare, Row, Setting, setting
from ._approach_summary import equal_error_table, summary_table
from ._approach_tables import accuracy_table, cost_table, failures
from ._candidates import MAX_STEPS, OUTPUT_POINTS, SCIPY_METHODS


PROBLEMS = ("pendulum", "double-pendulum", "slider-crank", "rigid-body", "kepler", "four-bar")
METHODS = (
    *(approach.name for approach in known_approaches()),
    *(f"scipy-{method.lower()}" for method in SCIPY_METHODS),
)
TOLERANCES = tuple(10.0**-k for k in range(3, 11))
# With --quick: whether everything works, in a few seconds.
QUICK_METHODS, QUICK_TOLERANCES = ("plain", "projected", "scipy-rk45"), (1e-4, 1e-6)


def compare(
    names: list[str],
    methods: tuple[str, ...],
    tolerances: tuple[float, ...],
    solver: str,
    repeats: int,
    progress: Progress,
) -> tuple[dict[str, Setting], list[Row]]:
    """All problems, one after another."""
    status = progress.add_task("")
    tell = lambda doing: progress.update(status, description=doing)
    settings, rows = {}, []
    for name in names:
        problem = ALL[name]()
        candidates, failed = prepare(problem, methods, solver, tell)
        settings[name] = setting(problem, candidates, solver)
        for tolerance in tolerances:
            tell(f"{name}: tolerance {tolerance:.0e}")
            rows += measure(problem, candidates, tolerance, repeats)
            rows += [Row(name, m, tolerance, failure=why) for m, why in failed.items()]
    return settings, rows


def content(
    settings: dict[str, Setting], rows: list[Row], solver: str, repeats: int
) -> dict[str, Any]:
    """Of the JSON file."""
    problems = {
        name: {
            **dataclasses.asdict(s),
            "predicted": {
                method: cost._asdict() for method, cost in s.predicted.items() if cost is not None
            },
        }
        for name, s in settings.items()
    }
    return {
        "environment": environment(),
        "settings": {
            "solver": solver,
            "output_points": OUTPUT_POINTS,
            "max_steps": MAX_STEPS,
            "repeats": repeats,
        },
        "problems": problems,
        "rows": [dataclasses.asdict(row) for row in rows],
    }


def _check_names(problems: str, solver: str) -> list[str]:
    names = [name.strip() for name in problems.split(",")]
    unknown = [name for name in names if name not in ALL]
    if unknown:
        raise typer.BadParameter(f"no problem {unknown[0]!r}; choose from {', '.join(ALL)}")
    explicit = [name for name, kind in SOLVERS.items() if issubclass(kind, dfx.AbstractERK)]
    if solver not in explicit:
        raise typer.BadParameter(f"no solver {solver!r}; choose from {', '.join(explicit)}")
    return names


def main(
    problems: Annotated[
        str, typer.Option(metavar="NAME,...", help="Problems of the gallery.")
    ] = ",".join(PROBLEMS),
    solver: Annotated[str, typer.Option(metavar="NAME", help="Explicit method.")] = "dopri5",
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Most timed runs.")] = 11,
    quick: Annotated[bool, typer.Option("--quick", help="Three methods, two tolerances.")] = False,
) -> None:
    """Compare the approaches: evaluations, violation, error and time, by tolerance."""
    use_double_precision()
    names = _check_names(problems, solver)
    methods, tolerances = (QUICK_METHODS, QUICK_TOLERANCES) if quick else (METHODS, TOLERANCES)
    console = make_console()
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        settings, rows = compare(names, methods, tolerances, solver, repeats, progress)
    typical = tolerances[len(tolerances) // 2 - 1]
    for name in names:
        own = [row for row in rows if row.problem == name]
        console.print(cost_table(name, settings[name], own, typical))
        console.print(accuracy_table(name, own, tolerances[1::2]))
    console.print(summary_table(rows))
    console.print(equal_error_table(rows))
    for line in failures(rows):
        console.print(line)
    if json is not None:
        write_json(json, content(settings, rows, solver, repeats))
    if plot is not None:
        write_figure(
            plot, rows, f"{solver}, rtol = atol = tolerance; output at {OUTPUT_POINTS} times"
        )


if __name__ == "__main__":
    typer.run(main)
