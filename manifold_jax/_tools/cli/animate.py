"""`manifold-jax animate`: drift made visible."""

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
            help="A planar mechanism: pendulum, double-pendulum, chain, slider-crank, four-bar, "
            "parallelogram.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture to write (gif).")],
    solver: options.SolverName = "tsit5",
    rtol: options.RelativeTolerance = 1e-4,
    atol: options.AbsoluteTolerance = 1e-4,
    t1: Annotated[float, typer.Option(metavar="T", help="End of the time span.")] = 60.0,
    seconds: Annotated[
        float,
        typer.Option(
            help="Length of the part at its end that is shown, in the time of the problem."
        ),
    ] = 5.0,
) -> None:
    """Draw a planar mechanism in motion, without and with projection side by side.

    Both are solved from the start to the end of the time span with the same solver and tolerance;
    the last seconds are shown. Bodies are drawn from their own coordinates: where the joints do not
    hold they come apart. Below is max |g|, the largest violation of the constraint, of positions
    and velocities.

    Takes half a minute on one core, most of it to compile.
    """
    check_positive(seconds, "--seconds")
    task = task_for(problem, solver, rtol, atol, t1, None)
    check_target(out, "--out", (".gif",))
    check_can_draw(out, "--out")
    from ..animate import SKETCHES, write_film

    check_name(task.problem.name, SKETCHES, "drawing of the problem", "PROBLEM")
    if not seconds <= task.t1 - task.t0:
        raise typer.BadParameter(
            f"must be at most the time span, {task.t1 - task.t0:g}; got {seconds:g}.",
            param_hint="--seconds",
        )
    with progress_bar() as progress:
        progress.add_task(f"{task.problem.name}: solving and drawing")
        takes = write_film(out, task, seconds)
    lines = [f"{take.name + ':':<11} max |g| = {take.violations.max():.1e}" for take in takes]
    lines.append(f"written: {out}, {out.stat().st_size / 1e6:.2f} MB")
    print_lines(output_console(), lines)
