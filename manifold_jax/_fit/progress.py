"""Progress of a fit: a bar on a terminal, lines in a file, a pipe or a notebook."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from .._base.extras import NoBar, print_line, terminal_bar


class FitMeter:
    """A progress meter, silent unless `shown`.

    Lines of steps are at least a second and a tenth of the elapsed time apart.
    """

    def __init__(self, shown: bool):
        self.shown, self.bar = shown, terminal_bar(shown, "{task.fields[loss]}")
        self.in_lines = shown and isinstance(self.bar, NoBar)
        self.task = self.bar.add_task("fit", total=None, loss="")
        self.known: set[str] = set()
        self.name, self.listed, self.count, self.steps = "fit", False, 0, 0
        self.begun = self.last = time.perf_counter()

    def __enter__(self) -> "FitMeter":
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()

    @contextmanager
    def compiling(self, what: str) -> Iterator[None]:
        """Report the time of the first use of a program; later ones are not reported."""
        if what in self.known:
            yield
            return
        self.known.add(what)
        begun, text = time.perf_counter(), f"fit: compiling {what}"
        self.bar.update(self.task, description=text, refresh=True)
        self._line(text, self.in_lines)
        yield
        self._line(f"fit: compiled in {time.perf_counter() - begun:.1f} s", self.in_lines)
        self.bar.update(self.task, description=self.name)

    def begin(self, name: str, steps: int, listed: bool = False) -> None:
        """Begin a run of steps; `listed`: whether its end stays on a terminal, too."""
        self.name, self.steps, self.listed, self.count = name, steps, listed, 0
        self.bar.reset(self.task, total=steps, description=name, loss="")

    def advance(self, loss: float) -> None:
        self.count += 1
        self.bar.update(self.task, advance=1, loss=f"loss {loss:.6g}")
        now = time.perf_counter()
        if now - self.last >= max(1.0, 0.1 * (now - self.begun)):
            self.last = now
            text = f"{self.name}: step {self.count}, loss {loss:.6g}, {now - self.begun:.0f} s"
            self._line(text, self.in_lines)

    def end(self, loss: float, message: str) -> None:
        self.bar.update(self.task, completed=self.steps, refresh=True)
        text = f"{self.name}: {message}, {self.count} steps, loss {loss:.6g}"
        self._line(text, self.in_lines or (self.shown and self.listed))

    def _line(self, text: str, wanted: bool) -> None:
        if wanted:
            print_line(self.bar, text)
