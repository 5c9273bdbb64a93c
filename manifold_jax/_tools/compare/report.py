"""Tables for the terminal and files for programs."""

import inspect
import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.flatten_util as jfu
import numpy as np
import scipy
from rich.markup import escape
from rich.table import Column, Table

from ... import __version__
from ...problems import Problem
from .approaches import known_approaches
from .methods import Measurement, Method
from .task import OUTPUT_POINTS, Task


def number_columns(headings: Iterable[str]) -> list[Column]:
    return [Column(heading, justify="right") for heading in headings]


def format_number(value: int | float | str | None, form: str) -> str:
    """Format a number in a table, in which a word may stand instead, and `-` for unknown ones.
    Where `form` asks for three digits, larger numbers have all before the point."""
    if isinstance(value, str):
        return value
    if value is None:
        return "-"
    return format(value, ".0f" if form == ".3g" and value >= 100 else form)


def sizes(problem: Problem) -> tuple[int, int]:
    """Return the number of states and the number of constraints, `n` and `m`."""
    flat = lambda y: jfu.ravel_pytree(problem.constraint(problem.t0, y, problem.args))[0]
    return jfu.ravel_pytree(problem.y0)[0].size, jax.eval_shape(flat, problem.y0).size


def gallery_table(gallery: dict[str, Callable[[], Problem]]) -> Table:
    wrapped = Column("description", min_width=20)  # no other one is
    table = Table("name", *number_columns(["n", "m"]), "time span", "solution", wrapped)
    for name, build in gallery.items():
        problem = build()
        table.add_row(
            name,
            *map(str, sizes(problem)),
            f"{problem.t0:.4g} to {problem.t1:.4g}",
            "at the end" if problem.reference_at_end_only else "all times",
            escape(summary(build)),
        )
    return table


def summary(build: Callable[[], Problem]) -> str:
    """Describe a problem in one line: the beginning of its docstring, without mathematics."""
    paragraph = (inspect.getdoc(build) or "").partition("\n\n")[0]
    text = " ".join(paragraph.split())
    return re.split(r"[,:.]( |$)", text, maxsplit=1)[0].replace("$", "")


def comparison_title(task: Task) -> str:
    span = f"t = {task.t0:g} to {task.t1:g}"
    return f"{task.problem.name}, {task.solver}, {span}, rtol = {task.rtol:g}, atol = {task.atol:g}"


# Headings that fit in a terminal of 80 columns; then the attribute of a row, and its format.
_COLUMNS = {
    "steps\naccepted": ("accepted", "d"),
    "\nrejected": ("rejected", "d"),
    "field\ncalls": ("evaluations", "d"),
    "|g| at\nsteps": ("violation_steps", ".1e"),
    "|g| at\noutput": ("violation_output", ".1e"),
    "error of\nstate": ("error", ".1e"),
    "run\n(ms)": ("run_ms", ".3g"),
    "compile\n(s)": ("compile_s", ".2f"),
}


def comparison_table(measurements: Sequence[Measurement]) -> Table:
    table = Table("method", *number_columns(_COLUMNS))
    for measurement in measurements:
        numbers = vars(measurement.row)
        if measurement.failure is not None:
            numbers = numbers | {"error": "failed"}
        cells = [format_number(numbers[name], form) for name, form in _COLUMNS.values()]
        table.add_row(measurement.key, *cells)
    return table


def comparison_notes(
    task: Task, measurements: Sequence[Measurement], left_out: Sequence[Method]
) -> list[str]:
    """Return the notes below the table that explain it."""
    if task.reference() is None:
        known = "is not known for this time span (without --t1 it is)"
    elif task.problem.reference_at_end_only:
        known = f"is known at t = {task.t1:g} only: error there"
    else:
        known = "is known"
    failures = [f"{m.key} failed: {m.failure}." for m in measurements if m.failure is not None]
    notes = [
        *failures,
        f"Largest |g| and error; output at {OUTPUT_POINTS} times; the solution {known}.",
        "Run: median, output included. SciPy calls the compiled field from Python and does not "
        "report rejected steps.",
    ]
    with_gain = {approach.name for approach in known_approaches() if approach.uses_gain}
    stabilized = [m.key for m in measurements if m.key in with_gain]
    if stabilized:
        notes.append(
            f"Stabilization ({', '.join(stabilized)}) with gain {task.gain:.3g} per unit of time; "
            "its states are returned uncorrected."
        )
    for method in left_out:
        notes.append(f"Left out: {method.key}, which {method.needs}.")
    limit = max_steps(measurements)
    return notes if limit is None else [*notes, f"Step limit chosen for Diffrax: {limit}."]


def max_steps(measurements: Sequence[Measurement]) -> int | None:
    """Return the largest limit that a solve needed."""
    limits = [m.max_steps for m in measurements if m.max_steps is not None]
    return max(limits, default=None)


def write_json(
    path: Path, task: Task, measurements: Sequence[Measurement], left_out: Sequence[Method]
) -> None:
    """Write everything in the table and how it was made. Unknown numbers are null."""
    n, m = sizes(task.problem)
    settings = {
        **{name: getattr(task, name) for name in ("solver", "rtol", "atol", "gain", "t0", "t1")},
        "output_points": OUTPUT_POINTS,
        "max_steps": max_steps(measurements),
        "states": n,
        "constraints": m,
        "device": jax.devices()[0].device_kind,
        "versions": {
            "manifold_jax": __version__,
            **{module.__name__: module.__version__ for module in (diffrax, jax, np, scipy)},
        },
        "failures": {m.row.method: m.failure for m in measurements if m.failure is not None},
        "left_out": {method.name(task): str(method.needs) for method in left_out},
    }
    rows = [vars(measurement.row) for measurement in measurements]
    content = {"problem": task.problem.name, "settings": settings, "rows": rows}
    write_strict_json(path, content)


def write_strict_json(path: Path, content: dict[str, Any]) -> None:
    """Write null for numbers that JSON does not have, NaN and infinity."""
    path.write_text(json.dumps(_strict(content), indent=2, allow_nan=False) + "\n")


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
