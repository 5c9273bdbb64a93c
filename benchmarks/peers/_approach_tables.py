"""Tables of `benchmarks.peers.approaches`."""

from collections.abc import Mapping, Sequence

from rich.markup import escape
from rich.table import Table

from ..tools.cost import Cost
from ..tools.measure import milliseconds, number
from ._approach_results import Row, Setting


def cost_table(name: str, setting: Setting, rows: Sequence[Row], tolerance: float) -> Table:
    """Evaluations per step, accepted or not, as counted at one tolerance and as predicted."""
    table = Table(
        title=f"{name} (n = {setting.n}, m = {setting.m}): cost of a step at {tolerance:.0e}, "
        "counted / predicted",
        title_justify="left",
    )
    table.add_column("method", no_wrap=True)
    for heading in (
        "steps\naccepted",
        "\nrejected",
        "\nf",
        "\ng",
        "velocity\nresidual",
        "Jacobian\nG",
        "flops\n(predicted)",
        "compile\n(s)",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        if row.tolerance == tolerance and row.failure is None and row.attempts is not None:
            predicted = setting.predicted[row.method]
            compile_s = number(setting.compile_s[row.method], ".1f")
            table.add_row(row.method, *_cost_cells(row, predicted), compile_s)
    return table


def _cost_cells(row: Row, predicted: Cost | None) -> list[str]:
    per_step = {name: getattr(row, name) / row.attempts for name in ("f", "g", "velocity", "G")}
    expected = lambda name: "-" if predicted is None else f"{getattr(predicted, name):g}"
    return [
        str(row.accepted),
        str(row.rejected),
        f"{per_step['f']:.1f} / {expected('f')}",
        f"{per_step['g']:.1f} / {expected('g')}",
        f"{per_step['velocity']:.1f}",
        f"{per_step['G']:.1f} / {expected('G')}",
        "-" if predicted is None else f"{predicted.flops:.0f}",
    ]


def accuracy_table(name: str, rows: Sequence[Row], tolerances: Sequence[float]) -> Table:
    """Error, violation and run time of each method, a group of columns for each tolerance."""
    table = Table(title=f"{name}: error, max |g|, run ms", title_justify="left")
    table.add_column("method", no_wrap=True)
    for tolerance in tolerances:
        table.add_column(f"{tolerance:.0e}", justify="right", no_wrap=True)
    found: Mapping = {(row.method, row.tolerance): row for row in rows}
    for method in dict.fromkeys(row.method for row in rows):
        cells = [_accuracy_cell(found.get((method, tolerance))) for tolerance in tolerances]
        table.add_row(method, *cells)
    return table


def _accuracy_cell(row: Row | None) -> str:
    if row is None:
        return "-"
    if row.failure is not None:
        return "[red]failed[/red]"
    violation, error = number(row.violation_output, ".0e"), number(row.error, ".0e")
    return f"{error} {violation} {milliseconds(row.median_ms):>5}"


def failures(rows: Sequence[Row]) -> list[str]:
    return [
        f"{row.problem}, {row.method}, {row.tolerance:.0e}: {escape(row.failure)}"
        for row in rows
        if row.failure is not None
    ]
