"""The consoles of the command line, and tables that fit them."""

from collections.abc import Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table


def output_console() -> Console:
    """Return standard output; wide enough for the tables if it is a file or a pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=120)


def progress_bar() -> Progress:
    """Show what is being done, on standard error and only if that is a terminal."""
    console = Console(stderr=True)
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def print_lines(output: Console, lines: Iterable[str], **options: Any) -> None:
    """Print texts as they are, each on its own line, with options such as a `style`."""
    for line in lines:
        output.print(line, highlight=False, markup=False, **options)


def print_table(output: Console, table: Table) -> None:
    """Print a table without cutting anything, whatever the width.

    If there is little space its columns move together, and then it is printed in parts, each with the
    first column. Only columns of text, which have a `min_width`, are wrapped. A blank line follows.
    """
    name, *others = table.columns
    for gap in (3, 1):
        if _width(output, table.columns, gap) <= output.width:
            output.print(_part(table.columns, gap), "")
            return
    while others:
        count = len(others)
        while count > 1 and _width(output, [name, *others[:count]], gap) > output.width:
            count -= 1
        output.print(_part([name, *others[:count]], gap), "")
        others = others[count:]


def _width(output: Console, columns: Sequence[Column], gap: int) -> int:
    """Return the smallest width that cuts nothing."""
    whole = output.options.update(max_width=1000)
    return gap * (len(columns) - 1) + sum(
        column.min_width
        or max(
            output.measure(cell, options=whole).maximum for cell in (column.header, *column.cells)
        )
        for column in columns
    )


def _part(columns: Sequence[Column], gap: int) -> Table:
    part = Table(box=box.SIMPLE, show_edge=False, pad_edge=False, padding=(0, (gap - 1) // 2))
    for column in columns:
        text = column.min_width is not None
        part.add_column(
            column.header, justify=column.justify, min_width=column.min_width, no_wrap=not text
        )
    for cells in zip(*(column.cells for column in columns), strict=True):
        part.add_row(*cells)
    return part
