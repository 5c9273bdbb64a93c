"""Where the command line writes."""

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


def output_console() -> Console:
    """Standard output; wide enough for the tables if it is a file or a pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=120)


def progress_bar() -> Progress:
    """What is being done, on standard error and only if that is a terminal."""
    console = Console(stderr=True)
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
