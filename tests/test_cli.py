import dataclasses
import json
import math
import re
import sys
from decimal import Decimal

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import manifold_jax as mj
from manifold_jax import problems
from manifold_jax._tools.cli import app
from manifold_jax._tools.compare import approaches, figure, methods, paper, report, with_diffrax
from manifold_jax._tools.compare.task import SolveFailed, Task


ROW_KEYS = {
    "method",
    "accepted",
    "rejected",
    "evaluations",
    "violation_steps",
    "violation_output",
    "error",
    "run_ms",
    "compile_s",
}


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def method(key):
    (chosen,) = (method for method in methods.METHODS if method.key == key)
    return chosen


def unframed(text):
    """Without the frame around it and its line breaks."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


def strict_json(path):
    def refuse(constant):
        raise ValueError(f"{constant} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


# list


def test_list_has_every_problem():
    result = run("list")
    assert result.exit_code == 0
    lines = [line.split() for line in result.stdout.splitlines() if line.strip()]
    gallery = problems.ALL | problems.FURTHER
    sizes = {line[0]: line[1:3] for line in lines if line[0] in gallery}
    assert list(sizes) == list(gallery)
    assert sizes["pendulum"] == ["4", "2"]
    assert sizes["sphere-flow"] == ["10", "1"]
    assert sizes["rotation"] == ["9", "6"]
    (car_axis,) = (line for line in result.stdout.splitlines() if "car-axis" in line)
    assert "at the end" in car_axis
    assert "A car axis between two springs" in car_axis


def test_summaries_are_one_line_without_mathematics():
    for build in (problems.ALL | problems.FURTHER).values():
        summary = report.summary(build)
        assert 10 < len(summary) < 100
        assert not set("$\\\n") & set(summary)


# compare


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    files = folder / "rows.json", folder / "picture.png"
    result = run("compare", "rigid-body", "--rtol", "1e-5", "--json", files[0], "--plot", files[1])
    assert result.exit_code == 0, result.output
    return result, *files


def rows_of(comparison):
    return {row["method"]: row for row in strict_json(comparison[1])["rows"]}


def test_compare_writes_the_table_as_json(comparison):
    content = strict_json(comparison[1])
    assert set(content) == {"problem", "settings", "rows"}
    assert content["problem"] == "rigid-body"
    settings = content["settings"]
    assert settings["solver"] == "tsit5"
    assert (settings["rtol"], settings["atol"]) == (1e-5, 1e-6)
    assert (settings["t0"], settings["t1"]) == (0.0, 30.0)
    assert settings["gain"] == 1.0
    assert settings["max_steps"] == 4096
    assert settings["output_points"] == 1001
    assert settings["failures"] == {}
    assert settings["left_out"] == {
        "baumgarte tsit5": "needs a mechanical system without jumps",
        "lie-group tsit5": "needs a chart of its own",
    }
    approaches = ["plain", "projected", "one-step", "invariant", "exact", "tangent", "partition"]
    names = [f"{approach} tsit5" for approach in approaches]
    names += ["scipy RK45", "scipy DOP853", "scipy LSODA"]
    assert [row["method"] for row in content["rows"]] == names
    assert all(set(row) == ROW_KEYS for row in content["rows"])


def test_compare_knows_every_number_that_can_be_known(comparison):
    for method, row in rows_of(comparison).items():
        unknown = {key for key, value in row.items() if value is None}
        assert unknown == ({"rejected", "compile_s"} if "scipy" in method else set())
        numbers = [value for value in row.values() if isinstance(value, int | float)]
        assert np.all(np.isfinite(numbers))
        assert row["run_ms"] > 0
        assert row["error"] < 1e-3


def test_compare_shows_which_methods_keep_the_constraint(comparison):
    rows = rows_of(comparison)
    for name in ("projected tsit5", "tangent tsit5", "partition tsit5"):
        row = rows.pop(name)
        assert row["violation_steps"] <= 1e-12
        assert row["violation_output"] <= 1e-12
    one_step = rows.pop("one-step tsit5")
    assert 1e-14 < one_step["violation_steps"] <= 1e-9
    assert 1e-14 < one_step["violation_output"] <= 1e-9
    for row in rows.values():
        assert row["violation_steps"] > 1e-8
        assert row["violation_output"] > 1e-8


def test_compare_prints_what_it_writes(comparison):
    result, path, _ = comparison
    for row in strict_json(path)["rows"]:
        key = next(
            m.key for m in methods.METHODS if m.label.format(solver="tsit5") == row["method"]
        )
        (line,) = (line for line in result.stdout.splitlines() if line.startswith(f"{key} "))
        cells = line.split()[1:]
        assert cells[0] == str(row["accepted"])
        assert cells[2] == str(row["evaluations"])
        assert cells[4] == f"{row['violation_output']:.1e}"
        assert cells[5] == f"{row['error']:.1e}"
    assert "Step limit chosen for Diffrax: 4096" in result.stdout
    assert "(invariant, exact) with gain 1 per unit of time" in result.stdout
    assert "Left out: baumgarte, which needs a mechanical system without jumps" in result.stdout


def test_compare_draws_a_picture(comparison):
    content = comparison[2].read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) > 20_000


# of the rigid body, with the gain 1 that is the default there
BY_HAND = {
    "plain": lambda solver, constraint: solver,
    "projected": mj.Projected,
    "exact": lambda solver, constraint: mj.Stabilized(
        solver, constraint, stabilization=mj.ExactStabilization(1.0)
    ),
    "partition": lambda solver, constraint: mj.LocalCoordinates(
        solver, constraint, chart=mj.CoordinatePartitionChart()
    ),
}


@pytest.mark.parametrize("approach", BY_HAND)
def test_compare_numbers_are_those_of_a_solve_by_hand(comparison, approach):
    row = rows_of(comparison)[f"{approach} tsit5"]
    problem = problems.rigid_body()
    solver = BY_HAND[approach](dfx.Tsit5(), problem.constraint)
    solve = dfx.diffeqsolve if approach == "plain" else mj.diffeqsolve
    calls = []

    def field(t, y, args):
        jax.debug.callback(lambda: calls.append(None))
        return problem.terms.vf(t, y, args)

    times = np.linspace(0, 30, 1001)
    sol = solve(
        dfx.ODETerm(field),
        solver,
        0.0,
        30.0,
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-6),
    )
    jax.effects_barrier()
    assert row["accepted"] == sol.stats["num_accepted_steps"]
    assert row["rejected"] == sol.stats["num_rejected_steps"]
    assert row["evaluations"] == len(calls)
    y, inertia = np.asarray(sol.ys), np.asarray(problem.args.inertia)
    invariants = np.stack([np.sum(y**2, axis=1), np.sum(y**2 / inertia, axis=1) / 2])
    violation = np.max(np.abs(invariants - invariants[:, :1]))
    # rounding of the invariants themselves, for the projected method
    assert row["violation_output"] == pytest.approx(violation, rel=1e-6, abs=2e-15)
    error = np.max(np.abs(y - problem.reference(times)))
    assert row["error"] == pytest.approx(error, rel=1e-6)


def test_compare_baumgarte_is_that_of_a_system_built_by_hand(tmp_path):
    path = tmp_path / "rows.json"
    arguments = ("--methods", "baumgarte", "--gain", "2", "--json", path)
    result = run("compare", "pendulum", *arguments)
    assert "(baumgarte) with gain 2 per unit of time" in result.stdout
    content = strict_json(path)
    assert content["settings"]["gain"] == 2.0
    (row,) = content["rows"]
    assert row["method"] == "baumgarte tsit5"
    system = mj.MechanicalSystem(
        1.0,
        lambda t, q, args: q @ q - 1.0,
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
        stabilization=mj.Baumgarte(2.0, 2.0),
    )
    sol = dfx.diffeqsolve(
        system.terms,
        dfx.Tsit5(),
        0.0,
        10.0,
        None,
        (jnp.array([1.0, 0.0]), jnp.zeros(2)),
        saveat=dfx.SaveAt(ts=jnp.linspace(0, 10, 1001)),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    assert row["accepted"] == sol.stats["num_accepted_steps"]
    q, v = sol.ys
    violation = np.max(np.abs([np.sum(q * q, axis=1) - 1, 2 * np.sum(q * v, axis=1)]))
    assert row["violation_output"] == pytest.approx(violation, rel=1e-4)


def test_compare_runs_the_methods_asked_for_in_the_order_of_the_table(tmp_path):
    path = tmp_path / "rows.json"
    arguments = ("--methods", "SciPy-LSODA, scipy-rk45,scipy-rk45", "--json", path)
    result = run("compare", "harmonic-oscillator", *arguments)
    assert [row["method"] for row in strict_json(path)["rows"]] == ["scipy RK45", "scipy LSODA"]
    assert strict_json(path)["settings"]["left_out"] == {}
    for absent in ("plain", "Stabilization", "Left out", "Step limit"):
        assert absent not in result.stdout


def test_violations_are_absolute_and_the_largest_of_all_equations():
    task = Task(problems.pendulum(), "tsit5", 1e-6, 1e-6, 10.0, 3.0)
    rows = np.array([[1.0, 0.0, 0.0, 2.0], [0.5, 0.0, 0.1, 0.0], [1.1, 0.0, -3.0, 0.0]])
    violations = task.violations(np.zeros(3), rows)
    assert violations == pytest.approx([0.0, 0.75, 6.6], rel=1e-15)


def test_compare_counts_evaluations_of_explicit_methods_without_a_reused_stage():
    # two stages, both anew in each step, and two more to choose the first step
    task = Task(problems.harmonic_oscillator(), "heun", 1e-3, 1e-3, 1.0, 3.0)
    row = methods.measure(task, method("projected")).row
    assert row.evaluations == 2 * (row.accepted + row.rejected) + 2


def test_compare_counts_evaluations_of_implicit_methods(tmp_path):
    path = tmp_path / "rows.json"
    arguments = ("--solver", "Kvaerno3", "--rtol", "1e-3", "--t1", "1", "--methods", "plain")
    assert run("compare", "jay2", *arguments, "--json", path).exit_code == 0
    (row,) = strict_json(path)["rows"]
    assert row["method"] == "plain kvaerno3"
    # three implicit stages with at least one Newton iteration each
    assert row["evaluations"] > 3 * (row["accepted"] + row["rejected"])


def test_compare_doubles_the_step_limit_until_the_solve_finishes(monkeypatch, tmp_path):
    monkeypatch.setattr(with_diffrax, "FIRST_MAX_STEPS", 4)
    path = tmp_path / "rows.json"
    result = run("compare", "harmonic-oscillator", "--methods", "plain", "--json", path)
    content = strict_json(path)
    limit, (row,) = content["settings"]["max_steps"], content["rows"]
    assert math.log2(limit / 4).is_integer()
    assert limit / 2 < row["accepted"] + row["rejected"] <= limit
    assert row["violation_steps"] > 0
    assert f"Step limit chosen for Diffrax: {limit}." in result.stdout


def test_compare_reports_failures_in_their_row(monkeypatch, tmp_path):
    monkeypatch.setattr(with_diffrax, "FIRST_MAX_STEPS", 2)
    monkeypatch.setattr(with_diffrax, "LAST_MAX_STEPS", 4)

    def broken(task):
        raise ZeroDivisionError("a bug\nwith details")

    def hopeless(task):
        raise SolveFailed("no hope")

    monkeypatch.setattr(
        methods,
        "METHODS",
        (
            method("plain"),
            methods.Method("broken", broken),
            methods.Method("hopeless", hopeless),
            method("scipy-rk45"),
        ),
    )
    path, picture = tmp_path / "rows.json", tmp_path / "picture.svg"
    result = run("compare", "jay2", "--json", path, "--plot", picture)
    assert result.exit_code == 0, result.output
    content = strict_json(path)
    assert content["settings"]["failures"] == {
        "plain tsit5": "not finished after 4 steps",
        "broken": "ZeroDivisionError: a bug",
        "hopeless": "no hope",
    }
    *failed, scipy = content["rows"]
    assert all(set(row.values()) == {row["method"], None} for row in failed)
    assert scipy["error"] < 1e-4
    assert "plain failed: not finished after 4 steps" in result.stdout
    assert "hopeless failed: no hope" in result.stdout
    assert "<svg" in picture.read_text()


def test_compare_does_not_invent_errors_at_times_without_a_known_solution(tmp_path):
    path, picture = tmp_path / "rows.json", tmp_path / "picture.png"
    common = ("compare", "lotka-volterra", "--methods", "scipy-rk45", "--json", path)
    standard = run(*common, "--plot", picture)
    assert 0 < strict_json(path)["rows"][0]["error"] < 1e-3
    assert "known at t = 10 only" in standard.stdout
    other = run(*common, "--t1", "5", "--plot", picture)
    assert strict_json(path)["settings"]["t1"] == 5
    assert strict_json(path)["rows"][0]["error"] is None
    assert "not known for this time span" in other.stdout


def test_compare_draws_every_kind_of_state(tmp_path):
    for name in ("pendulum", "rotation", "car-axis"):
        picture = tmp_path / f"{name}.png"
        arguments = ("--methods", "scipy-dop853", "--plot", picture)
        assert run("compare", name, *arguments).exit_code == 0
        assert picture.stat().st_size > 20_000


@pytest.mark.parametrize("solver", with_diffrax.SOLVERS)
def test_every_solver_is_in_the_help(solver):
    assert solver in re.findall(r"\w+", run("compare", "--help").stdout)


def test_every_method_is_in_the_help_and_has_a_style():
    names = [method.key for method in methods.METHODS]
    assert f"Only these: {', '.join(names)}." in unframed(run("compare", "--help").stdout)
    assert list(figure.STYLES) == names
    assert len(set(figure.STYLES.values())) == len(names)


def test_approaches_of_other_packages_are_found(monkeypatch):
    class Point:
        name = "mine"

        def load(self):
            return dataclasses.replace(approaches.known_approaches()[0], name="mine")

    found = lambda group: [Point()] if group == "manifold_jax.approaches" else []
    monkeypatch.setattr(approaches, "entry_points", found)
    assert [approach.name for approach in approaches._of_other_packages()] == ["mine"]


def test_an_approach_for_some_problems(tmp_path):
    """The exact chart of rotations: one turn is exact to rounding."""
    path = tmp_path / "rows.json"
    result = run("compare", "rotation", "--methods", "lie-group", "--json", path)
    assert result.exit_code == 0, result.output
    (row,) = strict_json(path)["rows"]
    assert row["method"] == "lie-group tsit5"
    assert row["error"] < 1e-12
    assert row["violation_output"] < 1e-15


# errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pendulums",), "Choose one of: harmonic-oscillator, pendulum, rigid-body"),
        (("pendulum", "--solver", "rk4"), "Choose one of: heun, midpoint, ralston, bosh3, tsit5"),
        (("pendulum", "--solver", "euler"), "there is no solver 'euler'"),
        (("pendulum", "--rtol", "0"), "must be a positive number, got 0.0"),
        (("pendulum", "--atol", "-1e-6"), "must be a positive number, got -1e-06"),
        (("pendulum", "--atol", "nan"), "must be a positive number, got nan"),
        (("pendulum", "--gain", "0"), "must be a positive number, got 0.0"),
        (("pendulum", "--methods", "plain,rattle"), "there is no method 'rattle'. Choose one of"),
        (
            ("pendulum", "--methods", ""),
            "partition, lie-group, scipy-rk45, scipy-dop853, scipy-lsoda",
        ),
        (
            ("kepler", "--methods", "baumgarte"),
            "mechanical system without jumps, which `kepler` has not",
        ),
        (("pendulum", "--t1", "0"), "must be later than the start of `pendulum`, t0 = 0"),
        (("arevalo", "--t1", "0.5"), "t0 = 1; got 0.5"),
        (("pendulum", "--plot", "picture.gif"), "must end in one of: .png"),
        (("pendulum", "--json", "no/such/folder/rows.json"), "No such file or directory"),
        (("pendulum", "--plot", "."), "must end in one of: .png"),
        (("pendulum", "--json", "."), "cannot write the file '.': Is a directory"),
        # what only an attempt to write it can tell, also of folders without permission
        (("pendulum", "--json", "a" * 300), "File name too long"),
        (("pendulum", "--plot", f"{'a' * 300}.png"), "File name too long"),
    ],
)
def test_mistakes_are_explained(arguments, message):
    result = run("compare", *arguments)
    assert result.exit_code == 2
    text = unframed(result.output)
    assert message in text
    assert "Traceback" not in text


def test_looking_whether_files_can_be_written_leaves_nothing_behind(tmp_path):
    new, old = tmp_path / "new.json", tmp_path / "old.json"
    old.write_text("kept")
    for path in (new, old):
        assert run("compare", "pendulum", "--json", path, "--plot", "x.gif").exit_code == 2
    assert not new.exists()
    assert old.read_text() == "kept"


# paper

# Table 1, recomputed: tau, h, N, g(x_N), error, projected error, gain.
TABLE_1 = (
    ("1e-1", "4.4721e-1", 15, "14.40702", "3.0293", "3.9752e-1", "7.6"),
    ("1e-2", "1.4142e-1", 45, "1.437854", "5.6380e-1", "4.1921e-2", "13.4"),
    ("1e-3", "4.4721e-2", 141, "3.254054e-1", "1.5133e-1", "4.1988e-3", "36.0"),
    ("1e-4", "1.4142e-2", 445, "9.307093e-2", "4.5502e-2", "4.1950e-4", "108.5"),
    ("1e-5", "4.4721e-3", 1405, "2.849824e-2", "1.4149e-2", "4.1889e-5", "337.8"),
    ("1e-6", "1.4142e-3", 4443, "8.925589e-3", "4.4529e-3", "4.1889e-6", "1063"),
    ("1e-7", "4.4721e-4", 14050, "2.813951e-3", "1.4060e-3", "4.1889e-7", "3356"),
    ("1e-8", "1.4142e-4", 44429, "8.889749e-4", "4.4439e-4", "4.1888e-8", "10609"),
)


@pytest.fixture(scope="module")
def paper_rows():
    return list(paper.paper_rows())


def agrees(value, printed):
    """To half a unit in the last printed digit."""
    return abs(Decimal(value) - Decimal(printed)) <= Decimal((0, (5,), _exponent(printed) - 1))


def _exponent(printed):
    return Decimal(printed).as_tuple().exponent


@pytest.mark.parametrize("line", range(8))
def test_paper_has_the_published_digits(paper_rows, line):
    row = paper_rows[line]
    tau, h, N, g, error, projected_error, gain = TABLE_1[line]
    assert row.tau == float(tau)
    assert row.N == N
    assert agrees(row.h, h)
    assert agrees(row.closed_form, g)
    assert agrees(row.run, g)
    assert agrees(row.error, error)
    assert agrees(row.projected_error, projected_error)
    assert agrees(row.gain, gain)


def test_paper_runs_agree_with_closed_forms(paper_rows):
    for row in paper_rows:
        g = math.expm1(row.N * math.log1p(2 * row.tau))
        assert row.closed_form == pytest.approx(g, rel=1e-13)
        assert row.run == pytest.approx(g, rel=1e-10)
        # Euler turns by atan h instead of h in each step; the distance is a chord
        lag = row.N * (row.h - math.atan(row.h))
        radius = math.sqrt(1 + g)
        distance = math.hypot(radius * math.cos(lag) - 1, radius * math.sin(lag))
        assert row.error == pytest.approx(distance, rel=1e-9)
        # N roundings of x, relative to the error that is left
        rounding = 1e-15 * math.sqrt(row.N) / row.projected_error
        chord = 2 * math.sin(lag / 2)
        assert row.projected_error == pytest.approx(chord, rel=1e-10 + 10 * rounding)


def test_paper_keeps_the_circle(paper_rows):
    # The correction is content with 4 rounding units of the scaled residual, and the scale
    # max_j |G_ij| (|x_j| + 1) is at most 4 on the circle.
    for row in paper_rows:
        assert 0 < row.violation <= 16 * np.finfo(float).eps


def test_paper_keeps_the_circle_to_the_last_bit(paper_rows):
    assert max(row.violation for row in paper_rows) <= 5e-16


def test_paper_prints_its_rows(paper_rows, monkeypatch):
    monkeypatch.setattr(paper, "paper_rows", lambda: iter(paper_rows))
    result = run("paper")
    assert result.exit_code == 0
    lines = [line.split() for line in result.stdout.splitlines() if re.match(r" *1e-\d ", line)]
    assert len(lines) == len(TABLE_1)
    for line, (tau, h, N, g, error, projected_error, gain) in zip(lines, TABLE_1, strict=True):
        violation = line.pop(6)
        assert line == [tau, h, str(N), g, g, error, projected_error, gain]
        assert re.fullmatch(r"\de-1[5-6]", violation)


# start


def test_importing_the_command_line_does_not_change_the_precision(tmp_path):
    import subprocess
    import sys

    code = "import manifold_jax._tools.cli, jax; print(jax.config.jax_enable_x64)"
    command = [sys.executable, "-c", code]
    environment = {"JAX_ENABLE_X64": "0", "JAX_PLATFORMS": "cpu", "HOME": str(tmp_path)}
    output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "False"


def test_module_runs_as_a_program():
    import subprocess
    import sys

    command = [sys.executable, "-m", "manifold_jax", "--help"]
    output = subprocess.run(command, capture_output=True, text=True, check=True)
    for name in ("list", "compare", "paper"):
        assert name in output.stdout


# reduce


MODEL = """
import jax.numpy as jnp

def pendulum():
    def F(t, x, xdot, args):
        q, v = x["q"], x["v"]
        force = jnp.stack([0 * args["g"], args["g"]])
        return {"rates": xdot["q"] - v, "motion": xdot["v"] + x["pull"] * q + force, "rod": q @ q - 1}
    return F, {"q": jnp.ones(2), "v": jnp.ones(2), "pull": 0.0}, {"g": 9.81}

def second_order():
    return lambda t, x, xdot, xddot, args: xddot + x, jnp.ones(2), None, 2

def singular():
    return lambda t, x, xdot, args: jnp.stack([x[0] - 1, x[0] - t]), jnp.ones(2)

def nothing():
    return 1
"""


@pytest.fixture
def model(tmp_path, monkeypatch):
    (tmp_path / "some_model.py").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "some_model", raising=False)


def test_reduce_prints_the_structure(model):
    result = run("reduce", "some_model:pendulum")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0].startswith("index 3, 2 degrees of freedom")
    assert ["rod", ".", "0", "0", ".", ".", "2"] in [line.split() for line in lines]
    assert "state: q[0], q[1], v[0], v[1]" in lines
    second = run("reduce", "some_model:second_order")
    assert "state: x[0], x[1], x[0]', x[1]'" in second.stdout


def test_reduce_says_what_is_wrong(model):
    result = run("reduce", "some_model:singular")
    assert result.exit_code == 1
    assert "structurally singular" in result.stdout
    for place, message in (
        ("some_model", "must be a module and a function"),
        ("some_model:absent", "no attribute 'absent'"),
        ("absent_model:pendulum", "No module named 'absent_model'"),
        ("some_model:nothing", "must return"),
    ):
        wrong = run("reduce", place)
        assert wrong.exit_code == 2
        assert message in unframed(wrong.stderr)
