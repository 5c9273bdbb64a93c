"""The README's examples run and do what the text says, each alone and one after the other."""

import ast
import builtins
import re
from pathlib import Path

import jax
import numpy as np
import pytest


README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
# What the others need of the first one, as the text says: the imports and the setting.
PREAMBLE = BLOCKS[0].split("\n\n\n")[0]
NAMES = [
    "fifteen lines",
    "mechanism",
    "dae",
    "stiff",
    "curves and minima",
    "fit",
    "ensemble",
    "stream",
    "extend",
]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Examples may write files."""
    monkeypatch.chdir(tmp_path)


def run(*blocks):
    namespace = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            exec(compile(block, str(README), "exec"), namespace)
    return namespace


def check_fifteen_lines(namespace):
    q, v = namespace["sol"].ys
    assert np.abs(np.sum(np.square(q), axis=-1) - 1).max() <= 1e-15
    assert np.abs(np.sum(q * v, axis=-1)).max() <= 2e-15
    # d x(10) / d g, exact to the digits given.
    assert abs(namespace["slope"] + 2.12823553) <= 1e-5


def check_mechanism(namespace):
    q = np.asarray(namespace["motion"].ys[0][-1])
    np.testing.assert_allclose(np.linalg.norm([q[0], q[1] - q[0]], axis=1), 1, atol=1e-15)
    assert namespace["forces"].shape == (2,)


def check_dae(namespace):
    """Newton's law of the whole: what drives it accelerates both masses."""
    x, xdot, t = namespace["x"], namespace["xdot"], namespace["led"].ts
    np.testing.assert_allclose(x["position"], np.sin(t), rtol=0, atol=1e-15)
    both = 3 * xdot["speed"] + xdot["velocity"][:, 0]
    np.testing.assert_allclose(x["drive"], both, rtol=0, atol=1e-12)
    np.testing.assert_allclose(xdot["speed"], -np.sin(t), rtol=0, atol=1e-12)
    assert namespace["dae"].report.index == 3


def check_stiff(namespace):
    """Test Set for IVP Solvers (Mazzia & Magherini 2008), II-10."""
    end = [0.2083340149701255e-07, 0.8333360770334713e-13, 0.9999999791665050]
    np.testing.assert_allclose(namespace["stiff"].ys[0], end, rtol=1e-7)


def check_curves_and_minima(namespace):
    np.testing.assert_allclose(namespace["folds"], [[-1, -2 / 3], [1, 2 / 3]], atol=1e-14)
    np.testing.assert_allclose(namespace["minimum"].x, [-1, 0, 0], atol=1e-14)
    np.testing.assert_allclose(namespace["minimum"].multipliers, [0.5], rtol=1e-14)


def check_fit(namespace):
    fit = namespace["fit"]
    assert abs(fit.parameters["gravity"] - 9.81) < 3 * fit.standard_errors["gravity"] < 0.02
    assert abs(fit.parameters["length"] - 1) < 3 * fit.standard_errors["length"] < 0.002


def check_ensemble(namespace):
    """On the circle, and with the energy of each."""
    (q, v), start = (jax.tree.map(np.asarray, namespace[name]) for name in ("end", "drops"))
    np.testing.assert_allclose(np.sum(q**2, axis=-1), 1, rtol=0, atol=1e-15)
    energy = np.sum(v**2, axis=-1) / 2 + namespace["gravities"] * (q[:, 1] - start[:, 1])
    assert np.abs(energy).max() < 1e-5


def check_stream(namespace):
    """Each has the energy of its own start."""
    released = namespace["mj"].open_ensemble("released")
    assert (released.finished, released.num_failed) == (2000, 0)
    key = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(0), i))(np.arange(100))
    (start, _), _ = jax.vmap(namespace["release"])(np.arange(100), key)
    q, v = namespace["positions"][:, 0], released.ys["1"][:100, 0]
    energy = np.sum(v**2, axis=-1) / 2 + 9.81 * (q[:, 1] - start[:, 1])
    assert np.abs(energy).max() < 1e-4
    np.testing.assert_allclose(np.sum(q**2, axis=-1), 1, rtol=0, atol=1e-15)


def check_extend(namespace):
    """It asserts by itself what the text says; by Newton's method the same."""
    cylinder = namespace["Cylinder"]()
    newton = namespace["mj"].Constraint(cylinder)
    points = [
        namespace["mj"].project(c, 0.0, np.array([3.0, 4.0, 1.0]))[0] for c in (cylinder, newton)
    ]
    np.testing.assert_allclose(points, [[0.6, 0.8, 1.0]] * 2, atol=1e-15)


CHECKS = (
    check_fifteen_lines,
    check_mechanism,
    check_dae,
    check_stiff,
    check_curves_and_minima,
    check_fit,
    check_ensemble,
    check_stream,
    check_extend,
)


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
    # what the first one defined still means the same
    exec("again = solve(9.81, dfx.SaveAt(t1=True)).ys", namespace)
    np.testing.assert_allclose(namespace["again"][0][-1], namespace["sol"].ys[0][-1], rtol=1e-12)


def test_first_example_is_short():
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 16


def test_commands_are_there():
    text = README.read_text()
    assert "manifold-jax compare pendulum" in text
    assert re.search(r"<!-- test command -->\n```bash\n.*pytest.*\n```", text)
