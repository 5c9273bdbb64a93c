"""The command line, `manifold-jax`.

The commands import what they need when they run: `--help` should not wait for it.
"""

from pathlib import Path
from typing import Annotated

import typer

from . import options
from .arguments import (
    check_can_draw,
    check_positive,
    check_target,
    choose,
    FIGURE_TYPES,
    model_at,
    names_in,
    task_for,
)
from .console import output_console, print_lines, print_table, progress_bar


app = typer.Typer(
    name="manifold-jax",
    help="Differential equations on manifolds: look at the gallery of problems, compare "
    "solvers, solve one many times, reduce the index of equations, reprint the paper's table. "
    "Computes in double precision.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",  # joins the lines of a paragraph
    pretty_exceptions_show_locals=False,
)


@app.callback()
def _settings() -> None:
    # Here and not on import: whoever imports the package decides for themselves.
    import jax

    jax.config.update("jax_enable_x64", True)


@app.command("list")
def list_problems() -> None:
    """List the gallery: states n, constraints m, and where the solution is known."""
    from ...problems import ALL, FURTHER
    from ..compare.report import gallery_table

    with progress_bar() as progress:
        progress.add_task("building the problems")
        table = gallery_table(ALL | FURTHER)
    print_table(output_console(), table)


@app.command()
def compare(
    problem: options.ProblemName,
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
            "partition, lie-group, scipy-rk45, scipy-dop853, scipy-lsoda.",
        ),
    ] = None,
    rtol: Annotated[float, typer.Option(help="Relative tolerance of all methods.")] = 1e-6,
    atol: Annotated[float, typer.Option(help="Absolute tolerance of all methods.")] = 1e-6,
    t1: options.EndTime = None,
    gain: Annotated[
        float | None,
        typer.Option(
            metavar="RATE",
            help="Gain of the stabilizations, 1/time, by default 30 / time span of the problem.",
        ),
    ] = None,
    json: options.JsonFile = None,
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

    The approaches: `plain` ignores the constraint; `projected` corrects every step to round-off,
    `one-step` by one Newton iteration; `invariant`, `exact` and `baumgarte` stabilize the vector field
    (the last for mechanical systems only); `tangent` and `partition` integrate in local coordinates, of
    the tangent space and of some of the components, `lie-group` in the algebra (for rotations).

    The step limit that Diffrax needs is found automatically: 4096, doubled until the solve
    finishes, at most 1048576. It is stated below the table. A method that fails is reported
    in its row; the others go on. Of a problem with jumps, `compass-gait`, those are left out that
    know nothing of them.

    Most of the time goes into compiling: half a minute on one core for the pendulum, two or
    three minutes for mechanisms like the four-bar linkage and for implicit solvers; less with
    fewer `--methods`.
    """
    task = task_for(problem, solver, rtol, atol, t1, gain)
    from ..compare.methods import measure, METHODS
    from ..compare.report import comparison_notes, comparison_table, comparison_title, write_json

    chosen, left_out = choose(methods, {method.key: method for method in METHODS}, task)
    check_target(json, "--json", None)
    check_target(plot, "--plot", FIGURE_TYPES)
    check_can_draw(plot, "--plot")

    measurements = []
    with progress_bar() as progress:
        status = progress.add_task("")
        for k, method in enumerate(chosen, 1):
            of_all = f"{method.name(task)} ({k} of {len(chosen)})"
            progress.update(status, description=f"{task.problem.name}: {of_all}")
            measurements.append(measure(task, method))
        if plot is not None:
            progress.update(status, description="drawing")
            from ..compare.figure import write_figure

            write_figure(plot, task, measurements)
    if json is not None:
        write_json(json, task, measurements, left_out)
    notes = comparison_notes(task, measurements, left_out)
    output = output_console()
    print_lines(output, [comparison_title(task)], style="bold")
    print_table(output, comparison_table(measurements))
    print_lines(output, notes, style="dim")


@app.command()
def certify(
    problem: options.ProblemName,
    methods: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="plain, projected, one-step, invariant, exact, baumgarte, tangent, partition, "
            "lie-group (each takes its time, see above).",
        ),
    ] = "projected",
    solvers: Annotated[
        str, typer.Option(metavar="NAME,...", help="Adaptive solvers of Diffrax, as in `compare`.")
    ] = "tsit5",
    adjoints: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="forward, checkpointed, replay, direct, backsolve (refused).",
            show_default="checkpointed, replay, backsolve",
        ),
    ] = "checkpointed,replay,backsolve",
    hessian: Annotated[
        bool, typer.Option("--hessian", help="Hessian-vector products, too (twice the time).")
    ] = False,
    tolerance: Annotated[
        float, typer.Option(help="Tolerance of the steps, relative and absolute.")
    ] = 1e-6,
    t1: options.EndTime = None,
    json: options.JsonFile = None,
) -> None:
    """Certify gradients: reverse mode against forward mode, and that against differences.

    What is differentiated is a weighted sum of the last state, with respect to the parameters
    of the problem (its initial state if it has none); they enter the vector field, the
    constraint and the initial state.

    Prints for each approach and solver how far the gradients of the adjoints are from forward
    mode (relative), alone and in a batch, with steps chosen anew in each solve, as users run
    them; with `--hessian` also Hessian-vector products, from forward over forward mode. Then how
    far forward mode is from finite differences (sixth order; the steps of one solve are given
    to all) and from the gradient of the exact solution, and sensitivities from tangent. The last
    lines say what was not covered.

    Exits with 1 if an adjoint differs by more than 1e-10, or differences by more than 1e-7.

    Nearly all the time goes into compiling: for a problem like the pendulum about 40 seconds on
    one core for each approach and solver, of which 10 for each adjoint, and as much again with
    `--hessian`: five minutes for all eight approaches. The four-bar linkage, with 18 states and
    16 equations, takes six minutes for one.
    """
    check_positive(tolerance, "--tolerance")
    task = task_for(problem, "tsit5", tolerance, tolerance, t1, None)
    if task.problem.resets:
        raise typer.BadParameter(
            f"`{task.problem.name}` has jumps, at times that move with the parameters; choose one without.",
            param_hint="PROBLEM",
        )
    check_target(json, "--json", None)
    from .. import certify as _certify
    from ..compare.approaches import known_approaches
    from ..compare.with_diffrax import SOLVERS

    known = {approach.name: approach for approach in known_approaches()}
    chosen, left_out = choose(methods, known, task)
    steppers = [SOLVERS[name]() for name in names_in(solvers, SOLVERS, "solver", "--solvers")]
    every = _certify.ADJOINTS
    ways = {name: every[name] for name in names_in(adjoints, every, "adjoint", "--adjoints")}
    rows = []
    with progress_bar() as progress:
        status = progress.add_task("")
        for name, row in _certify.combinations(task, chosen, steppers, ways, hessian):
            progress.update(status, description=f"{task.problem.name}: {name}")
            if row is not None:
                rows.append(row)
    if json is not None:
        settings = {"problem": task.problem.name, "t1": task.t1, "tolerance": tolerance}
        _certify.write_json(json, settings, rows)
    output = output_console()
    for row in rows:
        title = f"{task.problem.name}, {_certify.certificate_title(row)}"
        print_lines(output, [title], style="bold")
        if row.checks:
            print_table(output, _certify.certificate_table(row))
        print_lines(output, [*_certify.certificate_notes(row), ""])
    possible, _ = choose(None, known, task)
    missing = [approach.name for approach in possible if approach not in chosen]
    print_lines(output, _certify.certificate_scope(rows, missing, left_out), style="dim")
    if not all(_certify.is_certified(row) for row in rows):
        raise typer.Exit(1)


@app.command()
def reduce(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODULE:FUNCTION",
            help="A function without arguments that returns `(F, x_example, args_example)`, and `order` "
            "as a fourth if it is not 1; the module is looked for in this folder, too.",
        ),
    ],
) -> None:
    """Reduce the index of a differential-algebraic equation F(t, x, x', args) = 0, and print how.

    Prints the signature matrix (the highest derivative of each unknown in each equation), how
    often each equation has to be differentiated (c) and up to which derivative each unknown then
    occurs (d), the index, the degrees of freedom, the names of the numbers in the state, and how
    well conditioned the equations for the highest derivatives are.

    Exits with 1 if the equations cannot be reduced, and says which of them are at fault.
    """
    F, x, args, order = model_at(model)
    from ..._dae import reduce_dae

    output = output_console()
    try:
        dae = reduce_dae(F, x, args, order=order)
    except (TypeError, ValueError) as error:
        print_lines(output, [str(error)])
        raise typer.Exit(1) from None
    print_lines(output, [str(dae.report)], no_wrap=True, crop=False)


@app.command()
def paper() -> None:
    """Reprint Table 1 of the paper: Euler's method on a circle, plain and projected.

    Local tolerances tau from 1e-1 to 1e-8 with steps h = sqrt(2 tau), N of them for one turn. Without
    projection g(x_N) = (1 + 2 tau)^N - 1, by this closed form and as run; with projection the largest
    |g| of all steps. Errors are distances from the solution at N h. Takes a few seconds.
    """
    from ..compare.paper import NOTES, paper_rows, paper_table, TAUS, TITLE

    rows = []
    with progress_bar() as progress:
        status = progress.add_task("compiling")
        for row in paper_rows():
            rows.append(row)
            progress.update(status, description=f"Table 1: {len(rows)} of {len(TAUS)} lines")
    output = output_console()
    print_lines(output, [TITLE], style="bold")
    print_table(output, paper_table(rows))
    print_lines(output, NOTES, style="dim")
