"""What an editor tells users about their calls."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from documents import blocks_of, ROOT

import manifold_jax


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("basedpyright", path=Path(sys.executable).parent) is None,
        reason="needs basedpyright",
    ),
]

SETUP = """
import diffrax as dfx, jax.numpy as jnp, manifold_jax as mj
from jax import Array
from typing import assert_type, NamedTuple

class State(NamedTuple):
    q: Array
    v: Array

rod = mj.Constraint(lambda t, y, args: y.q @ y.q - 1)
y = State(jnp.ones(2), jnp.ones(2))
hook = mj.Projected(dfx.Tsit5(), rod)
term = dfx.ODETerm(lambda t, y, args: y)
"""
RIGHT = [
    "assert_type(mj.project(rod, 0.0, y), tuple[State, mj.ProjectionInfo])",
    "assert_type(mj.consistent_state(rod, 0.0, y)[0], State)",
    "assert_type(mj.diffeqsolve(term, hook, 0.0, 1.0, None, y), mj.Solution)",
    "mj.Projected(dfx.Tsit5(), rod, projection=mj.NewtonProjection(max_steps=1))",
]
WRONG = [
    "mj.project(0.0, rod, y)",
    "mj.project(rod, 0.0, y, tolerance=1e-3)",
    "mj.Projected(rod, dfx.Tsit5())",
    "mj.Projected(dfx.Tsit5(), rod, max_steps=1)",
    "mj.diffeqsolve(term, hook, 0.0, 1.0, y)",
    "mj.diffeqsolve(lambda t, y, args: y, hook, 0.0, 1.0, None, y)",
    "mj.diffeqsolve(term, hook, 0.0, 1.0, None, y, rtol=1e-6)",
    "mj.diffeqsolve(term, hook, 0.0, 1.0, None, y, consistent='yes')",
    "mj.NewtonProjection(max_steps='many')",
    "mj.solve_ensemble(term, hook, 0.0, 1.0, None)",
    "mj.reduce_dae(lambda t, x, xdot, args: x, jnp.ones(2), form='index1')",
    "mj.fit(1, 2)",
    "mj.no_such_name",
]


def errors_in(folder):
    """Names of files and numbers of lines."""
    root = Path(manifold_jax.__file__).parents[1]
    settings = f'{{"typeCheckingMode": "basic", "extraPaths": ["{root}"]}}'
    (folder / "pyrightconfig.json").write_text(settings)
    command = [Path(sys.executable).with_name("basedpyright"), "--pythonpath", sys.executable]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    errors = [text.split(":")[:2] for text in run.stdout.splitlines() if " - error: " in text]
    return {(Path(name.strip()).name, int(line)) for name, line in errors}


def test_wrong_calls_are_errors_and_right_ones_and_those_of_the_readme_are_not(tmp_path):
    (tmp_path / "script.py").write_text("\n".join([SETUP, *RIGHT, *WRONG]))
    (tmp_path / "readme.py").write_text("\n".join(blocks_of(ROOT / "README.md")))
    first = len(SETUP.splitlines()) + len(RIGHT) + 2
    assert errors_in(tmp_path) == {("script.py", first + i) for i in range(len(WRONG))}
