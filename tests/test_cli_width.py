"""What the command line prints in terminals of any width, and in files."""

import collections
import io
import re

import pytest
from rich.console import Console
from typer.testing import CliRunner

from manifold_jax._tools import certify as _certify
from manifold_jax._tools.certify.checks import Check, Combination
from manifold_jax._tools.cli import app, commands
from manifold_jax._tools.compare import methods, paper, report


WIDTHS = (40, 60, 80, 100, 120)


def measured(task, method):
    """Without a solve; figures as long as they get, and a failure."""
    row = methods.Row(
        method.name(task),
        accepted=1048576,
        rejected=262144,
        evaluations=7340032,
        violation_steps=1.1e-16,
        violation_output=2.2e-102,
        error=3.3e-05,
        run_ms=12345.0,
        compile_s=123.45,
    )
    if method.key != "exact":
        return methods.Measurement(method.key, row, max_steps=1048576)
    return methods.Measurement(method.key, methods.Row(row.method), failure="no [hope] at 1.5e-12")


def line_of_table_1():
    yield paper.PaperRow(
        1e-8,
        1.41421356e-4,
        44429,
        8.8897494e-4,
        8.8897494e-4,
        4.44391e-4,
        4e-16,
        4.18881e-8,
        10609.0,
    )


def certified(task, approaches, solvers, adjoints, *options):
    for approach in approaches:
        checks = (
            Check("checkpointed", 2.1e-15, 3.3e-15, "refused", 1234.56, 123.4, 12345678),
            Check("replay", 4.1e-15, 5.3e-11, 6.5e-14, 0.56, 12.3, 12345),
            Check("backsolve", refused="wrong gradients"),
        )
        rest = dict(steps=16383, differences=7.1e-12, exact=8.1e-06, tangency=9.1e-17)
        yield approach.name, Combination(approach.name, "ImplicitEuler", checks=checks, **rest)


COMMANDS = {
    "list": ("list",),
    "compare": ("compare", "pendulum", "--solver", "impliciteuler"),
    "certify": ("certify", "pendulum", "--methods", "projected,one-step"),
    "paper": ("paper",),
}


@pytest.fixture(autouse=True)
def nothing_is_solved(monkeypatch):
    monkeypatch.setattr(methods, "measure", measured)
    monkeypatch.setattr(paper, "paper_rows", line_of_table_1)
    monkeypatch.setattr(_certify, "combinations", certified)


def printed(monkeypatch, command, width):
    file = io.StringIO()
    terminal = Console(file=file, width=width, force_terminal=True, color_system=None)
    monkeypatch.setattr(commands, "output_console", lambda: terminal)
    result = CliRunner().invoke(app, COMMANDS[command])
    assert result.exit_code == 0, result.output
    return file.getvalue()


def words(text):
    return collections.Counter(re.sub("[─━┏┓┃┡╇┩│└┴┘├┼┤┳]", " ", text).split())


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_cut_in_a_terminal(monkeypatch, command):
    complete = words(printed(monkeypatch, command, 1000))
    for width in WIDTHS:
        text = printed(monkeypatch, command, width)
        assert max(map(len, text.splitlines())) <= width
        assert complete <= words(text), (width, complete - words(text))


def test_the_readme_command_fits_into_80_columns(monkeypatch):
    usual = lambda task, method: methods.Measurement(
        method.key, methods.Row(method.name(task), 170, 31, 120912, 8.9e-16, 8.9e-16, 1.8e-4, 54.4)
    )
    monkeypatch.setattr(methods, "measure", usual)
    text = printed(monkeypatch, "compare", 80)
    assert text.count("accepted") == 1
    (line,) = (line for line in text.splitlines() if line.startswith("baumgarte"))
    assert line.split() == "baumgarte 170 31 120912 8.9e-16 8.9e-16 1.8e-04 54.4 -".split()


def test_a_certificate_fits_into_80_columns(monkeypatch):
    text = printed(monkeypatch, "certify", 80)
    assert text.count("adjoint ") == 2
    assert text.count("Certified.") == 2


def test_files_get_whole_lines():
    result = CliRunner().invoke(app, COMMANDS["compare"], env={"COLUMNS": "40"})
    (line,) = (line for line in result.stdout.splitlines() if line.startswith("projected"))
    assert line.split() == (
        "projected 1048576 262144 7340032 1.1e-16 2.2e-102 3.3e-05 12345 123.45".split()
    )
    assert "exact failed: no [hope] at 1.5e-12." in result.stdout


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.234, "1.23"),
        (12.34, "12.3"),
        (123.4, "123"),
        (12345.0, "12345"),
        (None, "-"),
        ("no", "no"),
    ],
)
def test_three_digits_and_all_before_the_point(value, text):
    assert report.format_number(value, ".3g") == text
