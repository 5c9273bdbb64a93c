"""Forces of constraints where the documentation gives them a direction: Newton's second law decides."""

import jax.numpy as jnp
import numpy as np
from documents import blocks_of, ROOT, run

import manifold_jax as mj


def test_the_tutorial_pulls_the_load_towards_the_trolley():
    """Its text and code had the force of the cable backwards, and tested the size alone."""
    page = ROOT / "docs" / "pages" / "tutorial.md"
    names = run(*blocks_of(page)[:3])
    assert jnp.all(jnp.sum(names["pull"] * names["cable"], axis=1) < 0)
    np.testing.assert_allclose(
        jnp.sqrt(jnp.sum(names["pull"] ** 2, axis=1)), names["tension"], rtol=1e-12
    )
    assert "minus* its multiplier times its gradient" in page.read_text()


def test_multipliers_of_a_pendulum():
    """The rod pushes with `-2 lambda q`, as its docstring says: upwards at rest."""
    problem = mj.problems.pendulum(gravity=2.0, length=1.0, mass=3.0)
    circle = lambda t, q, args: q @ q - 1.0
    weight = lambda t, q, v, args: jnp.array([0.0, -6.0])
    system = mj.MechanicalSystem(3.0, circle, weight)
    hanging = jnp.array([0.0, -1.0])
    (multiplier,) = system.multipliers(0.0, (hanging, jnp.zeros(2)))
    np.testing.assert_allclose(-2 * multiplier * hanging, [0.0, 6.0], atol=1e-14)
    q, v = problem.y0
    a = problem.terms.vf(0.0, problem.y0, problem.args)[1]
    multiplier = system.multipliers(0.0, (q, v))[0]
    expected = 3.0 * (v @ v - 2.0 * q[1]) / 2
    np.testing.assert_allclose(multiplier, expected, atol=1e-14)
    np.testing.assert_allclose(3.0 * a, jnp.array([0.0, -6.0]) - 2 * multiplier * q, atol=1e-13)


def test_a_drive_pushes_with_minus_its_multiplier():
    """A mass on a rail, led along `t^2`, needs the force `2 m`."""
    led = lambda t, q, args: q[0] - t**2
    free = lambda t, q, v, args: jnp.zeros(2)
    system = mj.MechanicalSystem(jnp.array([1.5, 1.0]), led, free)
    state = jnp.array([0.25, 0.0]), jnp.array([1.0, 0.0])
    multiplier = system.multipliers(0.5, state)
    np.testing.assert_allclose(-multiplier, [3.0], rtol=1e-14)
