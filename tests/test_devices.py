"""What depends on the kind of device, on machines without others: the choice of the number of lanes, and of
implementations."""

import importlib

import diffrax as dfx
import jax
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax._base.device import platform
from manifold_jax._ensemble.api.devices import default_lanes


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_the_device_of_a_program():
    assert platform() == "cpu"
    with jax.default_device(jax.devices("cpu")[0]):
        assert platform() == "cpu"


@pytest.mark.usefixtures("as_on_a_gpu")
def test_a_device_that_is_chosen_comes_first():
    assert platform() == "gpu"
    cpu = jax.devices("cpu")[0]
    for chosen in (cpu, "cpu"):
        with jax.default_device(chosen):
            assert platform() == "cpu"
    assert platform(jax.sharding.Mesh(np.array([cpu]), ("trajectories",))) == "cpu"


@pytest.mark.usefixtures("as_on_a_gpu")
def test_many_lanes_on_a_gpu():
    assert default_lanes(None) > 1000
    with jax.default_device(jax.devices("cpu")[0]):
        assert default_lanes(None) < 1000


def test_lanes_by_default(monkeypatch):
    api = importlib.import_module("manifold_jax._ensemble.api.solve_ensemble")
    problem = mj.problems.pendulum()
    seen = []

    def solve(inputs):
        seen.append(inputs.equations.lanes)
        raise InterruptedError

    monkeypatch.setattr(api, "solve_on_one_device", solve)
    starts = jax.tree.map(lambda x: np.stack([x, x]), problem.y0)
    for lanes in (None, 3):
        with pytest.raises(InterruptedError):
            mj.solve_ensemble(
                problem.terms, dfx.Tsit5(), 0.0, 1.0, 0.1, starts, problem.args, lanes=lanes
            )
    assert seen == [128, 3]
