"""Where the time to compile goes: kernels of a program and operations in them, by source line.

`python -m benchmarks.speed.compile_profile four-bar --gradient`

XLA for CPUs turns a program into kernels (fused operations) and compiles each. The seconds grow with their number,
and with the operations in them: a product that several kernels need is in each of them. A loop of small arrays is one
kernel with JAX 0.12, and takes more than twice as long for twice the operations. The programs are those of
`benchmarks.speed.compile_time`.
"""

import re
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import typer
from rich.table import Table

from ..tools.measure import (
    environment,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)
from .compile_time import cases, programs


PACKAGE = "manifold_jax/"


class Kernel(NamedTuple):
    """One kernel: the computation it belongs to, its operations, and the source line of its result."""

    computation: str
    operations: int
    line: str


def computations(text: str) -> dict[str, list[str]]:
    """Return the lines of every computation of a compiled program."""
    found: dict[str, list[str]] = {}
    name = None
    for line in text.splitlines():
        if begin := re.match(r"(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            name = begin.group(1)
            found[name] = []
        elif line.startswith("}"):
            name = None
        elif name is not None:
            found[name].append(line)
    return found


class SourceLines:
    """The source lines of operations, which JAX 0.12 keeps in tables at the start of the program."""

    def __init__(self, text: str):
        self.tables: dict[str, dict[int, str]] = {}
        for part in text.split("\n\n"):
            title, *rows = part.strip().splitlines() or [""]
            if title in ("FileNames", "FileLocations", "StackFrames"):
                pairs = (row.split(" ", 1) for row in rows)
                self.tables[title] = {int(number): value for number, value in pairs}

    def of(self, operation: str) -> str:
        """Return the innermost line of this library, of a problem or of a user."""
        if old := re.search(r'source_file="([^"]*)" source_line=(\d+)', operation):
            return f"{_short(old.group(1))}:{old.group(2)}"
        frame = re.search(r"stack_frame_id=(\d+)", operation)
        number = int(frame.group(1)) if frame else 0
        while number:
            row = self.tables["StackFrames"][number]
            location = self.tables["FileLocations"][_field(row, "file_location_id")]
            file = self.tables["FileNames"][_field(location, "file_name_id")].strip('"')
            if PACKAGE in file and "_base" not in file:
                return f"{_short(file)}:{_field(location, 'line')}"
            parent = _field(row, "parent_frame_id")
            number = 0 if parent == number else parent
        return "not known"


def _field(row: str, name: str) -> int:
    found = re.search(rf"{name}=(\d+)", row)
    return int(found.group(1)) if found else 0


def _short(file: str) -> str:
    return file.rsplit(PACKAGE, 1)[-1]


def kernels(text: str) -> list[Kernel]:
    parts, sources, found = computations(text), SourceLines(text), []
    for name, lines in parts.items():
        for line in lines:
            if called := re.search(r" fusion\(.*calls=%?([\w.\-]+)", line):
                inner = parts[called.group(1)]
                operations = sum(not re.search(r" (parameter|constant)\(", x) for x in inner)
                found.append(Kernel(name, operations, sources.of(line)))
    return found


def table_of(found: list[Kernel], title: str, key: str, most: int) -> Table:
    count = Counter(getattr(kernel, key) for kernel in found)
    operations = Counter[str]()
    for kernel in found:
        operations[getattr(kernel, key)] += kernel.operations
    table = Table(title=title, title_justify="left")
    table.add_column(key, overflow="fold")
    for heading in ("kernels", "operations"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, number in count.most_common(most):
        table.add_row(name, str(number), str(operations[name]))
    return table


def main(
    problem: Annotated[str, typer.Argument(help="A problem of benchmarks.speed.compile_time.")],
    gradient: Annotated[bool, typer.Option(help="Of the gradient, not of the solve.")] = False,
    plain: Annotated[bool, typer.Option(help="Of Diffrax alone.")] = False,
    most: Annotated[int, typer.Option(min=1, help="Rows of each table.")] = 20,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
) -> None:
    """Print what the compiled program of one solve consists of."""
    use_one_core()
    use_double_precision()
    known = cases()
    if problem not in known:
        raise typer.BadParameter(f"{problem!r} is none of {', '.join(known)}.")
    name = ("plain" if plain else "projected") + (" gradient" if gradient else "")
    start = time.process_time()
    traced = jax.jit(programs(known[problem])[name]).trace(known[problem].args)
    middle = time.process_time()
    compiled = traced.lower().compile().as_text() or ""
    end = time.process_time()
    found = kernels(compiled)
    console = make_console()
    console.print(f"{problem}, {name}: trace {middle - start:.2f} s, compile {end - middle:.2f} s")
    console.print(f"{len(found)} kernels, {sum(k.operations for k in found)} operations in them")
    console.print(table_of(found, "By part: `main`, and the bodies of loops", "computation", most))
    console.print(table_of(found, "By source line of the result", "line", most))
    if json is not None:
        seconds = dict(trace=middle - start, compile=end - middle)
        result = dict(problem=problem, program=name, seconds=seconds, kernels=found)
        write_json(json, dict(environment=environment(), **result))


if __name__ == "__main__":
    typer.run(main)
