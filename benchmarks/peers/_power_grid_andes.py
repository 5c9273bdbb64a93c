"""The same short circuit in ANDES: its case of the IEEE 14-bus system, the controllers of the machines left out."""

import contextlib
import functools
import io
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np


CASE = "ieee14/ieee14_fault.json"
KINDS = ("Bus", "PQ", "PV", "Slack", "Shunt", "Line", "Area", "GENROU", "Fault")


def _case(bus: int, times: tuple[float, float], reactance: float) -> dict[str, Any]:
    from andes.utils.paths import get_case

    full = json.loads(Path(get_case(CASE)).read_text())
    case = {kind: full[kind] for kind in KINDS}
    case["Fault"] = [
        {**full["Fault"][0], "bus": bus, "tf": times[0], "tc": times[1], "xf": reactance}
    ]
    case["GENROU"] = [{**machine, "coi": None, "coi2": None} for machine in full["GENROU"]]
    return case


def solve(
    bus: int, times: tuple[float, float], last: float, step: float, reactance: float
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return times, angles of shape `(times, machines)`, the seconds and the number of steps.

    By the implicit trapezoidal rule with constant steps and its equations solved to 1e-12. ANDES makes a step before and
    one after each switching time; they are shortened from 1e-4 s to 1e-7 s here, because its trapezoid averages the values
    on both sides of the switch, which delays the short circuit by half of that step.
    """
    import andes

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        file = Path(folder) / "case.json"
        file.write_text(json.dumps(_case(bus, times, reactance)))
        andes.config_logger(40)
        system: Any = andes.load(str(file), setup=True, no_output=True, default_config=True)
        system.store_switch_times = functools.partial(system.store_switch_times, eps=1e-7)
        system.PFlow.config.tol = 1e-12
        system.PFlow.run()
        options = {"tol": 1e-12, "tstep": step, "tf": last, "fixt": 1, "max_iter": 30}
        # No stop where machines separate, no smaller steps, neither scaled nor truncated corrections, no progress bar.
        options |= {"criteria": 0, "shrinkt": 0, "g_scale": 0, "reset_tiny": 0, "no_tqdm": 1}
        for name, value in options.items():
            setattr(system.TDS.config, name, value)
        start = time.perf_counter()
        succeeded = system.TDS.run()
        seconds = time.perf_counter() - start
    if not succeeded:
        raise RuntimeError("ANDES did not reach the end.")
    ts = np.asarray(system.dae.ts.t)
    return ts, np.asarray(system.dae.ts.x)[:, system.GENROU.delta.a], seconds, ts.size
