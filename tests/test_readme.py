"""The README's example runs and does what the text says."""

import re
from pathlib import Path

import diffrax
import jax
import numpy as np
import pytest

import manifold_jax


README = Path(__file__).parents[1] / "README.md"


def blocks():
    return re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


@pytest.fixture
def example():
    return blocks()[0]


def test_mechanism_example_runs():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        namespace = {"jax": jax, "jnp": jax.numpy, "dfx": diffrax, "mj": manifold_jax}
        exec(compile(blocks()[1], str(README), "exec"), namespace)
    q = np.asarray(namespace["sol"].ys[0][-1])
    np.testing.assert_allclose(np.linalg.norm([q[0], q[1] - q[0]], axis=1), 1, atol=1e-15)
    assert namespace["forces"].shape == (2,)


def test_curves_and_minima_example_runs():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        namespace = {"jnp": jax.numpy, "mj": manifold_jax}
        exec(compile(blocks()[2], str(README), "exec"), namespace)
    np.testing.assert_allclose(namespace["folds"], [[-1, -2 / 3], [1, 2 / 3]], atol=1e-14)
    np.testing.assert_allclose(namespace["minimum"].x, [-1, 0, 0], atol=1e-14)
    np.testing.assert_allclose(namespace["minimum"].multipliers, [0.5], rtol=1e-14)


def test_fit_example_runs():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        namespace = {"jax": jax, "jnp": jax.numpy, "mj": manifold_jax}
        exec(compile(blocks()[3], str(README), "exec"), namespace)
    fit = namespace["fit"]
    assert abs(fit.parameters["gravity"] - 9.81) < 3 * fit.standard_errors["gravity"] < 0.02
    assert abs(fit.parameters["length"] - 1) < 3 * fit.standard_errors["length"] < 0.002


def test_example_runs_and_keeps_the_manifold(example):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        namespace = {}
        exec(compile(example, str(README), "exec"), namespace)
    q, v = namespace["sol"].ys
    assert np.abs(np.sum(np.square(q), axis=-1) - 1).max() <= 1e-15
    assert np.abs(np.sum(q * v, axis=-1)).max() <= 2e-15
    # d x(10) / d g, exact to the digits given.
    assert abs(namespace["slope"] + 2.12823553) <= 1e-5


def test_example_is_short(example):
    assert len([line for line in example.splitlines() if line.strip()]) <= 16


def test_commands_are_there():
    text = README.read_text()
    assert "manifold-jax compare pendulum" in text
    assert re.search(r"<!-- test command -->\n```bash\n.*pytest.*\n```", text)
