"""`manifold-jax ensemble`: many trajectories of one problem, with numbers drawn at random."""

import time
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING

import typer

from . import options
from .arguments import task_for
from .commands import app
from .console import output_console, print_lines


if TYPE_CHECKING:
    from ... import StoredEnsemble


@app.command()
def ensemble(
    problem: options.ProblemName,
    size: Annotated[int, typer.Option(metavar="N", min=1, help="How many trajectories.")],
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=DISTRIBUTION",
            help="What differs, e.g. 'args.length=uniform(0.5,2)'; once for each number. "
            "Distributions: uniform(low,high), normal(mean,std), loguniform(low,high).",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write to.")],
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue what is there, with the same settings.")
    ] = False,
    solver: options.SolverName = "tsit5",
    rtol: options.RelativeTolerance = 1e-6,
    atol: options.AbsoluteTolerance = 1e-6,
    t1: options.EndTime = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    lanes: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How many trajectories advance together; by default 128 on a CPU, 262144 elsewhere.",
        ),
    ] = None,
    chunk: Annotated[
        int, typer.Option(min=1, help="How many are solved and written together.")
    ] = 8192,
) -> None:
    """Solve one problem many times, with numbers drawn at random, and write the ends to a folder.

    Parameters are called `args.length` or `args.masses.0`, components of the initial state `y0.1`
    or `y0.0.1` (the second number of the first array); a wrong name prints the right ones.
    Initial state and constraint are rebuilt for the parameters, then starts are moved onto
    the manifold. Steps are projected onto it.

    The folder is in the format Zarr (`manifold_jax.open_ensemble`, or `zarr.open_group`): end times
    `ts`, states `ys/y`, the constraint violation max |g| there `ys/violation`, what was drawn
    `ys/varied`, statistics of the steps `stats` and result codes `result`. Needs zarr
    (`pip install zarr`). A run that was interrupted, also by a killed process, goes on with the same
    command and `--resume`, and ends with the same files.
    """
    task = task_for(problem, solver, rtol, atol, t1, None)
    import diffrax as dfx

    from ... import open_ensemble, Projected, stream_ensemble
    from ..compare.with_diffrax import SOLVERS
    from .varied import distributions, VariedProblem

    drawn = distributions(vary, task.problem)
    varied = VariedProblem(task.problem, drawn)
    begun = time.perf_counter()
    try:
        is_there = resume and (out / "zarr.json").exists()
        before = open_ensemble(out, check=False).finished if is_there else 0
        stored = stream_ensemble(
            varied.sample,
            size,
            out,
            varied.terms,
            Projected(SOLVERS[task.solver](), varied.constraint),
            task.t0,
            task.t1,
            None,
            saveat=dfx.SaveAt(t1=True, fn=varied.saved),
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol),
            max_steps=2**20,
            resets=varied.resets,
            lanes=lanes,
            chunk=chunk,
            seed=seed,
            resume=resume,
        )
    except (OSError, ImportError, ValueError) as error:
        message = getattr(error, "strerror", None) or str(error)
        message = message.replace("`resume=True`", "`--resume`")
        raise typer.BadParameter(message, param_hint="--out") from error
    seconds = time.perf_counter() - begun
    output = output_console()
    title = f"{task.problem.name}: {size} trajectories from t = {task.t0:g} to {task.t1:g}, "
    title += f"{task.solver} projected, rtol {rtol:g}, atol {atol:g}"
    print_lines(output, [title], style="bold")
    print_lines(output, _summary(stored, drawn, size - before, seconds), soft_wrap=True)


def _summary(stored: "StoredEnsemble", drawn: list[Any], new: int, seconds: float) -> list[str]:
    reasons = stored.failures_by_reason()
    steps, most, violation = 0, 0, 0.0
    for start in range(0, stored.size, stored.chunk):
        part = slice(start, start + stored.chunk)
        count = stored.stats["num_steps"][part]
        steps, most = steps + int(count.sum()), max(most, int(count.max()))
        good = stored.ys["violation"][part][stored.result[part] == 0]
        violation = max(violation, float(good.max(initial=0.0)))
    lines = [f"varied:       {', '.join(map(str, drawn))}", f"failed:       {stored.num_failed}"]
    for reason, (count, first) in reasons.items():
        numbers = ", ".join(map(str, first)) + (", ..." if count > len(first) else "")
        lines.append(f"  {count} (numbers {numbers}): {reason}")
    lines += [
        f"steps:        {steps} in all, {steps / stored.size:.1f} on average, {most} at most",
        f"violation:    {violation:.1e} at most, max |g| at the ends",
        f"time:         {seconds:.1f} s with compiling, {new / seconds:.0f} trajectories/s",
    ]
    if new < stored.size:
        lines[-1] += f" ({stored.size - new} were there)"
    root = stored.group.store.root
    files = [file for file in root.rglob("*") if file.is_file()]
    bytes_in_all = sum(file.stat().st_size for file in files)
    return [*lines, f"written:      {root}, {len(files)} files, {bytes_in_all / 1e6:.1f} MB"]
