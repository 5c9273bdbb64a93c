"""What the benchmarks share: timing, the checks of a solution, and where a result was made."""

import dataclasses
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console


# Seconds of untimed runs before each timed one; at least one run.
WARM_UP = 0.005
# What a result depends on, in every JSON file.
PACKAGES = ("manifold_jax", "jax", "jaxlib", "diffrax", "equinox", "numpy", "scipy")


@dataclasses.dataclass(frozen=True)
class Timing:
    """Milliseconds of a run: the median, and the quartiles of all repeats."""

    median_ms: float
    low_ms: float
    high_ms: float


def interleaved(runs: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Time programs in turn, so that a disturbance of the machine meets all of them alike.

    Every round starts with another one. A timed run follows untimed ones of the same program:
    else a short program would be charged for what the long one before it has driven from the
    caches (measured: a factor of two to three). Programs have to block until they are done.
    """
    names = list(runs)
    durations: dict[str, list[float]] = {name: [] for name in names}
    for k in range(repeats):
        shift = k % len(names)
        for name in names[shift:] + names[:shift]:
            _warm_up(runs[name])
            start = time.perf_counter()
            runs[name]()
            durations[name].append(1e3 * (time.perf_counter() - start))
    return {name: _timing(values) for name, values in durations.items()}


def _warm_up(run: Callable[[], Any]) -> None:
    end = time.perf_counter() + WARM_UP
    run()
    while time.perf_counter() < end:
        run()


def _timing(values: list[float]) -> Timing:
    low, high = np.quantile(values, (0.25, 0.75))
    return Timing(statistics.median(values), float(low), float(high))


@dataclasses.dataclass(frozen=True)
class CompileTime:
    """Seconds from a Python function to a program: by the clock, and of the process."""

    wall_s: float
    process_s: float


def compiled(function: Callable, *args: Any) -> tuple[Callable[[], Any], CompileTime]:
    """The program for `function(*args)`, and what tracing and compiling from scratch takes.

    The program takes no arguments and blocks until its result is there.
    """
    program, seconds = compiled_for_any(function, *args)
    return lambda: program(*args), seconds


def compiled_for_any(function: Callable, *args: Any) -> tuple[Callable[..., Any], CompileTime]:
    """The same, but a program that takes arguments of the shapes and types of `args`."""
    # Otherwise the second program profits from what was traced for the first.
    jax.clear_caches()
    wall, process = time.perf_counter(), time.process_time()
    program = jax.jit(function).lower(*args).compile()
    seconds = CompileTime(time.perf_counter() - wall, time.process_time() - process)
    return lambda *args: jax.block_until_ready(program(*args)), seconds


def median_compile_times(
    functions: Mapping[str, tuple[Callable, tuple[Any, ...]]], repeats: int
) -> dict[str, CompileTime]:
    """Compile every `function(*args)` in turn, after a round that is not counted."""
    seconds: dict[str, list[CompileTime]] = {name: [] for name in functions}
    for k in range(repeats + 1):
        for name, (function, args) in functions.items():
            _, elapsed = compiled(function, *args)
            if k > 0:
                seconds[name].append(elapsed)
    return {
        name: CompileTime(
            statistics.median(s.wall_s for s in values),
            statistics.median(s.process_s for s in values),
        )
        for name, values in seconds.items()
    }


def pendulum_violations(rows: np.ndarray) -> tuple[float, float]:
    """Largest `|x^2 + y^2 - 1|` and `|x u + y v|` of states `(x, y, u, v)` in the last axis."""
    x, y, u, v = np.moveaxis(np.asarray(rows, np.float64), -1, 0)
    return float(np.max(np.abs(x * x + y * y - 1))), float(np.max(np.abs(x * u + y * v)))


def largest_difference(rows: np.ndarray, reference: np.ndarray) -> float:
    """Largest error of a state component."""
    return float(np.max(np.abs(rows - reference)))


def environment(*packages: str) -> dict[str, Any]:
    """Where a result was made. Of `packages`, those that are installed are listed, too."""
    return {
        "device": jax.devices()[0].device_kind,
        "cpu_count": os.cpu_count(),
        "machine": platform.machine(),
        "versions": {"python": platform.python_version(), **_versions(PACKAGES + packages)},
    }


def _versions(packages: tuple[str, ...]) -> dict[str, str]:
    versions = {}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def use_one_core() -> None:
    """The compiler's threads take turns, so that they do not slow each other down."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def use_double_precision() -> None:
    """Settings of all benchmarks. Compiled programs are not taken from the disk."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_strict(content), indent=2, allow_nan=False) + "\n")


def _strict(value: Any) -> Any:
    """JSON has neither NaN nor infinity."""
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def number(value: float | int | None, fmt: str) -> str:
    """For tables."""
    return "-" if value is None else format(value, fmt)


def milliseconds(value: float | None) -> str:
    """Three digits."""
    return "-" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def make_console() -> Console:
    """Wide enough for the tables where the output is not a terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=150)
