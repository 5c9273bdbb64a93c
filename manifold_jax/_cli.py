"""The command line, `manifold-jax`.

The commands import what they need when they run: `--help` should not wait for it.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


if TYPE_CHECKING:
    from ._compare.methods import Method
    from ._compare.task import Task


app = typer.Typer(
    name="manifold-jax",
    help="Differential equations on manifolds: look at the gallery of problems, compare "
    "solvers, reprint the paper's table. Computes in double precision.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",  # which joins the lines of a paragraph
    pretty_exceptions_show_locals=False,
)

# What matplotlib writes without further programs.
FIGURE_TYPES = (".png", ".pdf", ".svg", ".jpg")


@app.callback()
def _settings() -> None:
    # Here and not on import: whoever imports the package decides for themselves.
    import jax

    jax.config.update("jax_enable_x64", True)


@app.command("list")
def list_problems() -> None:
    """List the gallery: states n, constraints m, and where the solution is known."""
    from ._compare.report import gallery_table
    from .problems import ALL

    with _progress() as progress:
        progress.add_task("building the problems")
        table = gallery_table(ALL)
    _output().print(table)


@app.command()
def compare(
    problem: Annotated[
        str, typer.Argument(metavar="PROBLEM", help="Name of the problem, see `manifold-jax list`.")
    ],
    solver: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Adaptive solver of Diffrax, run as it is and in every approach: heun, midpoint, "
            "ralston, bosh3, tsit5, dopri5, dopri8, impliciteuler, kvaerno3, kvaerno4, kvaerno5.",
        ),
    ] = "tsit5",
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Only these: plain, projected, one-step, invariant, exact, baumgarte, tangent, "
            "partition, scipy-rk45, scipy-dop853, scipy-lsoda.",
        ),
    ] = None,
    rtol: Annotated[float, typer.Option(help="Relative tolerance of all methods.")] = 1e-6,
    atol: Annotated[float, typer.Option(help="Absolute tolerance of all methods.")] = 1e-6,
    t1: Annotated[
        float | None,
        typer.Option(metavar="T", help="End of the time span, by default that of the problem."),
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(
            metavar="RATE",
            help="Gain of the stabilizations, 1/time, by default 30 / time span of the problem.",
        ),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as JSON, too.")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a picture (png, pdf, svg or jpg): trajectory, violation and error.",
        ),
    ] = None,
) -> None:
    """Solve one problem with a Diffrax solver in every approach to the manifold, and with SciPy.

    Prints for each method its steps, evaluations of the vector field, the largest constraint
    violation max |g| at the ends of the steps and at 1001 output times, the largest error of
    the state there, the median run time and the time to compile.

    The approaches: `plain` ignores the constraint; `projected` corrects every step to
    round-off, `one-step` by one Newton iteration; `invariant`, `exact` and `baumgarte` stabilize
    the vector field (the last for mechanical systems only); `tangent` and `partition` integrate
    in local coordinates, of the tangent space and of some of the components.

    The step limit that Diffrax needs is found automatically: 4096, doubled until the solve
    finishes, at most 1048576. It is stated below the table. A method that fails is reported
    in its row; the others go on.
    """
    task = _task(problem, solver, rtol, atol, t1, gain)
    chosen, left_out = _choose(methods, task)
    _check_target(json, "--json", None)
    _check_target(plot, "--plot", FIGURE_TYPES)
    from ._compare.methods import measure
    from ._compare.report import comparison_notes, comparison_table, write_json

    measurements = []
    with _progress() as progress:
        status = progress.add_task("")
        for k, method in enumerate(chosen, 1):
            of_all = f"{method.name(task)} ({k} of {len(chosen)})"
            progress.update(status, description=f"{task.problem.name}: {of_all}")
            measurements.append(measure(task, method))
        if plot is not None:
            progress.update(status, description="drawing")
            from ._compare.figure import write_figure

            write_figure(plot, task, measurements)
    if json is not None:
        write_json(json, task, measurements, left_out)
    output = _output()
    output.print(
        f"[bold]{task.problem.name}[/bold], t = {task.t0:g} to {task.t1:g}, "
        f"rtol = {task.rtol:g}, atol = {task.atol:g}",
        highlight=False,
    )
    output.print(comparison_table(task, measurements))
    for note in comparison_notes(task, measurements, left_out):
        output.print(note, style="dim", highlight=False)


@app.command()
def certify(
    problem: Annotated[
        str, typer.Argument(metavar="PROBLEM", help="Name of the problem, see `manifold-jax list`.")
    ],
    methods: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="plain, projected, one-step, invariant, exact, baumgarte, tangent, partition.",
        ),
    ] = "projected,invariant,tangent",
    solvers: Annotated[
        str, typer.Option(metavar="NAME,...", help="Adaptive solvers of Diffrax, as in `compare`.")
    ] = "tsit5",
    adjoints: Annotated[
        str,
        typer.Option(
            metavar="NAME,...", help="forward, checkpointed, replay, direct, backsolve (refused)."
        ),
    ] = "forward,checkpointed,replay,backsolve",
    tolerance: Annotated[float, typer.Option(help="Of the steps, relative and absolute.")] = 1e-6,
    t1: Annotated[
        float | None,
        typer.Option(metavar="T", help="End of the time span, by default that of the problem."),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as JSON, too.")
    ] = None,
) -> None:
    """Certify gradients: all ways to compute them, compared with each other and with differences.

    What is differentiated is a weighted sum of the last state, with respect to the parameters
    of the problem (its initial state if it has none); they enter the vector field, the
    constraint and the initial state. The steps are those of one adaptive solve, given to all.

    Prints for each approach and solver how far the gradients of the adjoints are from forward
    mode (relative), Hessian-vector products from forward over forward, `vmap(grad)` from one at
    a time, their time, and the memory of the compiled program; and how far finite differences
    are (sixth order), the gradient of the exact solution, and sensitivities from tangent.

    Exits with 1 if reverse and forward mode differ by more than 1e-10, or differences by more
    than 1e-7.
    """
    task = _task(problem, "tsit5", tolerance, tolerance, t1, None)
    _check_target(json, "--json", None)
    from ._certify import ADJOINTS, certificate_table, combinations, is_certified, write_json
    from ._compare.approaches import APPROACHES
    from ._compare.with_diffrax import SOLVERS

    known = {approach.name: approach for approach in APPROACHES}
    chosen = [known[name] for name in _names(methods, known, "method", "--methods")]
    steppers = [SOLVERS[name]() for name in _names(solvers, SOLVERS, "solver", "--solvers")]
    ways = {n: ADJOINTS[n] for n in _names(adjoints, ADJOINTS, "adjoint", "--adjoints")}
    rows = []
    with _progress() as progress:
        status = progress.add_task("")
        for name, row in combinations(task, chosen, steppers, ways):
            progress.update(status, description=f"{task.problem.name}: {name}")
            if row is not None:
                rows.append(row)
    if json is not None:
        write_json(
            json, {"problem": task.problem.name, "t1": task.t1, "tolerance": tolerance}, rows
        )
    _output().print(certificate_table(rows))
    if not all(is_certified(row) for row in rows):
        raise typer.Exit(1)


@app.command()
def paper() -> None:
    """Reprint Table 1 of the paper: Euler's method on a circle, plain and projected.

    Local tolerances tau from 1e-1 to 1e-8 with steps h = sqrt(2 tau), N of them for one turn.
    Without projection g(x_N) = (1 + 2 tau)^N - 1, by this closed form and as run; with
    projection the largest |g| of all steps. Errors are distances from the solution at N h.
    """
    from ._compare.paper import NOTES, paper_rows, paper_table, TAUS

    rows = []
    with _progress() as progress:
        status = progress.add_task("compiling")
        for row in paper_rows():
            rows.append(row)
            progress.update(status, description=f"Table 1: {len(rows)} of {len(TAUS)} lines")
    output = _output()
    output.print(paper_table(rows))
    for note in NOTES:
        output.print(note, style="dim", highlight=False)


def _task(
    problem: str, solver: str, rtol: float, atol: float, t1: float | None, gain: float | None
) -> "Task":
    """The task asked for, or an error that says what could have been asked for."""
    from ._compare.approaches import default_gain
    from ._compare.task import Task
    from ._compare.with_diffrax import SOLVERS
    from .problems import ALL

    problem, solver = problem.lower().replace("_", "-"), solver.lower()
    _check_name(problem, ALL, "problem", "PROBLEM")
    _check_name(solver, SOLVERS, "solver", "--solver")
    built = ALL[problem]()
    gain = default_gain(built) if gain is None else gain
    for name, value in (("--rtol", rtol), ("--atol", atol), ("--gain", gain)):
        if not (math.isfinite(value) and value > 0):
            raise typer.BadParameter(f"must be a positive number, got {value}.", param_hint=name)
    t1 = built.t1 if t1 is None else t1
    if not (math.isfinite(t1) and t1 > built.t0):
        raise typer.BadParameter(
            f"must be later than the start of `{problem}`, t0 = {built.t0:g}; got {t1}.",
            param_hint="--t1",
        )
    return Task(built, solver, rtol, atol, t1, gain)


def _choose(names: str | None, task: "Task") -> tuple[list["Method"], list["Method"]]:
    """Of the methods asked for, those that can solve the task, and those that cannot."""
    from ._compare.methods import METHODS

    known = [method.key for method in METHODS]
    asked = known if names is None else _names(names, known, "method", "--methods")
    methods = [method for method in METHODS if method.key in asked]
    chosen = [method for method in methods if method.applies_to(task)]
    if not chosen:
        raise typer.BadParameter(
            f"{', '.join(asked)} needs a mechanical system, which `{task.problem.name}` is not.",
            param_hint="--methods",
        )
    return chosen, [method for method in methods if method not in chosen]


def _names(text: str, known: Iterable[str], kind: str, hint: str) -> list[str]:
    """A list separated by commas, all of known names."""
    names = [name.strip().lower() for name in text.split(",")]
    for name in names:
        _check_name(name, known, kind, hint)
    return names


def _check_name(name: str, known: Iterable[str], kind: str, hint: str) -> None:
    if name not in known:
        raise typer.BadParameter(
            f"there is no {kind} {name!r}. Choose one of: {', '.join(known)}.", param_hint=hint
        )


def _check_target(path: Path | None, option: str, suffixes: tuple[str, ...] | None) -> None:
    """Say so before the computation if its result could not be written."""
    if path is None:
        return
    if path.is_dir() or not path.parent.is_dir():
        raise typer.BadParameter(f"cannot write the file {str(path)!r}.", param_hint=option)
    if suffixes is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{str(path)!r} must end in one of: {', '.join(suffixes)}.", param_hint=option
        )


def _output() -> Console:
    """Standard output; wide enough for the tables if it is a file or a pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=120)


def _progress() -> Progress:
    """What is being done, on standard error and only if that is a terminal."""
    console = Console(stderr=True)
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
