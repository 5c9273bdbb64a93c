"""Progress of a long run: a bar on a terminal, lines in a file, a pipe or a notebook."""

import time

from ..._base.extras import NoBar, print_line, terminal_bar


class ChunkMeter:
    """Silent unless `shown`. Lines are at least a second and a tenth of the elapsed time apart."""

    def __init__(self, size: int, finished: int, failed: int, shown: bool):
        self.size = size
        self.finished, self.begun_at, self.failed = finished, finished, failed
        text = "{task.completed:.0f} of {task.total:.0f}{task.fields[rate]}"
        self.bar = terminal_bar(shown, text, remaining=True)
        self.in_lines = shown and isinstance(self.bar, NoBar)
        self.task = self.bar.add_task("ensemble", total=size, completed=finished, rate="")
        self.begun = self.last = time.perf_counter()

    def __enter__(self) -> "ChunkMeter":
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()

    def compiling(self) -> None:
        self.bar.update(self.task, description="ensemble: compiling", refresh=True)
        self._line("ensemble: compiling")

    def begin(self) -> None:
        self.begun = self.last = time.perf_counter()
        self.bar.update(self.task, description="ensemble", refresh=True)

    def advance(self, count: int, failed: int) -> None:
        self.finished += count
        self.failed += failed
        now = time.perf_counter()
        rate = (self.finished - self.begun_at) / max(now - self.begun, 1e-9)
        text = f", {rate:.0f}/s, {self.failed} failed"
        self.bar.update(self.task, completed=self.finished, rate=text)
        due = now - self.last >= max(1.0, 0.1 * (now - self.begun))
        if due or self.finished == self.size:
            self.last = now
            self._line(f"ensemble: {self.finished} of {self.size}{text}")

    def _line(self, text: str) -> None:
        if self.in_lines:
            print_line(self.bar, text)
