"""Timing of something that has already been compiled."""

import statistics
import time
from collections.abc import Callable
from typing import Any


# Short runs are repeated until the median settles; of long ones three must do.
MIN_RUNS, MAX_RUNS = 3, 50
TIME_BUDGET = 1.0  # seconds


def median_ms(run: Callable[[], Any]) -> float:
    """Median duration of `run()` in milliseconds. Warm up before; `run` has to block."""
    durations: list[float] = []
    while len(durations) < MIN_RUNS or (len(durations) < MAX_RUNS and sum(durations) < TIME_BUDGET):
        start = time.perf_counter()
        run()
        durations.append(time.perf_counter() - start)
    return 1e3 * statistics.median(durations)
