"""The gradient certificate: what it finds, and that it can fail."""

import dataclasses
import json
import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from manifold_jax import problems
from manifold_jax._tools.certify import ADJOINTS, certificate_notes, certificate_scope, is_certified
from manifold_jax._tools.certify.case import Case, differences, Stepping
from manifold_jax._tools.certify.checks import certify, Check, Combination
from manifold_jax._tools.certify.report import write_json
from manifold_jax._tools.cli import app
from manifold_jax._tools.compare.approaches import known_approaches


BAUMGARTE = next(a for a in known_approaches() if a.name == "baumgarte")


def run(*arguments):
    return CliRunner().invoke(app, ["certify", *arguments])


def test_differences_are_of_sixth_order():
    gradient = differences(lambda x: float(np.sin(3 * x[0]) * x[1] ** 9), np.array([0.7, 1.2]))
    expected = [3 * np.cos(2.1) * 1.2**9, np.sin(2.1) * 9 * 1.2**8]
    np.testing.assert_allclose(gradient, expected, rtol=1e-11)


def test_a_wrong_gradient_is_not_certified():
    checks = (Check("forward", 0.0, 0.0), Check("replay", 1e-13, 1e-13, 0.0))
    good = Combination("projected", "Tsit5", differences=1e-9, checks=checks)
    assert is_certified(good)
    for wrong in (1e-9, np.nan):
        for name in ("difference", "hessian", "batch"):
            bad = dataclasses.replace(checks[1], **{name: wrong})
            assert not is_certified(dataclasses.replace(good, checks=(checks[0], bad)))
        assert not is_certified(dataclasses.replace(good, differences=max(wrong, 1e-6)))
    assert not is_certified(Combination("projected", "Tsit5", failure="the solve failed"))


def test_a_gradient_that_is_not_finite_is_null_in_json(tmp_path):
    file = tmp_path / "certificate.json"
    write_json(file, {}, [Combination("projected", "Tsit5", differences=np.nan)])
    assert "NaN" not in file.read_text()
    (row,) = json.loads(file.read_text())["rows"]
    assert row["differences"] is None


def test_only_what_must_be_refused_may_be():
    good = Check("forward", 0.0, 0.0, 0.0)
    backsolve = Check("backsolve", refused="it would be wrong")
    case = lambda *checks: Combination("projected", "Tsit5", differences=0.0, checks=checks)
    assert is_certified(case(good, backsolve))
    assert not is_certified(case(good, Check("replay", refused="a mistake")))
    assert not is_certified(case(good, Check("backsolve", 0.0, 0.0, 0.0)))
    assert is_certified(case(good, Check("checkpointed", 0.0, 0.0, "refused")))
    assert not is_certified(case(good, Check("replay", 0.0, 0.0, "refused")))
    assert not is_certified(case(good, Check("replay", None, 0.0, 0.0)))


def test_the_verdict_names_what_is_wrong():
    checks = (Check("replay", 1e-13, 3.2e-9), Check("direct", refused="a mistake"))
    bad = Combination("projected", "Tsit5", differences=2e-6, checks=checks)
    assert certificate_notes(bad)[-1] == (
        "NOT CERTIFIED: replay, batch: 3.2e-09 is not within 1e-10; direct was refused (a mistake); "
        "differences: 2.0e-06 is not within 1e-07."
    )
    assert certificate_notes(dataclasses.replace(bad, failure="no solution")) == [
        "NOT CERTIFIED: no solution."
    ]


def test_the_certificate_says_what_it_does_not_cover():
    one = Combination("projected", "Tsit5", differences=0.0, checks=(Check("replay", 0.0, 0.0),))
    *_, note = certificate_scope([one], ["plain", "tangent"], [])
    assert note == (
        "Not covered: methods plain, tangent; adjoints checkpointed, direct, backsolve; "
        "Hessian-vector products; solvers other than Tsit5; other tolerances."
    )
    checks = tuple(Check(name, 0.0, 0.0, 0.0) for name in ADJOINTS)
    *_, left_out, note = certificate_scope(
        [dataclasses.replace(one, checks=checks)], [], [BAUMGARTE]
    )
    assert left_out == "Left out: baumgarte, which needs a mechanical system without jumps."
    assert note == "Not covered: solvers other than Tsit5; other tolerances."


def test_parameters_reach_constraint_and_start():
    """The pendulum's length is in all three; without one of them the gradient is another."""
    approach = next(a for a in known_approaches() if a.name == "projected")
    case = Case.build(problems.pendulum(), approach, dfx.Tsit5(), 1.0, 0.5, 1e-6)
    length = jnp.asarray([9.81, 1.3, 1.0])
    for stepping in (case.adaptive, case.frozen):
        q = case.end(length, dfx.RecursiveCheckpointAdjoint(), stepping)[:2]
        np.testing.assert_allclose(q @ q, 1.3**2, rtol=1e-14)


class WrongWithAdaptiveSteps(Case):
    """Squares in place of a solve; the reverse derivative is wrong where steps are adaptive."""

    def end(self, theta, adjoint, stepping):
        y = jnp.concatenate([theta, theta[:1]]) ** 2
        wrong = stepping is self.adaptive and isinstance(adjoint, dfx.RecursiveCheckpointAdjoint)
        return y + 1e-9 * (y - jax.lax.stop_gradient(y)) if wrong else y


def test_adjoints_are_compared_with_steps_that_are_chosen_anew():
    problem, approach = problems.pendulum(), known_approaches()[1]
    adaptive = Stepping(dfx.Tsit5(), dfx.PIDController(rtol=1e-6, atol=1e-6), 9)
    frozen = adaptive._replace(controller=dfx.ConstantStepSize())
    case = WrongWithAdaptiveSteps(problem, approach, 1.0, 1.0, adaptive, frozen)
    adjoints = {name: ADJOINTS[name] for name in ("checkpointed", "replay")}
    found = certify(case, adjoints, hessian=False)
    assert found.differences < 1e-11
    checkpointed, replay = found.checks
    np.testing.assert_allclose([checkpointed.difference, checkpointed.batch], 1e-9, rtol=1e-3)
    assert max(replay.difference, replay.batch) < 1e-14
    assert not is_certified(found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pendulums",), "there is no problem 'pendulums'"),
        (("pendulum", "--methods", "best"), "there is no method 'best'"),
        (
            ("kepler", "--methods", "baumgarte"),
            "needs a mechanical system without jumps, which `kepler` has not",
        ),
        (("pendulum", "--adjoints", "none"), "there is no adjoint 'none'. Choose one of: forward"),
        (("pendulum", "--solvers", "rk4"), "there is no solver 'rk4'. Choose one of: heun"),
        (("pendulum", "--tolerance", "0"), "--tolerance: must be a positive number, got 0.0"),
        (("pendulum", "--tolerance=-1e-6"), "--tolerance: must be a positive number, got -1e-06"),
        (("pendulum", "--json", "a" * 300), "File name too long"),
    ],
)
def test_mistakes_are_explained(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in " ".join(re.sub("[│╭╮╰╯─]", " ", result.output).split())


@pytest.mark.slow
def test_command(tmp_path):
    """A conserved quantity as constraint, and the parameters in it."""
    file = tmp_path / "certificate.json"
    options = "--t1 3 --methods tangent --adjoints forward,checkpointed,replay,backsolve".split()
    options += ["--hessian", "--json"]
    result = run("rigid-body", *options, str(file))
    assert result.exit_code == 0, result.output
    (row,) = json.loads(file.read_text())["rows"]
    assert row["certified"]
    assert row["tangency"] < 1e-12
    ways = {check["adjoint"]: check for check in row["checks"]}
    assert "BacksolveAdjoint" in ways["backsolve"]["refused"]
    assert ways["checkpointed"]["hessian"] < 1e-10
    assert ways["replay"]["hessian"] < 1e-10
    assert ways["replay"]["difference"] < 1e-12
