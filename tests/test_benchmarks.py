"""Every benchmark runs: with the smallest settings, for what crashes, not for what it measures."""

import contextlib
import importlib
import json
import os
import sys
from pathlib import Path

import jax
import pytest


ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))

MODULES = sorted(path.stem for path in (ROOT / "benchmarks").glob("[a-z_]*.py"))
# Of others, and not needed for anything else.
PEERS = ("casadi", "mujoco", "pydiffsol", "sksundae")
# Without those that compile or train for a minute and more (`gradients`, `neural`, `overhead`, `thresholds`) and
# `fuzz`, which has tests of its own.
SMALLEST = {
    "accelerator": dict(sizes="4", lanes=2, repeats=1, problems="lorenz", precisions="double"),
    "approaches": dict(problems="pendulum", repeats=1, quick=True),
    "closed_forms": dict(repeats=1),
    "compile_time": dict(compilations=1, repeats=1, only="pendulum"),
    "dae_board": dict(problems="linear: generator", quick=True, repeats=1),
    "devices": dict(size=4, repeats=1),
    "ensemble": dict(size=4, lanes=2, repeats=1, problems="pendulum", saved=2, pendulums=4),
    "mujoco_peers": dict(),
    "pendulum_peers": dict(repeats=1),
    "polymer": dict(bonds=6, long=1.0, repeats=1, quick=True),
}
QUICK = ("accelerator",)


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
        importlib.import_module(f"benchmarks.{name}")


@pytest.mark.usefixtures("as_before")
@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in SMALLEST]
)
def test_runs(name, tmp_path, capsys):
    file = tmp_path / "result.json"
    with without_peers():
        importlib.import_module(f"benchmarks.{name}").main(json=file, **SMALLEST[name])
    assert capsys.readouterr().out.strip()
    assert json.loads(file.read_text())["environment"]["versions"]["jax"] == jax.__version__
