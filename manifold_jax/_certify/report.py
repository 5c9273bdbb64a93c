"""The certificate as a table and as JSON."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from .checks import Check, Combination, ONCE, REFUSED


# What a correct gradient satisfies.
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
        "refused" if check.hessian is None else f"{check.hessian:.1e}",
        _number(check.batch, ".1e"),
        _number(check.run_ms, ".2f"),
        _number(check.compile_s, ".1f"),
        _number(None if check.memory is None else check.memory / 1e3, ".0f"),
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def is_certified(combination: Combination) -> bool:
    """Whether all gradients agree as well as they should, and only that is refused which has
    to be."""
    if combination.failure is not None or combination.differences is None:
        return False
    return combination.differences <= DIFFERENCES_BOUND and all(map(_agrees, combination.checks))


def _agrees(check: Check) -> bool:
    if check.adjoint == REFUSED or check.refused is not None:
        return check.adjoint == REFUSED and check.refused is not None
    hessian = 0.0 if check.adjoint == ONCE and check.hessian is None else check.hessian
    values = (check.difference, check.batch, hessian)
    return all(value is not None and value <= REVERSE_BOUND for value in values)


def write_json(path: Path, settings: dict[str, Any], combinations: Sequence[Combination]) -> None:
    rows = [dataclasses.asdict(c) | {"certified": is_certified(c)} for c in combinations]
    path.write_text(json.dumps({"settings": settings, "rows": rows}, indent=2) + "\n")
