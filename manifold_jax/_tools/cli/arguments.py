"""Arguments of the command line, with errors that list the valid ones."""

import importlib
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TYPE_CHECKING, TypeVar

import typer

from ..._base.extras import require


if TYPE_CHECKING:
    from ..compare.approaches import Approach
    from ..compare.methods import Method
    from ..compare.task import Task

    Way = TypeVar("Way", Approach, Method)


# File types that matplotlib writes without further programs.
FIGURE_TYPES = (".png", ".pdf", ".svg", ".jpg")


def task_for(
    problem: str, solver: str, rtol: float, atol: float, t1: float | None, gain: float | None
) -> "Task":
    """Return the task for the arguments, or raise an error that lists the valid ones."""
    from ...problems import ALL, FURTHER
    from ..compare.approaches import default_gain
    from ..compare.task import Task
    from ..compare.with_diffrax import SOLVERS

    problem, solver = problem.lower().replace("_", "-"), solver.lower()
    gallery = ALL | FURTHER
    check_name(problem, gallery, "problem", "PROBLEM")
    check_name(solver, SOLVERS, "solver", "--solver")
    built = gallery[problem]()
    gain = default_gain(built) if gain is None else gain
    for name, value in (("--rtol", rtol), ("--atol", atol), ("--gain", gain)):
        check_positive(value, name)
    t1 = built.t1 if t1 is None else t1
    if not (math.isfinite(t1) and t1 > built.t0):
        raise typer.BadParameter(
            f"must be later than the start of `{problem}`, t0 = {built.t0:g}; got {t1}.",
            param_hint="--t1",
        )
    return Task(built, solver, rtol, atol, t1, gain)


def choose(
    names: str | None, known: dict[str, "Way"], task: "Task"
) -> tuple[list["Way"], list["Way"]]:
    """Divide the methods asked for into those that can solve the task, and those that cannot."""
    asked = list(known) if names is None else names_in(names, known, "method", "--methods")
    methods = [method for name, method in known.items() if name in asked]
    chosen = [m for m in methods if m.needs is None or m.needs.is_met_by(task.problem)]
    if not chosen:
        needs = " and ".join(dict.fromkeys(str(method.needs) for method in methods))
        raise typer.BadParameter(
            f"{', '.join(asked)} {needs}, which `{task.problem.name}` has not.",
            param_hint="--methods",
        )
    return chosen, [method for method in methods if method not in chosen]


def names_in(text: str, known: Iterable[str], kind: str, hint: str) -> list[str]:
    """Return the names in a list separated by commas, all of them known."""
    names = [name.strip().lower() for name in text.split(",")]
    for name in names:
        check_name(name, known, kind, hint)
    return names


def check_name(name: str, known: Iterable[str], kind: str, hint: str) -> None:
    if name not in known:
        raise typer.BadParameter(
            f"there is no {kind} {name!r}. Choose one of: {', '.join(known)}.", param_hint=hint
        )


def model_at(place: str) -> tuple[Any, Any, Any, int]:
    """Return the results of `MODULE:FUNCTION`: `F`, `x_example`, `args_example`, `order`."""
    module, _, name = place.partition(":")
    if not module or not name:
        raise typer.BadParameter(
            f"must be a module and a function in it, such as `model:pendulum`; got {place!r}.",
            param_hint="MODULE:FUNCTION",
        )
    sys.path.insert(0, str(Path.cwd()))
    try:
        function = getattr(importlib.import_module(module), name)
        model = function()
    except (ImportError, AttributeError, TypeError) as error:
        raise typer.BadParameter(f"{error}.", param_hint="MODULE:FUNCTION") from error
    finally:
        sys.path.pop(0)
    if not isinstance(model, tuple) or not 2 <= len(model) <= 4:
        raise typer.BadParameter(
            f"{place} must return `(F, x_example, args_example)`, and `order` if it is not 1.",
            param_hint="MODULE:FUNCTION",
        )
    F, x, *further = model
    args, order = (*further, *(None, 1)[len(further) :])
    return F, x, args, order  # pyright: ignore[reportReturnType]


def check_positive(value: float, option: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise typer.BadParameter(f"must be a positive number, got {value}.", param_hint=option)


def check_can_draw(path: Path | None, option: str) -> None:
    try:
        if path is not None:
            require("matplotlib", "cli", "A picture")
    except ImportError as error:
        raise typer.BadParameter(str(error), param_hint=option) from error


def check_target(path: Path | None, option: str, suffixes: tuple[str, ...] | None) -> None:
    """Raise before the computation if its result could not be written."""
    if path is None:
        return
    if suffixes is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{str(path)!r} must end in one of: {', '.join(suffixes)}.", param_hint=option
        )
    try:
        existed = path.exists()
        path.open("ab").close()
        if not existed:
            path.unlink()
    except OSError as error:
        raise typer.BadParameter(
            f"cannot write the file {str(path)!r}: {error.strerror}.", param_hint=option
        ) from error
