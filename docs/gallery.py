"""Draw the pictures of the gallery page: `python docs/gallery.py [NAME ...]`, all without names."""

import sys
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.tree_util as jtu
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import manifold_jax as mj
from manifold_jax._tools.animate import DrawnMotion, SKETCHES
from manifold_jax._tools.compare.task import as_rows
from manifold_jax.problems.battery import terminal_voltage


FOLDER = Path(__file__).parent / "pages" / "gallery"
GALLERY = mj.problems.ALL | mj.problems.FURTHER
SMALLER = {"n-four-bar": lambda: mj.problems.n_four_bar(4)}
# Mechanisms are shown at the start and until this time, in seconds; these longer.
UNTIL, LONGER = (
    0.6,
    {
        "compass-gait": 12.0,
        "falling-truss": 2.0,
        "slider-crank": 4.0,
        "newtons-cradle": 0.9,
        "rotating-hoop": 0.3,
    },
)
BLUE = "#0072B2"


def main(names: list[str]) -> None:
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    FOLDER.mkdir(exist_ok=True)
    for name in names or GALLERY:
        figure = Figure(figsize=(3.2, 2.4), layout="constrained")
        draw = draw_mechanism if name in SKETCHES else draw_states
        draw(figure, (GALLERY | SMALLER)[name]())
        figure.savefig(FOLDER / f"{name}.png", dpi=100)
        print(name, flush=True)


def solution(problem: mj.problems.Problem, times: np.ndarray) -> tuple[Any, Any]:
    """Return the states at the times, and the resets; by the known solution, where there is one."""
    if not problem.resets and not problem.reference_at_end_only:
        return problem.reference(times), None
    sol = mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        problem.t0,
        problem.t1,
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
        resets=problem.resets,
    )
    return jtu.tree_map(np.asarray, sol.ys), sol.resets


def draw_mechanism(figure: Figure, problem: mj.problems.Problem) -> None:
    """Draw five positions, the last one dark."""
    end = LONGER.get(problem.name, min(UNTIL, problem.t1))
    times = problem.t0 + np.linspace(0, min(end, problem.t1 - problem.t0), 5)
    states, resets = solution(problem, times)
    ax = figure.add_subplot()
    lines = SKETCHES[problem.name](DrawnMotion(times, states[0], problem.args, resets))
    many = sum(line.shape[1] for line in lines) > 30
    for frame, alpha in enumerate((0.12, 0.17, 0.25, 0.4, 1.0)):
        style = dict(color=BLUE, alpha=alpha, linewidth=1.2 if many else 2.2)
        for line in lines:
            size = 2 if many else 4
            ax.plot(*line[frame].T, marker="o", markersize=size, markeredgewidth=0, **style)
    ax.set_aspect("equal")
    ax.set_axis_off()


def angle_and_rate(y: Any, args: Any) -> np.ndarray:
    (c, s), (dc, ds) = np.moveaxis(y[0], 1, 0), np.moveaxis(y[1], 1, 0)
    return np.stack([np.arctan2(s, c), c * ds - s * dc], axis=1)


def voltage(y: Any, args: Any) -> np.ndarray:
    return np.asarray(jax.vmap(lambda y: terminal_voltage(y, args))(y))[:, None]


# What is drawn instead of the first array of the state.
VIEWS = {"relay-feedback": angle_and_rate, "battery": voltage}


def draw_states(figure: Figure, problem: mj.problems.Problem) -> None:
    """Draw the first array of the state as a curve, or its components over time."""
    times = np.linspace(problem.t0, problem.t1, 600)
    states = solution(problem, times)[0]
    first = as_rows(jtu.tree_leaves(states)[:1])
    rows = VIEWS[problem.name](states, problem.args) if problem.name in VIEWS else first
    if rows.shape[1] in (2, 3):
        is_spatial = rows.shape[1] == 3
        ax: Axes = figure.add_subplot(projection="3d" if is_spatial else None)
        ax.plot(*rows.T, color=BLUE, linewidth=1.2)
        ax.locator_params(nbins=3)
        if np.ptp(rows, axis=0).max() < 3 * np.ptp(rows, axis=0).min():
            ax.set_aspect("equal")
    else:
        ax = figure.add_subplot()
        ax.plot(times, rows, linewidth=1.2)
        ax.set_xlabel("t", fontsize=8)
    ax.tick_params(labelsize=7)


if __name__ == "__main__":
    main(sys.argv[1:])
