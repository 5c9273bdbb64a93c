"""Double pendulums with masses of their own: `mj.solve_ensemble` next to `double_pendulum.c`."""

import ctypes
import dataclasses
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import compiled, interleaved


SOURCE = Path(__file__).with_name("double_pendulum.c")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
SCALAR = "C, scalar"
# Each with steps of its own.
LANES = 8
T1 = 5.0


@dataclasses.dataclass(frozen=True)
class Row:
    method: str
    trajectories: int
    steps: float  # of a trajectory
    violation: float
    difference: float  # from `mj.solve_ensemble`
    us_per_step: float
    times_c: float | None


class Pendulums(NamedTuple):
    """States `(q, v)` at the start, and masses; the trajectories in front."""

    y0s: tuple[np.ndarray, np.ndarray]
    masses: np.ndarray


class Ends(NamedTuple):
    ys: tuple[np.ndarray, np.ndarray]
    num_steps: np.ndarray


def measure(size: int, lanes: int, tolerance: float, repeats: int) -> list[Row]:
    given = pendulums(size)
    runs = {"solve_ensemble": ensemble(given, lanes, tolerance)}
    runs |= _programs_by_hand(given, tolerance)
    timings = interleaved(runs, repeats)
    ends = {name: run() for name, run in runs.items()}
    us = {
        name: 1e3 * timings[name].median_ms / float(np.sum(end.num_steps))
        for name, end in ends.items()
    }
    ours = ends["solve_ensemble"].ys
    return [
        Row(
            name,
            size,
            float(np.mean(end.num_steps)),
            largest_violation(end.ys),
            max(float(np.max(np.abs(a - b))) for a, b in zip(end.ys, ours, strict=True)),
            us[name],
            us[name] / us[SCALAR] if SCALAR in us else None,
        )
        for name, end in ends.items()
    ]


def table_of(rows: list[Row]) -> Table:
    table = Table(title="Double pendulums with masses of their own", title_justify="left")
    table.add_column("method", no_wrap=True)
    for heading in ("trajectories", "steps", "max |g|", "difference", "us / step", "times C"):
        table.add_column(heading, justify="right")
    for r in rows:
        table.add_row(
            r.method,
            str(r.trajectories),
            f"{r.steps:.0f}",
            f"{r.violation:.0e}",
            f"{r.difference:.0e}",
            f"{r.us_per_step:.3g}",
            "" if r.times_c is None else f"{r.times_c:.2f}",
        )
    return table


def pendulums(size: int) -> Pendulums:
    """At rest, links at angles up to 1.5 from the vertical."""
    random = np.random.default_rng(0)
    angles, masses = random.uniform(-1.5, 1.5, (size, 2)), random.uniform(0.5, 2.0, (size, 2))
    links = np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    q = np.cumsum(links, axis=1).reshape(size, 4)
    return Pendulums((q, np.zeros_like(q)), masses)


def ensemble(
    given: Pendulums, lanes: int, tolerance: float, mesh: Mesh | None = None
) -> Callable[[], Ends]:
    problem = mj.problems.double_pendulum(t1=T1)
    solver = mj.Projected(dfx.Tsit5(), problem.constraint)
    kind = type(problem.args)
    args = kind(given.masses, np.ones(2), np.asarray(9.81))

    def solve(y0s: Any, args: Any) -> Any:
        sol = mj.solve_ensemble(
            problem.terms,
            solver,
            problem.t0,
            problem.t1,
            None,
            y0s,
            args,
            args_axes=kind(0, None, None),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            lanes=lanes,
            mesh=mesh,
        )
        q, v = sol.ys
        return (q[:, -1], v[:, -1]), sol.stats["num_steps"]

    run, _ = compiled(solve, *jtu.tree_map(jnp.asarray, (given.y0s, args)))
    return lambda: Ends(*jtu.tree_map(np.asarray, run()))


def _programs_by_hand(given: Pendulums, tolerance: float) -> dict[str, Callable[[], Ends]]:
    """None, with a message, where they cannot be compiled."""
    compiler = shutil.which("gcc")
    if compiler is None:
        print("There is no gcc: `double_pendulum.c` is left out.")
        return {}
    kinds = {SCALAR: (), f"C, {LANES} lanes": (f"-DLANES={LANES}",)}
    try:
        return {name: _program(compiler, flags, given, tolerance) for name, flags in kinds.items()}
    except subprocess.CalledProcessError as error:
        print(f"gcc cannot compile `double_pendulum.c`, which is left out: {error.stderr}")
        return {}


def _program(
    compiler: str, flags: tuple[str, ...], given: Pendulums, tolerance: float
) -> Callable[[], Ends]:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "double_pendulum.so"
        command = [compiler, *FLAGS, *flags, str(SOURCE), "-o", str(library), "-lm"]
        subprocess.run(command, check=True, capture_output=True, text=True)
        function = ctypes.CDLL(str(library)).solve
    numbers = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    counts = np.ctypeslib.ndpointer(np.int64, flags="C_CONTIGUOUS")
    settings = ctypes.c_double, ctypes.c_double
    function.argtypes = (ctypes.c_int, numbers, numbers, *settings, numbers, counts)
    starts = np.concatenate(given.y0s, axis=1)
    size = len(starts)

    def run() -> Ends:
        ends, steps = np.empty((size, 8)), np.empty(size, np.int64)
        if function(size, starts, given.masses, T1, tolerance, ends, steps):
            raise RuntimeError("`double_pendulum.c` took too many steps.")
        return Ends((ends[:, :4], ends[:, 4:]), steps)

    return run


def largest_violation(ys: tuple[np.ndarray, np.ndarray]) -> float:
    """Of the lengths and the velocities of the links."""
    links, rates = (np.diff(part.reshape(-1, 2, 2), axis=1, prepend=0.0) for part in ys)
    positions = (np.sum(links**2, axis=2) - 1) / 2
    velocities = np.sum(links * rates, axis=2)
    return float(max(np.abs(positions).max(), np.abs(velocities).max()))
