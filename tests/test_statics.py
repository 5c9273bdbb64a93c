"""Equilibria of mechanisms, with their derivatives."""

import jax
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody


def loaded_arm(args):
    """A bar of 2 kg and 1 m with a spring in its hinge, drawn horizontally; in args stiffness and gravity."""
    bar = mb.Body("bar", 2.0, 2.0 / 12, position=(0.5, 0.0))
    hinge = mb.Revolute(mb.GROUND, "bar", at=(0.0, 0.0), name="hinge")
    spring = mb.JointSpring("hinge", args[0])
    return mb.Assembly([bar], [hinge], [spring], gravity=jnp.stack([0.0 * args[1], -args[1]]))


@jax.jit
def sag(args):
    arm = loaded_arm(args)
    found = mj.equilibrium(arm.system, arm.bodies.drawing)
    return found.q.orientation[0], found.multipliers


def test_a_bar_on_a_spring():
    """`k angle = -m g (l / 2) cos(angle)`, and its derivatives by the implicit function theorem."""
    args = jnp.array([30.0, 9.81])
    angle, multipliers = sag(args)
    k, g = np.asarray(args)
    assert float(k * angle + g * np.cos(angle)) == pytest.approx(0, abs=1e-12)
    # The hinge carries the weight.
    np.testing.assert_allclose(np.abs(multipliers), [0, 2 * g], atol=1e-11)
    slope = k - g * np.sin(angle)
    expected = [-float(angle) / slope, -np.cos(angle) / slope]
    for transform in (jax.jacrev, jax.jacfwd):
        found, _ = transform(sag)(args)
        np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_a_linkage_hangs():
    """At rest it stays where it is, and the loop is closed."""
    problem = mj.problems.four_bar()
    robot = cases.four_bar(problem.args)
    q = cases.four_bar_state(robot, problem.y0)[0]
    found = mj.equilibrium(robot.system, q)
    a = robot.system.accelerations(0.0, (found.q, jax.tree.map(jnp.zeros_like, q)), None)
    np.testing.assert_allclose(a.coordinates, 0, atol=1e-10)
    assert max(float(jnp.max(jnp.abs(gap))) for gap in robot.gaps(found.q).values()) < 1e-12


def test_what_has_no_equilibrium_or_no_unique_multipliers():
    point = lambda **options: mj.MechanicalSystem(
        1.0, lambda t, q, args: q[0], lambda t, q, v, args: jnp.array([0.0, -1.0]), **options
    )
    with pytest.raises(Exception, match="No equilibrium was found near `q`"):
        mj.equilibrium(point(), jnp.zeros(2))  # it falls for ever
    with pytest.raises(ValueError, match="redundant=True"):
        mj.equilibrium(point(redundant=True), jnp.zeros(2))
    with pytest.raises(ValueError, match="neither velocity constraints"):
        mj.equilibrium(point(velocity_constraint=lambda t, q, v, args: v[1]), jnp.zeros(2))
    with pytest.raises(
        TypeError, match="MechanicalSystem"
    ):  # of this library, or of the type checker
        mj.equilibrium(lambda q: q, jnp.zeros(2))
