"""The certificate as tables and as JSON."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from ..compare.approaches import Approach
from ..compare.report import format_number, number_columns, write_strict_json
from .checks import ADJOINTS, Check, Combination, ONCE, REFUSED


# Bounds that a correct gradient satisfies.
REVERSE_BOUND, DIFFERENCES_BOUND = 1e-10, 1e-7


def certificate_title(combination: Combination) -> str:
    outcome = combination.failure or f"{combination.steps} steps"
    return f"{combination.approach}, {combination.solver}: {outcome}"


def certificate_table(combination: Combination) -> Table:
    """Return the table of the adjoints of one approach and solver."""
    hessian = any(check.hessian is not None for check in combination.checks)
    headings = ["gradient", "batch", *(["Hessian"] if hessian else ())]
    headings += ["run\n(ms)", "compile\n(s)", "memory\n(kB)"]
    table = Table("adjoint", *number_columns(headings))
    for check in combination.checks:
        if check.refused is not None:
            table.add_row(check.adjoint, "refused")
            continue
        table.add_row(
            check.adjoint,
            format_number(check.difference, ".1e"),
            format_number(check.batch, ".1e"),
            *([format_number(check.hessian, ".1e")] if hessian else ()),
            format_number(check.run_ms, ".2f"),
            format_number(check.compile_s, ".1f"),
            format_number(None if check.memory is None else check.memory / 1e3, ".0f"),
        )
    return table


def certificate_notes(combination: Combination) -> list[str]:
    """Return the other results, and the verdict."""
    exact = "not known" if combination.exact is None else combination.exact
    found = (
        f"Forward mode: {format_number(combination.differences, '.1e')} from finite differences with "
        f"the same steps; gradient of the exact solution: {format_number(exact, '.1e')}; "
        f"sensitivities from tangent: {format_number(combination.tangency, '.1e')}."
    )
    faults = faults_of(combination)
    verdict = f"NOT CERTIFIED: {'; '.join(faults)}." if faults else "Certified."
    return [verdict] if combination.failure is not None else [found, verdict]


def certificate_scope(
    combinations: Sequence[Combination], missing: Sequence[str], left_out: Sequence[Approach]
) -> list[str]:
    """Explain how to read the certificate, and what it does not cover: the `missing` methods and other
    options; those `left_out` cannot solve the problem."""
    checks = [check for combination in combinations for check in combination.checks]
    done = {"forward", *(check.adjoint for check in checks)}
    adjoints = [name for name in ADJOINTS if name not in done]
    solvers = ", ".join(dict.fromkeys(combination.solver for combination in combinations))
    silent = [
        *([f"methods {', '.join(missing)}"] if missing else ()),
        *([f"adjoints {', '.join(adjoints)}"] if adjoints else ()),
        *(["Hessian-vector products"] if all(c.hessian is None for c in checks) else ()),
        f"solvers other than {solvers}",
        "other tolerances",
    ]
    return [
        "Adjoints: largest relative difference from forward mode, steps chosen anew in each solve; "
        "batch: vmap for two sets of parameters.",
        *(f"Left out: {each.name}, which {each.needs}." for each in left_out),
        f"Not covered: {'; '.join(silent)}.",
    ]


def faults_of(combination: Combination) -> list[str]:
    """Return the gradients that do not agree as well as they should, and adjoints that are wrongly
    refused or wrongly accepted."""
    if combination.failure is not None or combination.differences is None:
        return [combination.failure or "nothing was compared"]
    faults = [fault for check in combination.checks for fault in _faults_of_adjoint(check)]
    if not combination.differences <= DIFFERENCES_BOUND:
        faults.append(_exceeds("differences", combination.differences, DIFFERENCES_BOUND))
    return faults


def _faults_of_adjoint(check: Check) -> list[str]:
    if check.adjoint == REFUSED:
        return [] if check.refused is not None else [f"{check.adjoint} was not refused"]
    if check.refused is not None:
        return [f"{check.adjoint} was refused ({check.refused})"]
    values = {"gradient": check.difference, "batch": check.batch}
    if check.hessian == "refused":
        if check.adjoint != ONCE:
            return [f"Hessian-vector products of {check.adjoint} were refused"]
    elif check.hessian is not None:
        values["Hessian"] = check.hessian
    return [
        _exceeds(f"{check.adjoint}, {name}", value, REVERSE_BOUND)
        for name, value in values.items()
        if value is None or not value <= REVERSE_BOUND
    ]


def _exceeds(name: str, value: float | None, bound: float) -> str:
    return f"{name}: {format_number(value, '.1e')} is not within {bound:g}"


def is_certified(combination: Combination) -> bool:
    return not faults_of(combination)


def write_json(path: Path, settings: dict[str, Any], combinations: Sequence[Combination]) -> None:
    rows = [dataclasses.asdict(c) | {"certified": is_certified(c)} for c in combinations]
    write_strict_json(path, {"settings": settings, "rows": rows})
