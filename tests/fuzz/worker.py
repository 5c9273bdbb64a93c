"""One structure after another in a process of its own; prints what was found as JSON lines.

`python -m tests.fuzz.worker KIND SEED DRAWS INDEX...`"""

import json
import sys
import time
import traceback
from typing import Any

import jax
import numpy as np

from benchmarks.tools.measure import use_double_precision

from . import daes, resets, stores
from .checks import (
    check_accuracy,
    check_events,
    check_other_lanes,
    check_results,
    check_single,
    check_violations,
    Fault,
    is_okay,
    judge,
)
from .daes import Equations, equations
from .gradients import check_gradients
from .lanes import amplification, draw, reference_paths, take, with_events, with_failing_lane
from .program import solve
from .resets import Switched, switched
from .stores import Store, store
from .structure import Structure, structure


DRAWN = {"solve": structure, "dae": equations, "store": store, "reset": switched}
# What is checked in other ways than as a batch of solves.
CHECKS = {Equations: daes.examine, Store: stores.examine, Switched: resets.examine}


def examine(one: Any, draws: int) -> dict[str, Any]:
    """All checks of one structure."""
    started = time.perf_counter()
    record: dict[str, Any] = {"index": one.index, "seed": one.seed, "spec": one.spec}
    faults: list[Fault] = []
    try:
        check = CHECKS.get(type(one), _checked)
        numbers = check(one, draws, faults)
    except Exception as error:
        lines = [line for line in str(error).splitlines() if line.strip()]
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = (
            f"{type(error).__name__}: {lines[0] if lines else ''} ({place.filename}:{place.lineno})"
        )
        faults.append(Fault("crash", text[:500]))
        numbers = {"traceback": traceback.format_exc()[-6000:]}
    record |= numbers
    record["seconds"] = round(time.perf_counter() - started, 1)
    record["faults"] = [{"kind": fault.kind, "message": fault.message} for fault in faults]
    return record


def _checked(one: Structure, draws: int, faults: list[Fault]) -> dict[str, Any]:
    lanes = draw(one, draws)
    paths = reference_paths(one, lanes)
    known = judge(one, lanes, paths, amplification(one, lanes, paths))
    lanes = with_events(one, lanes, paths)
    failing = with_failing_lane(one, lanes)
    batch = jax.jit(jax.vmap(solve(one)))
    found, failed = (jax.tree.map(np.asarray, batch(each)) for each in (lanes, failing))
    faults += check_results(one, known, found, failed)
    faults += check_other_lanes(found, failed)
    new, violation = check_violations(one, lanes, known, found, failed)
    faults += new
    new, error, ratio = check_accuracy(one, lanes, known, found)
    faults += new
    faults += check_events(one, lanes, known, found)
    numbers: dict[str, Any] = {
        "cases": len(lanes["y0"]),
        "trusted": int(known.trusted.sum()),
        "steps": int(np.median(found["num_steps"])),
        "violation": violation,
        "error": error,
        "of_bound": ratio,
    }
    # Where an event's function turns within a step, Newton's method does not find it, and says so.
    good = np.flatnonzero(known.trusted & is_okay(found["code"]))
    if one.single and good.size > 0:
        lane = int(good[-1])
        alone = jax.tree.map(np.asarray, jax.jit(solve(one, throw=True))(take(lanes, lane)))
        new, numbers["single"] = check_single(one, known, found, alone, lane)
        faults += new
    if one.reverse is not None:
        new, gradients = check_gradients(one, lanes, failing, known)
        faults += new
        numbers |= gradients
    return numbers


def main() -> None:
    use_double_precision()
    kind, *numbers = sys.argv[1:]
    seed, draws, *indices = map(int, numbers)
    for index in indices:
        record = examine(DRAWN[kind](index, seed), draws)
        print(json.dumps(record), flush=True)
        jax.clear_caches()


if __name__ == "__main__":
    main()
