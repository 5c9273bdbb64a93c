"""`manifold-jax animate`: drift made visible."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from . import options
from .arguments import check_can_draw, check_name, check_positive, check_target, task_for
from .commands import app
from .console import output_console, print_lines, progress_bar


@app.command()
def animate(
    problem: Annotated[
        str,
        typer.Argument(
            metavar="PROBLEM",
            help="A mechanism of the gallery: pendulum, double-pendulum, chain, slider-crank, "
            "four-bar, n-four-bar, parallelogram, falling-truss, compass-gait, newtons-cradle, spherical-pendulum, "
            "rotating-hoop, polymer, cable-net, delta-robot, stewart-platform.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture to write (gif).")],
    solver: options.SolverName = "tsit5",
    rtol: options.RelativeTolerance = 1e-4,
    atol: options.AbsoluteTolerance = 1e-4,
    t1: Annotated[
        float | None,
        typer.Option(
            metavar="T",
            help="End of the time span, by default a minute, or that of the problem if it is large or "
            "has jumps.",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            metavar="T",
            help="Length of the part at its end that is shown, in the time of the problem, by default "
            "5 or all.",
        ),
    ] = None,
) -> None:
    """Draw a mechanism in motion, without and with projection side by side; one with jumps with projection
    only.

    Both are solved from the start to the end of the time span with the same solver and tolerance;
    the last seconds are shown. Bodies are drawn from their own coordinates: where the joints do not
    hold they come apart. Below is max |g|, the largest violation of the constraint, of positions
    and velocities.

    Takes half a minute on one core, most of it to compile.
    """
    from ...problems import ALL

    task = task_for(problem, solver, rtol, atol, t1, None)
    if t1 is None and task.problem.name in ALL:
        task = dataclasses.replace(task, t1=task.t0 + 60.0)
    span = task.t1 - task.t0
    seconds = min(5.0, span) if seconds is None else seconds
    check_positive(seconds, "--seconds")
    check_target(out, "--out", (".gif",))
    check_can_draw(out, "--out")
    from ..animate import SKETCHES, write_film

    check_name(task.problem.name, SKETCHES, "drawing of the problem", "PROBLEM")
    if not seconds <= span:
        raise typer.BadParameter(
            f"must be at most the time span, {span:g}; got {seconds:g}.",
            param_hint="--seconds",
        )
    with progress_bar() as progress:
        progress.add_task(f"{task.problem.name}: solving and drawing")
        takes = write_film(out, task, seconds)
    lines = [f"{take.name + ':':<11} max |g| = {take.violations.max():.1e}" for take in takes]
    lines.append(f"written: {out}, {out.stat().st_size / 1e6:.2f} MB")
    print_lines(output_console(), lines)
