"""All problems together: every approach relative to the plain solver."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from ._approach_results import Row


# At larger tolerances than this the plain solver has hardly any digit right.
LARGEST_TOLERANCE = 1e-4
# Errors between which curves of time over error are compared.
ERRORS = (1e-9, 1e-2)


def summary_table(rows: Sequence[Row]) -> Table:
    """Medians over problems and tolerances, and their range; ratios are to the plain solver."""
    title = f"All problems, tolerances up to {LARGEST_TOLERANCE:g}: median (range) of the cases"
    table = Table(title=title, title_justify="left")
    table.add_column("method", no_wrap=True)
    headings = (
        "cases",
        "time / plain",
        "error / plain",
        "smaller",
        "max |g|",
        "max |g| / tolerance",
    )
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    used = [r for r in rows if r.tolerance <= 1.001 * LARGEST_TOLERANCE and r.failure is None]
    plain = {(row.problem, row.tolerance): row for row in used if row.method == "plain"}
    for method in dict.fromkeys(row.method for row in used):
        pairs = [
            (row, plain[row.problem, row.tolerance])
            for row in used
            if row.method == method and (row.problem, row.tolerance) in plain
        ]
        if pairs:
            table.add_row(method, *_summary_cells(pairs))
    return table


def _summary_cells(pairs: Sequence[tuple[Row, Row]]) -> list[str]:
    times = np.array([row.median_ms / plain.median_ms for row, plain in pairs])
    errors = np.array([row.error / plain.error for row, plain in pairs])
    violations = np.array([row.violation_output for row, _ in pairs])
    scaled = violations / np.array([row.tolerance for row, _ in pairs])
    return [
        str(len(pairs)),
        f"{np.median(times):.2f} ({times.min():.2f}-{times.max():.2f})",
        f"{np.median(errors):.2f}",
        str(np.sum(errors < 1)),
        f"{violations.max():.0e}",
        f"{scaled.min():.2g} to {scaled.max():.2g}",
    ]


def equal_error_table(rows: Sequence[Row]) -> Table:
    """Time for the same error: the curves of the picture, one divided by the plain one."""
    found = [row for row in rows if row.failure is None]
    problems = list(dict.fromkeys(row.problem for row in found))
    table = Table(title="Time for the same error / plain: median (range)", title_justify="left")
    table.add_column("method", no_wrap=True)
    for problem in problems:
        table.add_column(problem, justify="right", no_wrap=True)
    curves = {(row.problem, row.method): _curve(found, row.problem, row.method) for row in found}
    for method in dict.fromkeys(row.method for row in found if row.method != "plain"):
        table.add_row(method, *(_equal_error_cell(curves, p, method) for p in problems))
    return table


def _curve(rows: Sequence[Row], problem: str, method: str) -> np.ndarray:
    """Logarithms of error and time, shape `(2, tolerances)`, in the order of the errors."""
    own = [row for row in rows if (row.problem, row.method) == (problem, method)]
    return np.log(sorted((row.error, row.median_ms) for row in own)).T


def _equal_error_cell(
    curves: Mapping[tuple[str, str], np.ndarray], problem: str, method: str
) -> str:
    if (problem, method) not in curves or (problem, "plain") not in curves:
        return "-"
    plain, own = curves[problem, "plain"], curves[problem, method]
    low = max(plain[0].min(), own[0].min(), np.log(ERRORS[0]))
    high = min(plain[0].max(), own[0].max(), np.log(ERRORS[1]))
    if low >= high:
        return "-"
    errors = np.linspace(low, high, 40)
    ratios = np.exp(np.interp(errors, *own) - np.interp(errors, *plain))
    return f"{np.median(ratios):.2f} ({ratios.min():.2f}-{ratios.max():.2f})"
