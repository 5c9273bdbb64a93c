"""The README's examples run and do what the text says, each alone and one after the other."""

import ast
import builtins
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from documents import blocks_of, ROOT, run


README = ROOT / "README.md"
BLOCKS = blocks_of(README)
# What the others need of the first one, as the text says: the imports and the setting.
PREAMBLE = BLOCKS[0].split("\n\n\n")[0]
NAMES = ["first solve", "mechanism", "dae", "many and gradients"]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Examples may write files."""
    monkeypatch.chdir(tmp_path)


def check_first_solve(namespace):
    q, v = namespace["sol"].ys
    assert np.abs(np.sum(np.square(q), axis=-1) - 1).max() <= 1e-15
    assert np.abs(np.sum(q * v, axis=-1)).max() <= 2e-15


def check_mechanism(namespace):
    q = np.asarray(namespace["motion"].ys[0][-1])
    np.testing.assert_allclose(np.linalg.norm([q[0], q[1] - q[0]], axis=1), 1, atol=1e-15)
    rods, final, multipliers = (namespace[name] for name in ("rods", "final", "multipliers"))
    jacobian = jax.jacobian(lambda q: rods(5.0, q, None))(final[0])
    pull = -jnp.einsum("i,ijk->jk", multipliers, jacobian)
    accelerations = namespace["system"].accelerations(5.0, final)
    expected = jnp.array([[0.0, -9.81], [0.0, -9.81]]) + pull
    np.testing.assert_allclose(accelerations, expected, rtol=0, atol=1e-12)


def check_dae(namespace):
    """Newton's law along the rod."""
    x, q, v = namespace["x"], namespace["x"]["q"], namespace["x"]["v"]
    np.testing.assert_allclose(np.sum(q**2, axis=-1), 1, rtol=0, atol=1e-15)
    pull = np.sum(v**2, axis=-1) - 9.81 * q[:, 1]
    np.testing.assert_allclose(x["tension"], pull, rtol=0, atol=1e-12)
    assert namespace["dae"].report.index == 3


def check_many_and_gradients(namespace):
    """On the circle, and with the energy of each; d x(10) / d g is exact to the digits given."""
    ensemble, start = namespace["ensemble"], np.asarray(namespace["starts"][0])
    q, v = (np.asarray(leaf[:, -1]) for leaf in ensemble.ys)
    np.testing.assert_allclose(np.sum(q**2, axis=-1), 1, rtol=0, atol=1e-15)
    energy = np.sum(v**2, axis=-1) / 2 + 9.81 * (q[:, 1] - start[:, 1])
    assert np.abs(energy).max() < 1e-5
    assert abs(namespace["slopes"].gravity + 2.12823553) <= 1e-5


CHECKS = check_first_solve, check_mechanism, check_dae, check_many_and_gradients


@pytest.mark.parametrize("i", range(len(BLOCKS)), ids=NAMES)
def test_each_example_runs_alone(i):
    CHECKS[i](run(PREAMBLE, BLOCKS[i]))


def names_of(block):
    """All names that are read, those that are bound at the top level, and all that are bound."""
    nodes = list(ast.walk(ast.parse(block)))
    read = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}
    bound = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    bound |= {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    bound |= {n.arg for n in nodes if isinstance(n, ast.arg)}
    bound |= {n.asname or n.name for n in nodes if isinstance(n, ast.alias)}
    top = set(compile(block, str(README), "exec").co_names) & bound
    return read, top, bound


def test_examples_do_not_depend_on_each_other():
    """So that what holds for each alone holds for all in one session, in any order."""
    imported = names_of(PREAMBLE)[2]
    owner = {}
    for name, block in zip(NAMES, BLOCKS):
        read, top, bound = names_of(block)
        assert read <= bound | imported | set(dir(builtins)), name
        for binding in top - imported:
            assert owner.setdefault(binding, name) == name, binding


@pytest.mark.slow
def test_examples_run_one_after_the_other():
    namespace = run(*BLOCKS)
    for check in CHECKS:
        check(namespace)


def test_it_is_short():
    assert len(README.read_text().splitlines()) <= 150


def test_commands_are_there():
    text = README.read_text()
    assert "manifold-jax compare pendulum" in text
    assert re.search(r"<!-- test command -->\n```bash\n.*pytest.*\n```", text)
