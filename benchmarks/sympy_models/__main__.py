"""Models of `sympy.physics.mechanics` from their derivation to their motion: a rattleback and a bicycle.

`python -m benchmarks.sympy_models --json FILE --plot FILE`

Seconds of the process for each part, from empty caches: SymPy's derivation, `mj.from_sympy`, a consistent start, tracing and compiling the
solve together with its first run, and a second run. The rattleback is compared with the equations of its paper, integrated
by SciPy, the bicycle's eigenvalues with the published table.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    environment,
    make_console,
    use_double_precision,
    use_one_core,
    write_json,
)
from . import bicycle, rattleback
from .picture import draw


TOLERANCE = 1e-8
END = 20.0  # seconds
SAVED = 801
SPEED, LEAN_RATE = 5.0, 0.3  # of the bicycle, m/s and rad/s
SPEEDS = np.linspace(0.0, 10.0, 101)  # the published ones and others between them


@dataclasses.dataclass(frozen=True)
class Seconds:
    """What each part takes of the process; the total is without the second solve."""

    derivation: float
    from_sympy: float
    start: float
    first_solve: float
    second_solve: float
    total: float
    total_by_the_clock: float


class Motion(NamedTuple):
    """A model, its parameters, and its motion at equidistant times."""

    model: mj.SymbolicSystem
    args: dict[str, Any]
    times: np.ndarray
    states: Any
    energies: np.ndarray
    violation: float  # largest absolute residual
    steps: int
    seconds: Seconds

    def column(self, name: str) -> np.ndarray:
        names = self.model.coordinates + self.model.speeds
        return np.concatenate(self.states, axis=1)[:, names.index(name)]


def move(
    derive: Callable[[], Any], parameters: dict[str, float], start: Callable[[Any, Any], Any]
) -> Motion:
    jax.clear_caches()
    clock, laps = time.perf_counter(), [time.process_time()]
    lap = lambda: laps.append(time.process_time())
    method, energy = derive()
    lap()
    model = mj.from_sympy(method)
    args = model.args(parameters)
    lap()
    y0 = jax.block_until_ready(start(model, args))
    lap()
    times = np.linspace(0.0, END, SAVED)

    def solve() -> Any:
        solution = mj.diffeqsolve(
            model.terms,
            mj.Projected(dfx.Dopri8(), model.constraint),
            0.0,
            END,
            None,
            y0,
            args,
            saveat=dfx.SaveAt(ts=times),
            stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=100_000,
        )
        jax.block_until_ready(solution.ys)
        lap()
        return solution

    solution = solve()
    clock = time.perf_counter() - clock
    solve()
    seconds = Seconds(*np.diff(laps).tolist(), laps[-2] - laps[0], clock)
    at = lambda f: jax.vmap(lambda t, y: f(t, y, args))(times, solution.ys)
    residuals = np.concatenate([np.asarray(r) for r in at(model.constraint)], axis=1)
    energies = np.asarray(at(model.function(energy)))
    states = jax.tree.map(np.asarray, solution.ys)
    steps, violation = int(solution.stats["num_steps"]), float(np.abs(residuals).max())
    return Motion(model, args, times, states, energies, violation, steps, seconds)


def of_rattleback(motion: Motion) -> dict[str, Any]:
    published = rattleback.published_motion(motion.times)
    names = ("alpha", "beta", "gamma", "w1", "w2", "w3")
    found = np.stack([motion.column(name) for name in names], axis=1)
    spin = motion.column("w3")
    last = int(np.flatnonzero(spin < 0)[-1])
    reversal = np.interp(0.0, spin[last : last + 2], motion.times[last : last + 2])
    return {
        "difference from the published equations": float(np.abs(found - published).max()),
        "spin reverses for good at, s": float(reversal),
        "spin at the end, rad/s": float(spin[-1]),
        "largest gain of energy between saved values, J": float(np.diff(motion.energies).max()),
    }


def of_bicycle(motion: Motion, eigenvalues: np.ndarray) -> dict[str, Any]:
    differences = [
        float(np.abs(np.sort_complex(found) - np.sort_complex(bicycle.published(speed))).max())
        for speed, found in enumerate(eigenvalues[::10])
    ]
    return {
        "largest difference from the published eigenvalues, 1/s": max(differences),
        "relative drift of the energy": float(np.ptp(motion.energies) / motion.energies[0]),
        "lean at the end, rad": float(motion.column("lean")[-1]),
    }


def main(
    json: Annotated[Path | None, typer.Option(help="Where to write the results.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Where to draw the picture.")] = None,
) -> None:
    use_double_precision()
    use_one_core()
    of_start = lambda model, args: model.state(rattleback.START, args)
    rattle = move(rattleback.kanes_method, rattleback.PARAMETERS, of_start)
    leaning = lambda model, args: bicycle.straight_ahead(model, args, SPEED, u_lean=LEAN_RATE)
    bike = move(bicycle.kanes_method, bicycle.PARAMETERS, leaning)
    eigenvalues = bicycle.eigenvalues(bike.model, bike.args, SPEEDS)
    results = {"rattleback": of_rattleback(rattle), "bicycle": of_bicycle(bike, eigenvalues)}
    console = make_console()
    for name, motion in (("rattleback", rattle), ("bicycle", bike)):
        scaled = mj.constraint_violation(
            motion.model.constraint, motion.times, motion.states, motion.args
        )
        results[name] |= {"largest residual": motion.violation, "scaled": float(scaled)}
        results[name] |= {"steps": motion.steps}
        table = Table("", name, title=f"{name}, {END:g} s, tolerance {TOLERANCE:g}")
        seconds = dataclasses.asdict(motion.seconds)
        for key, value in seconds.items():
            table.add_row(f"{key.replace('_', ' ')}, s", f"{value:.2f}")
        for key, value in results[name].items():
            table.add_row(key, f"{value:.3g}")
        console.print(table)
        results[name]["seconds"] = seconds
    if plot is not None:
        draw(plot, rattle, bike, SPEEDS, eigenvalues)
    if json is not None:
        write_json(json, {"environment": environment("sympy"), **results})


if __name__ == "__main__":
    typer.run(main)
