"""The problems of SciML's benchmarks of DAEs, each from its residual as it is written, with multipliers.

`python -m benchmarks.dae_board --json FILE --plot FILE`

For each: what the reduction found, digits against the published (or elementary) solution at the end,
steps, run time, how far constraints are violated there; the derivative of the unknowns by a parameter
in both modes and by differences; and IDA (scikit-sundae) and Radau (scipy_dae), where installed, on
the same residual. `--quick` leaves out derivatives and other libraries. With `--problems`, the rows of
other problems that are in the file FILE are kept; `--solver RadauIIA5` takes another one for stiff problems.
"""

import dataclasses
import time
from collections.abc import Callable
from json import loads as read_json
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import matplotlib
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ..tools.measure import (
    compiled_for_any,
    environment,
    interleaved,
    make_console,
    milliseconds,
    number,
    Timing,
    use_double_precision,
    write_json,
)
from .adder import two_bit_adder
from .chemistry import chemistry
from .circuits import circuits
from .linear import linear_problems
from .mechanisms import mechanisms
from .peers import installed, PeerRow, PEERS, run_peers
from .problem import BoardProblem
from .slider_crank import slider_crank
from .solve import Gradients, gradients, Reduction
from .water import water_tubes
from .wheelset import wheelset


LONG = 5e3  # milliseconds, from which a run is timed only once


@dataclasses.dataclass(frozen=True)
class Row:
    """`status` is "ok", or what went wrong; then numbers are `None` as far as they were not reached."""

    problem: str
    status: str
    form: str
    solver: str
    unknowns: int
    index: int | None = None
    degrees_of_freedom: int | None = None
    digits: float | None = None
    steps: int | None = None
    violation: float | None = None
    reduce_s: float | None = None
    compile_s: float | None = None
    run: Timing | None = None
    gradient_s: float | None = None
    reverse_forward: float | None = None
    reverse_differences: float | None = None
    peers: tuple[dict[str, Any], ...] = ()


def every_problem() -> dict[str, BoardProblem]:
    return {
        **linear_problems(),
        **chemistry(),
        **mechanisms(),
        "slider-crank": slider_crank(),
        **circuits(),
        "two-bit adder": two_bit_adder(),
        "water tubes": water_tubes(),
        "wheelset": wheelset(),
    }


def _size(problem: BoardProblem) -> int:
    return sum(int(np.size(leaf)) for leaf in jax.tree_util.tree_leaves(problem.start))


def measure(name: str, problem: BoardProblem, repeats: int, quick: bool) -> Row:
    row = Row(name, "ok", problem.form, problem.solver, _size(problem))
    try:
        reduction = Reduction.of(problem)
    except ValueError as error:
        return dataclasses.replace(row, status=f"refused: {str(error).split('.')[0]}")
    report = reduction.dae.report
    z0 = reduction.consistent(reduction.args)
    solve = lambda z0, args: reduction.solve(z0, args, problem.t1)
    program, seconds = compiled_for_any(_last(solve), z0, reduction.args)
    before = time.perf_counter()
    z, steps, result, t1 = program(z0, reduction.args)
    once = 1e3 * (time.perf_counter() - before)
    timing = Timing(once, once, once)
    if once < LONG:
        timing = interleaved({"run": lambda: program(z0, reduction.args)}, repeats)["run"]
    x = jax.jit(lambda z, args: reduction.outputs(z, args, problem.t1))(z, reduction.args)
    reached = bool(result)
    row = dataclasses.replace(
        row,
        status="ok" if reached else f"ends at {float(t1):.3g}",
        index=report.index,
        degrees_of_freedom=report.degrees_of_freedom,
        digits=problem.digits(x) if reached else None,
        steps=int(steps),
        violation=reduction.violation(z, reduction.args) if reached else None,
        reduce_s=reduction.seconds,
        compile_s=seconds.wall_s,
        run=timing,
    )
    if quick or not reached:
        return row
    peers: list[PeerRow] = run_peers(reduction)
    row = dataclasses.replace(row, peers=tuple(peer._asdict() for peer in peers))
    if not problem.parameter:
        return row
    found: Gradients = gradients(reduction)
    return dataclasses.replace(
        row,
        gradient_s=found.seconds,
        reverse_forward=found.forward,
        reverse_differences=found.differences,
    )


def _last(solve: Callable) -> Callable:
    def last(z0: Any, args: Any) -> tuple[Any, Any, Any, Any]:
        sol = solve(z0, args)
        success = sol.result == dfx.RESULTS.successful
        return sol.ys[-1], sol.stats["num_steps"], success, sol.ts[-1]

    return last


def _rows_in(path: Path | None) -> dict[str, Row]:
    """Of an earlier run."""
    if path is None or not path.exists():
        return {}
    rows = read_json(path.read_text())["problems"]
    timings = [None if row["run"] is None else Timing(**row["run"]) for row in rows]
    return {
        row["problem"]: Row(**{**row, "run": timing})
        for row, timing in zip(rows, timings, strict=True)
    }


def print_table(console: Console, rows: list[Row]) -> None:
    table = Table(
        "problem",
        "n",
        "index",
        "dof",
        "digits",
        "steps",
        "ms",
        "violation",
        "grad",
        "diff",
        "status",
    )
    for row in rows:
        table.add_row(
            row.problem,
            str(row.unknowns),
            number(row.index, "d"),
            number(row.degrees_of_freedom, "d"),
            number(row.digits, ".1f"),
            number(row.steps, "d"),
            milliseconds(None if row.run is None else row.run.median_ms),
            number(row.violation, ".0e"),
            number(row.reverse_forward, ".0e"),
            number(row.reverse_differences, ".0e"),
            row.status,
        )
    console.print(table)
    if any(row.peers for row in rows):
        table = Table("problem", "other library", "digits", "steps", "ms", "status")
        for row in rows:
            for peer in row.peers:
                digits, steps = number(peer["digits"], ".1f"), number(peer["steps"], "d")
                ms = milliseconds(1e3 * peer["seconds"])
                table.add_row(row.problem, peer["method"], digits, steps, ms, peer["status"])
        console.print(table)


def draw(rows: list[Row], path: Path) -> None:
    """Digits of each problem, ours and others'."""
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.36 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))[::-1]
    capped = lambda digits: min(max(digits, 0.05), 16.0)
    ours = [0.05 if row.digits is None else capped(row.digits) for row in rows]
    axes.barh(places, ours, height=0.55, color="0.8", label="reduce_dae (this library)")
    for name, marker in zip(PEERS.values(), ("o", "s", "D"), strict=True):
        found = [
            (capped(peer["digits"]), place)
            for row, place in zip(rows, places, strict=True)
            for peer in row.peers
            if peer["method"] == name and peer["digits"] is not None
        ]
        if found:
            axes.plot(*zip(*found, strict=True), marker, ms=6, label=name)
    axes.set_yticks(places, [row.problem for row in rows])
    axes.set_xlabel("correct digits of the worst number at the end")
    axes.set_xlim(0, 16)
    axes.grid(axis="x", alpha=0.4)
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(
    problems: Annotated[str, typer.Option(help="names, separated by commas; all if empty")] = "",
    solver: Annotated[str, typer.Option(help="of stiff problems, instead of Rodas5P")] = "Rodas5P",
    quick: Annotated[bool, typer.Option(help="no derivatives and no other libraries")] = False,
    repeats: Annotated[int, typer.Option(help="timed runs of each program")] = 3,
    json: Annotated[Path | None, typer.Option(help="where to write the result")] = None,
    plot: Annotated[Path | None, typer.Option(help="where to write the picture")] = None,
) -> None:
    use_double_precision()
    console, made = make_console(), every_problem()
    names = [name.strip() for name in problems.split(",")] if problems else [*made]
    unknown = [name for name in names if name not in made]
    if unknown:
        raise typer.BadParameter(f"no problem {unknown[0]!r}. There are: {', '.join(made)}.")
    for name in names:
        if made[name].solver == "Rodas5P":
            made[name] = made[name]._replace(solver=solver)
    for name, title in PEERS.items():
        if not quick and name not in installed():
            console.print(f"{title}: skipped. It needs {name}: `pip install '.\\[peers]'`")
    every = _rows_in(json) if problems else {}
    for name in names:
        every[name] = measure(name, made[name], repeats, quick)
        print_table(console, [every[name]])
        rows = [every[name] for name in made if name in every]
        if json is not None:
            content = {
                "environment": environment("scikit-sundae", "scipy_dae", "casadi"),
                "problems": [dataclasses.asdict(row) for row in rows],
            }
            write_json(json, content)
    if len(rows) > 1:
        print_table(console, rows)
    if plot is not None:
        draw(rows, plot)


if __name__ == "__main__":
    typer.run(main)
