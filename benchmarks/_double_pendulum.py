"""Double pendulums with masses of their own: `mj.solve_ensemble` next to `double_pendulum.c`."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


SOURCE = Path(__file__).with_name("double_pendulum.c")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
# Each with steps of its own.
LANES = 8


class Pendulums(NamedTuple):
    """States `(q, v)` at the start, and the masses, in front of which are the trajectories."""

    y0s: Any
    masses: np.ndarray


class Ends(NamedTuple):
    ys: Any
    num_steps: np.ndarray


def pendulums(size: int) -> Pendulums:
    """At rest, links at angles up to 1.5 from the vertical."""
    random = np.random.default_rng(0)
    angles, masses = random.uniform(-1.5, 1.5, (size, 2)), random.uniform(0.5, 2.0, (size, 2))
    links = np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    q = np.cumsum(links, axis=1).reshape(size, 4)
    return Pendulums((jnp.asarray(q), jnp.zeros_like(q)), masses)


def programs(given: Pendulums, t1: float, tolerance: float) -> dict[str, Callable[[], Ends]]:
    """Those that a compiler is there for."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return {}
    kinds = {"C, scalar": (), f"C, {LANES} lanes": (f"-DLANES={LANES}",)}
    return {
        name: _program(compiler, flags, given, t1, tolerance) for name, flags in kinds.items()
    }


def _program(
    compiler: str, flags: tuple[str, ...], given: Pendulums, t1: float, tolerance: float
) -> Callable[[], Ends]:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "double_pendulum.so"
        subprocess.run([compiler, *FLAGS, *flags, SOURCE, "-o", library, "-lm"], check=True)
        function = ctypes.CDLL(str(library)).solve
    numbers = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    counts = np.ctypeslib.ndpointer(np.int64, flags="C_CONTIGUOUS")
    function.argtypes = (
        ctypes.c_int,
        *(numbers, numbers),
        *(ctypes.c_double, ctypes.c_double),
        *(numbers, counts),
    )
    starts = np.concatenate([np.asarray(part) for part in given.y0s], axis=1)
    size = len(starts)

    def run() -> Ends:
        ends, steps = np.empty((size, 8)), np.empty(size, np.int64)
        if function(size, starts, given.masses, t1, tolerance, ends, steps):
            raise RuntimeError("`double_pendulum.c` took too many steps.")
        return Ends((ends[:, :4], ends[:, 4:]), steps)

    return run


def largest_violation(ys: Any) -> float:
    """Lengths and velocities of the links."""
    links, rates = (np.diff(np.reshape(part, (-1, 2, 2)), axis=1, prepend=0.0) for part in ys)
    positions = (np.sum(links**2, axis=2) - 1) / 2
    velocities = np.sum(links * rates, axis=2)
    return float(max(np.abs(positions).max(), np.abs(velocities).max()))
