"""Closed loops in the coordinates of joints, some or all of whose equations hold by themselves, up to rounding."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody
AXES = [(0.0, 0.0, 1.0), (1.0, 2.0, 3.0)]


def door(axis, redundant=False):
    """A door on two hinges, driven by 0.3 N m about an axis with a moment of inertia of 0.1 kg m^2."""
    n = np.asarray(axis) / np.linalg.norm(axis)
    hinges = [mb.Revolute(mb.GROUND, "door", at=x * n, axis=n, name=f"{x}") for x in (0.5, -0.5)]
    bodies = [mb.Body("door", 1.0, (0.1, 0.1, 0.1))]
    return mb.Assembly(bodies, hinges, [mb.Motor("0.5", 0.3)], redundant=redundant)


@pytest.mark.parametrize("axis", AXES)
def test_a_door_on_two_hinges(axis):
    """It accelerates by 3 rad/s^2, at rest and in motion, with all equations and with those that are left: none."""
    joints = mb.JointCoordinates(door(axis, redundant=True))
    for rate in (0.0, 3.0):
        y = jnp.array([0.4]), jnp.array([rate])
        np.testing.assert_allclose(joints.system.accelerations(0.0, y), [3.0], rtol=1e-12)
    fewer = mb.JointCoordinates(door(axis).without_dependent_equations())
    assert fewer.independent == ()
    assert fewer.constraint is None
    np.testing.assert_allclose(fewer.terms.vf(0.0, fewer.state(), None)[1], [3.0], rtol=1e-12)


def test_a_door_moves():
    joints = mb.JointCoordinates(door(AXES[1], redundant=True))
    hook = mj.Projected(dfx.Tsit5(), joints.constraint)
    sol = mj.diffeqsolve(joints.terms, hook, 0.0, 1.0, 0.1, joints.state())
    np.testing.assert_allclose(sol.ys[0][-1], [1.5], rtol=1e-12)


def test_a_door_in_single_precision():
    joints = mb.JointCoordinates(jax.tree.map(lambda x: x.astype(jnp.float32), door(AXES[1], True)))
    y = jnp.array([0.4], jnp.float32), jnp.array([3.0], jnp.float32)
    np.testing.assert_allclose(joints.system.accelerations(0.0, y), [3.0], rtol=1e-5)


def test_dependent_loops_are_refused():
    joints, y = mb.JointCoordinates(door(AXES[1])), door(AXES[1], redundant=True).state()
    with pytest.raises(
        ValueError, match=r"5 of the 5 equations .* depend on others .*-0\.5\. If they do so"
    ):
        joints.state(y)


def hooke(angle):
    """Two shafts that meet at this angle, in a universal joint and in bearings of their own."""
    x, z = np.eye(3)[0], np.eye(3)[2]
    w = np.array([np.cos(angle), np.sin(angle), 0.0])
    turned = mb.quaternion(z, angle)
    bodies = [
        mb.Body("in", 1.0, (0.02, 0.03, 0.03), position=-0.5 * x),
        mb.Body("out", 1.0, (0.05, 0.03, 0.03), position=0.5 * w, orientation=turned),
    ]
    joints = [
        mb.Revolute(mb.GROUND, "in", at=-0.5 * x, axis=x, name="i"),
        mb.Revolute(mb.GROUND, "out", at=0.5 * w, axis=w, name="o"),
        mb.Universal("in", "out", at=(0, 0, 0), axis=(z, np.cross(w, z))),
    ]
    return mb.JointCoordinates(mb.Assembly(bodies, joints, [mb.Motor("i", 0.1)], redundant=True))


def test_a_universal_joint_between_shafts():
    """The output turns by `tan(out) = cos(b) tan(in)`, at the ratio R = cos(b) / (1 - sin(b)^2 sin(in)^2); the
    kinetic energy of both, `(I + K R^2) w^2 / 2`, grows by the work of the motor."""
    b, w, joints = 0.6, 3.0, hooke(0.6)
    ratio = lambda th: np.cos(b) / (1 - np.sin(b) ** 2 * np.sin(th) ** 2)
    angles = np.array([0.0, 1e-8, 1e-4, 0.4, 1.2])
    out = np.arctan(np.tan(angles) * np.cos(b))
    slope = 2 * np.sin(b) ** 2 * np.sin(angles) * np.cos(angles) / np.cos(b) * ratio(angles) ** 2
    inertia = 0.02 + 0.05 * ratio(angles) ** 2
    wanted = (0.1 - 0.05 * ratio(angles) * slope * w**2) / inertia
    q = jnp.stack([angles, out], axis=1)
    v = w * jnp.stack([np.ones(5), ratio(angles)], axis=1)
    found = jax.vmap(lambda q, v: joints.system.accelerations(0.0, (q, v)))(q, v)
    np.testing.assert_allclose(found[:, 0], wanted, rtol=1e-9)
