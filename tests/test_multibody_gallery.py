"""The delta robot and the Stewart platform: references that share nothing with their assemblies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from manifold_jax import problems


@eqx.filter_jit
def checked(problem, t, y):
    """The field, and the residual of the constraints."""
    return problem.terms.vf(t, y, problem.args), problem.constraint(t, y, problem.args)


@pytest.mark.parametrize(
    "build", [problems.delta_robot, pytest.param(problems.stewart_platform, marks=pytest.mark.slow)]
)
def test_reference_solves_the_equations(build):
    problem = build()
    h = 1e-3 * problem.t1
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * h)
    for t in (0.3 * problem.t1, 0.8 * problem.t1):
        near = problem.reference(t + h * np.arange(-3, 4))
        y = jax.tree.map(lambda leaf: jnp.asarray(leaf[3]), near)
        rate, residual = checked(problem, jnp.asarray(t), y)
        assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(residual)) < 1e-12
        for leaf, values in zip(jax.tree.leaves(rate), jax.tree.leaves(near)):
            expected = np.tensordot(weights, values, axes=1)
            assert np.abs(expected).max() > 0.1
            np.testing.assert_allclose(leaf, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    start = problem.reference(0.0)
    for leaf, expected in zip(jax.tree.leaves(problem.y0), jax.tree.leaves(start)):
        np.testing.assert_allclose(leaf, expected, rtol=0, atol=1e-14)


def test_other_lengths_keep_the_platform():
    problem = problems.delta_robot()
    y0 = jax.tree.map(jnp.asarray, problem.reference(1.3))
    other = problem.with_initial(y0)
    other = other.with_args(problem.args._replace(arm_length=jnp.asarray(0.37)))
    np.testing.assert_array_equal(other.y0[0].position[3], y0[0].position[3])
    _, residual = checked(other, jnp.asarray(0.0), other.y0)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(residual)) < 1e-14
