"""Benchmarks run with the smallest settings: for what crashes, not for what they measure."""

import contextlib
import importlib
import json
import os
import sys
from pathlib import Path

import jax
import numpy as np
import pytest


ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))

FOLDERS = ("dae_board", "peers", "sbml_events", "speed", "sympy_models", "tools")
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for folder in FOLDERS
    for path in (ROOT / "benchmarks" / folder).glob("*.py")
)
PROGRAMS = {
    module
    for module in MODULES
    if "\ndef main(" in (ROOT / f"{module.replace('.', '/')}.py").read_text()
}
# Of others, and not needed for anything else.
PEERS = ("casadi", "jax_md", "mujoco", "pinocchio", "pydiffsol", "sksundae", "yaml")
SMALLEST = {
    "benchmarks.dae_board.__main__": dict(problems="linear: generator", quick=True, repeats=1),
    "benchmarks.peers.approaches": dict(problems="pendulum", repeats=1, quick=True),
    "benchmarks.peers.impacts": dict(repeats=1, quick=True),
    "benchmarks.peers.long_times": dict(evaluations=16_000, quick=True),
    "benchmarks.peers.mujoco_peers": dict(),
    "benchmarks.peers.pendulum_peers": dict(repeats=1, quick=True),
    "benchmarks.peers.polymer": dict(bonds=6, long=1.0, repeats=1, quick=True),
    "benchmarks.sbml_events.__main__": dict(numbers="00929"),
    "benchmarks.speed.accelerator": dict(
        sizes="4", lanes="2,4", repeats=1, problems="lorenz", precisions="double"
    ),
    "benchmarks.speed.closed_forms": dict(repeats=1),
    "benchmarks.speed.compile_profile": dict(problem="pendulum", plain=True),
    "benchmarks.speed.compile_time": dict(compilations=1, repeats=1, only="pendulum"),
    "benchmarks.speed.devices": dict(size=4, repeats=1),
    "benchmarks.speed.devices_agree": dict(size=2, cases="matrices;pendulum"),
    "benchmarks.speed.ensemble": dict(
        size=4, lanes=2, repeats=1, problems="pendulum", saved=2, pendulums=4
    ),
    "benchmarks.speed.ensemble_gradients": dict(sizes="4", repeats=1, problems="pendulum"),
}
# Those that compile or train for minutes whatever their settings: imported, not run.
TOO_LONG = {
    "benchmarks.dae_board.steps",
    "benchmarks.dae_board.wheelset_reference",
    "benchmarks.peers.identification",
    "benchmarks.peers.lithium_ion",
    "benchmarks.peers.mechanisms_mujoco",
    "benchmarks.peers.neural",
    "benchmarks.peers.optimal_control",
    "benchmarks.peers.power_grid",
    "benchmarks.peers.robot_coordinates",
    "benchmarks.peers.robots",
    "benchmarks.peers.stiff",
    "benchmarks.speed.adaptive_gradients",
    "benchmarks.speed.bandwidths",
    "benchmarks.speed.dae_size",
    "benchmarks.speed.gradients",
    "benchmarks.speed.overhead",
    "benchmarks.speed.scaling",
    "benchmarks.speed.sparse_stiff",
    "benchmarks.speed.thresholds",
    "benchmarks.sympy_models.__main__",  # its parts are in test_sympy.py
}
QUICK = ("benchmarks.speed.accelerator",)


@contextlib.contextmanager
def without_peers():
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in PEERS:
            raise
        pytest.skip(f"needs {error.name}")


@pytest.fixture
def as_before(monkeypatch):
    """Benchmarks keep to one core, change settings of JAX, and are written for the usual ones."""
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    monkeypatch.setattr(os, "sched_setaffinity", lambda *args: None, raising=False)
    usual = {
        "jax_numpy_dtype_promotion": "standard",
        "jax_numpy_rank_promotion": "allow",
        "jax_enable_compilation_cache": False,
    }
    before = {name: getattr(jax.config, name) for name in usual}
    for name, value in usual.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize("name", MODULES)
def test_imports(name):
    with without_peers():
        importlib.import_module(name)


def test_every_program_is_run_or_named():
    assert PROGRAMS == set(SMALLEST) | TOO_LONG


@pytest.mark.usefixtures("as_before")
@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in SMALLEST]
)
def test_runs(name, tmp_path, capsys):
    file = tmp_path / "result.json"
    with without_peers():
        importlib.import_module(name).main(json=file, **SMALLEST[name])
    assert capsys.readouterr().out.strip()
    assert json.loads(file.read_text())["environment"]["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize("name", ["brusselator", "ladder"])
def test_jacobian_of_sparse_problems(name):
    """IDA and SciPy get it, and a wrong one would only cost them steps."""
    problem = getattr(importlib.import_module("benchmarks.speed._sparse_problems"), name)(4)
    y = np.random.default_rng(0).normal(size=problem.y0.shape)
    rates = lambda y: problem.rates(0.3, y, problem.parameter, np).ravel()
    written = np.zeros((y.size, y.size))
    for rows, columns, values in problem.jacobian(y, problem.parameter):
        written[rows, columns] = values
    for k, unit in enumerate(np.eye(y.size)):
        shift = 1e-6 * unit.reshape(y.shape)
        difference = (rates(y + shift) - rates(y - shift)) / 2e-6
        np.testing.assert_allclose(written[:, k], difference, rtol=1e-7, atol=1e-6)
