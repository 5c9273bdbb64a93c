"""The gradient certificate: what it finds, and that it can fail."""

import dataclasses
import json

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from manifold_jax import problems
from manifold_jax._certify import is_certified
from manifold_jax._certify.case import Case, differences
from manifold_jax._certify.checks import Check, Combination
from manifold_jax._cli import app
from manifold_jax._compare.approaches import APPROACHES


def run(*arguments):
    return CliRunner().invoke(app, ["certify", *arguments])


def test_differences_are_of_sixth_order():
    gradient = differences(lambda x: float(np.sin(3 * x[0]) * x[1] ** 9), np.array([0.7, 1.2]))
    expected = [3 * np.cos(2.1) * 1.2**9, np.sin(2.1) * 9 * 1.2**8]
    np.testing.assert_allclose(gradient, expected, rtol=1e-11)


def test_a_wrong_gradient_is_not_certified():
    checks = (Check("forward", 0.0, 0.0, 0.0), Check("replay", 1e-13, 1e-13, 0.0))
    good = Combination("projected", "Tsit5", differences=1e-9, checks=checks)
    assert is_certified(good)
    for wrong in (1e-9, np.nan):
        for name in ("difference", "hessian", "batch"):
            bad = dataclasses.replace(checks[1], **{name: wrong})
            assert not is_certified(dataclasses.replace(good, checks=(checks[0], bad)))
        assert not is_certified(dataclasses.replace(good, differences=max(wrong, 1e-6)))
    assert not is_certified(Combination("projected", "Tsit5", failure="the solve failed"))


def test_only_what_must_be_refused_may_be():
    good = Check("forward", 0.0, 0.0, 0.0)
    backsolve = Check("backsolve", refused="it would be wrong")
    case = lambda *checks: Combination("projected", "Tsit5", differences=0.0, checks=checks)
    assert is_certified(case(good, backsolve))
    assert not is_certified(case(good, Check("replay", refused="a mistake")))
    assert not is_certified(case(good, Check("backsolve", 0.0, 0.0, 0.0)))
    assert is_certified(case(good, Check("checkpointed", 0.0, None, 0.0)))
    assert not is_certified(case(good, Check("replay", 0.0, None, 0.0)))


def test_parameters_reach_constraint_and_start():
    """The pendulum's length is in all three; without one of them the gradient is another."""
    approach = next(a for a in APPROACHES if a.name == "projected")
    case = Case.build(problems.pendulum(), approach, dfx.Tsit5(), 1.0, 0.5, 1e-6)
    length = jnp.asarray([9.81, 1.3, 1.0])
    q = case.end(length, dfx.RecursiveCheckpointAdjoint())[:2]
    np.testing.assert_allclose(q @ q, 1.3**2, rtol=1e-14)


def test_arguments():
    assert "there is no method 'best'" in run("pendulum", "--methods", "best").output.replace(
        "\n", " "
    )
    assert run("pendulum", "--adjoints", "none").exit_code == 2
    assert run("pendulum", "--solvers", "rk4").exit_code == 2


@pytest.mark.slow
def test_command(tmp_path):
    """A conserved quantity as constraint, and the parameters in it."""
    file = tmp_path / "certificate.json"
    options = "--t1 3 --methods tangent --adjoints forward,checkpointed,replay,backsolve".split()
    options.append("--json")
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
