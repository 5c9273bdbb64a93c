"""Random problems, methods and outputs against NumPy and SciPy: is anything silently wrong?

`python -m tests.fuzz --structures 100 --draws 100 --json FILE`

A *structure* is what is compiled once: a random family of constraints and fields, a layout of the
state, a solver, a controller, what is saved, the direction of time, the approach, an adjoint. Its
*draws* are the lanes of one batch, with other parameters and starts each, one of which is made to
fail. `--only INDEX` runs one structure of the same seed again.

`--kind dae` reduces random differential-algebraic equations with `manifold_jax.reduce_dae`;
`--kind store` damages stored ensembles at random, one copy for each draw;
`--kind reset` solves random equations with jumps of the state at random events.
"""

import collections
import enum
import json as json_module
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, Queue
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.tools.measure import make_console

from .structure import structure
from .worker import DRAWN


# Structures of one process, which keeps what it has compiled.
PER_PROCESS = 10

Record = dict[str, Any]


class Kind(enum.StrEnum):
    """What is tried."""

    SOLVE = "solve"
    DAE = "dae"
    STORE = "store"
    RESET = "reset"


def run(
    indices: list[int], seed: int, draws: int, limit: float, kind: str = "solve"
) -> Iterator[Record]:
    """What is found, structure by structure. A process that takes longer than `limit` seconds for
    one, or that dies, is a fault; the next one goes on after it."""
    rest = list(indices)
    while rest:
        for record in _in_one_process(rest[:PER_PROCESS], seed, draws, limit, kind):
            rest.remove(record["index"])
            yield record


def _in_one_process(
    indices: list[int], seed: int, draws: int, limit: float, kind: str
) -> Iterator[Record]:
    command = [sys.executable, "-m", "tests.fuzz.worker", kind, str(seed), str(draws)]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command + [str(i) for i in indices], stdout=subprocess.PIPE, stderr=errors, text=True
        )
        lines: Queue[str] = Queue()
        reader = threading.Thread(target=_read, args=(process, lines), daemon=True)
        reader.start()
        started = time.perf_counter()
        try:
            for i in indices:
                try:
                    line = lines.get(timeout=limit)
                except Empty:
                    yield _lost(i, seed, kind, "hang", f"no answer in {limit:.0f} s", started)
                    return
                if not line:
                    errors.seek(0)
                    last = errors.read().strip().splitlines()[-1:]
                    text = f"the process ended with {process.wait()}: {''.join(last)[:300]}"
                    yield _lost(i, seed, kind, "crash", text, started)
                    return
                yield json_module.loads(line)
                started = time.perf_counter()
        finally:
            process.kill()
            process.wait()
            reader.join()
            process.stdout.close()


def _read(process: subprocess.Popen, lines: Queue) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("{"):
            lines.put(line)
    lines.put("")


def _lost(index: int, seed: int, kind: str, fault: str, message: str, started: float) -> Record:
    return {
        "index": index,
        "seed": seed,
        "spec": DRAWN[kind](index, seed).spec,
        "seconds": round(time.perf_counter() - started, 1),
        "faults": [{"kind": fault, "message": message}],
    }


def show(console: Console, record: Record) -> None:
    faults = record["faults"]
    verdict = "[red]FAULT[/red]" if faults else "skipped" if "skipped" in record else "ok"
    numbers = "  ".join(
        f"{name} {record[name]:.1e}"
        for name in ("violation", "error", "single", "reverse", "differences")
        if name in record
    )
    console.print(f"{record['index']:4d} {verdict:8s} {record['seconds']:6.1f} s  {record['spec']}")
    console.print(f"     [dim]{numbers or record.get('skipped', '')}[/dim]")
    for fault in faults:
        console.print(f"     [red]{fault['kind']}[/red]: {fault['message']}", markup=True)


def summary(records: list[Record]) -> Table:
    """Faults by kind."""
    table = Table(title="Faults by kind", title_justify="left")
    for heading in ("kind", "structures", "which"):
        table.add_column(heading)
    kinds: dict[str, list[int]] = collections.defaultdict(list)
    for record in records:
        for kind in {fault["kind"] for fault in record["faults"]}:
            kinds[kind].append(record["index"])
    for kind, indices in sorted(kinds.items()):
        table.add_row(kind, str(len(indices)), " ".join(map(str, indices)))
    return table


def coverage(records: list[Record]) -> Table:
    """How many structures had what, and how many of them a fault."""
    table = Table(title="Structures (with faults)", title_justify="left")
    table.add_column("")
    table.add_column("")
    for name in ("solver", "controller", "output", "direction", "approach", "failing", "reverse"):
        counts: collections.Counter[str] = collections.Counter()
        faulty: collections.Counter[str] = collections.Counter()
        for record in records:
            value = str(getattr(structure(record["index"], record["seed"]), name))
            counts[value] += 1
            faulty[value] += bool(record["faults"])
        cells = [f"{value} {k} ({faulty[value]})" for value, k in sorted(counts.items())]
        table.add_row(name, ", ".join(cells))
    return table


def main(
    structures: Annotated[int, typer.Option(min=1, help="Programs to compile.")] = 100,
    draws: Annotated[int, typer.Option(min=6, help="Lanes of each batch.")] = 100,
    seed: Annotated[int, typer.Option(help="Of all random numbers.")] = 0,
    first: Annotated[int, typer.Option(help="Index of the first structure.")] = 0,
    only: Annotated[str, typer.Option(metavar="INDEX,...", help="These structures only.")] = "",
    kind: Annotated[Kind, typer.Option(help="What is tried.")] = Kind.SOLVE,
    limit: Annotated[float, typer.Option(help="Seconds that one structure may take.")] = 900.0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="A line for each.")] = None,
) -> None:
    """Run random structures; ends with status 1 if there were faults."""
    console = make_console()
    indices = [int(i) for i in only.split(",")] if only else list(range(first, first + structures))
    records = []
    started = time.perf_counter()
    for record in run(indices, seed, draws, limit, kind.value):
        records.append(record)
        show(console, record)
        if json is not None:
            with json.open("a") as file:
                file.write(json_module.dumps(record) + "\n")
    if kind is Kind.SOLVE:
        console.print(coverage(records))
    console.print(summary(records))
    cases = sum(record.get("cases", 0) for record in records)
    faulty = sum(bool(record["faults"]) for record in records)
    minutes = (time.perf_counter() - started) / 60
    console.print(
        f"{faulty} of {len(records)} structures with faults; {cases} cases, {minutes:.0f} min"
    )
    raise typer.Exit(1 if faulty else 0)


if __name__ == "__main__":
    typer.run(main)
