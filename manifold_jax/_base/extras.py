"""Packages that only an extra of this one installs, and a bar on a terminal for those who have rich."""

import importlib.util
from typing import Any


class NoBar:
    """A stand-in for a bar, where lines are printed or nothing is."""

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
    """A `rich.progress.Progress` with a description, a bar, `text` and the time gone by (and that
    which remains) if the output is a terminal and rich is installed, else a [`NoBar`][]."""
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
    """A line of its own, above the bar if there is one."""
    if isinstance(bar, NoBar):
        print(text, flush=True)
    else:
        bar.console.print(text, soft_wrap=True, markup=False, highlight=False)


def require(module: str, extra: str, what: str) -> None:
    """Raise with what to install where `module` is missing."""
    if importlib.util.find_spec(module) is None:
        raise ImportError(
            f"{what} needs {module}, which is not installed: `pip install {module}`, or install "
            f'`"manifold_jax[{extra}]"`.'
        )
