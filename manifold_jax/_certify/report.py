"""The certificate as a table and as JSON."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from .checks import Check, Combination


# What a correct gradient satisfies, as printed below the table.
REVERSE_BOUND, DIFFERENCES_BOUND = 1e-10, 1e-7


def certificate_table(combinations: Sequence[Combination]) -> Table:
    table = Table(title="relative difference from forward mode", title_justify="left")
    for name in ("approach", "solver", "gradient"):
        table.add_column(name)
    for name in ("difference", "Hessian", "batch", "ms", "compile s", "memory kB"):
        table.add_column(name, justify="right")
    for combination in combinations:
        names = combination.approach, combination.solver
        if combination.failure is not None:
            table.add_row(*names, combination.failure)
            continue
        cost = _number(combination.value_ms, ".2f")
        table.add_row(*names, f"solve, {combination.steps} steps", "", "", "", cost)
        for check in combination.checks:
            table.add_row("", "", *_cells(check))
        for name in ("differences", "exact", "tangency"):
            table.add_row("", "", name, _number(getattr(combination, name), ".1e"))
        table.add_section()
    return table


def _cells(check: Check) -> list[str]:
    if check.refused is not None:
        return [check.adjoint, "refused"]
    return [
        check.adjoint,
        _number(check.difference, ".1e"),
        _number(check.hessian, ".1e"),
        _number(check.batch, ".1e"),
        _number(check.run_ms, ".2f"),
        _number(check.compile_s, ".1f"),
        _number(None if check.memory is None else check.memory / 1e3, ".0f"),
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def is_certified(combination: Combination) -> bool:
    """Whether all gradients agree as well as they should."""
    found = [c.difference for c in combination.checks if c.difference is not None]
    found += [c.batch for c in combination.checks if c.batch is not None]
    found += [c.hessian for c in combination.checks if c.hessian is not None]
    agree = all(value <= REVERSE_BOUND for value in found)
    return (
        agree
        and combination.differences is not None
        and (combination.differences <= DIFFERENCES_BOUND)
    )


def write_json(path: Path, settings: dict[str, Any], combinations: Sequence[Combination]) -> None:
    rows = [dataclasses.asdict(c) | {"certified": is_certified(c)} for c in combinations]
    path.write_text(json.dumps({"settings": settings, "rows": rows}, indent=2) + "\n")
