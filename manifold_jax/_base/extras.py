"""Packages of optional extras, and a progress bar on terminals for users who have rich."""

import importlib.util
from typing import Any


class NoBar:
    """A stand-in for a progress bar: prints lines, or nothing."""

    def add_task(self, *_: Any, **__: Any) -> int:
        return 0

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def update(self, *_: Any, **__: Any) -> None:
        pass

    def reset(self, *_: Any, **__: Any) -> None:
        pass


def terminal_bar(shown: bool, text: str, remaining: bool = False) -> Any:
    """Return a `rich.progress.Progress` with a description, a bar, `text`, and the elapsed and
    remaining time if the output is a terminal and rich is installed, else a [`NoBar`][]."""
    try:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
    except ImportError:
        return NoBar()
    console = Console()
    if not (shown and console.is_interactive):
        return NoBar()
    columns = [TextColumn("{task.description}"), BarColumn(), TextColumn(text), TimeElapsedColumn()]
    if remaining:
        columns.append(TimeRemainingColumn())
    return Progress(*columns, console=console)


def print_line(bar: Any, text: str) -> None:
    """Print a line, above the bar if there is one."""
    if isinstance(bar, NoBar):
        print(text, flush=True)
    else:
        bar.console.print(text, soft_wrap=True, markup=False, highlight=False)


def require(module: str, extra: str, what: str) -> None:
    """Raise an error that says what to install if `module` is missing."""
    if importlib.util.find_spec(module) is None:
        raise ImportError(
            f"{what} needs {module}, which is not installed: `pip install {module}`, or install "
            f'`"manifold_jax[{extra}]"`.'
        )
