"""Tendons through several joints, and motors of limited torque: written again with NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody
INERTIA, MASS = 0.4, 2.0


def machine(tendons):
    """A wheel about its centre and a slider, each on the ground: `I x_1'' = r_1 F`, `m x_2'' = r_2 F`."""
    bodies = [
        mb.Body("wheel", 1.0, INERTIA, position=(1.0, 0.0)),
        mb.Body("block", MASS, 1.0, position=(0.0, 1.0)),
    ]
    joints = [
        mb.Revolute(mb.GROUND, "wheel", at=(1.0, 0.0), name="shaft"),
        mb.Prismatic("block", mb.GROUND, at=(0.0, 1.0), axis=(1.0, 0.0), name="guide"),
    ]
    return mb.JointCoordinates(mb.Assembly(bodies, joints, tendons))


def tendon(values, **options):
    radii, stiffness, rest, damping = values[:2], *values[2:]
    given = dict(stiffness=stiffness, rest=rest, damping=damping) | options
    return mb.Tendon(("shaft", "guide"), radii, lambda t, args: args, **given)


def accelerations(joints, y, pull):
    return joints.terms.vf(0.0, y, pull)[1]


VALUES = np.array([0.3, -1.5, 20.0, 0.2, 4.0])
Y = jnp.array([0.7, 0.1]), jnp.array([-0.4, 0.6])


def test_forces_and_gradients():
    """Of two tendons, one of them limited; by radii, stiffness, rest and damping."""
    second = mb.Tendon(("guide",), (2.0,), -9.0, stiffness=1.0, limits=(-1.25, 3.0))

    def by(values):
        return accelerations(machine([tendon(values), second]), Y, 1.7)

    def expected(values, x=Y):
        r, k, rest, d = values[:2], *values[2:]
        force = 1.7 - k * (r @ x[0] - rest) - d * (r @ x[1])
        return jnp.stack([r[0] * force / INERTIA, (r[1] * force - 2.0 * 1.25) / MASS])

    at = jnp.asarray(VALUES)
    found, forward = jax.jit(lambda at: (by(at), jax.jacfwd(by)(at)))(at)
    np.testing.assert_allclose(found, expected(at), rtol=1e-12)
    reverse = jax.jit(jax.jacrev(by))(at)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(reverse, jax.jacfwd(expected)(at), rtol=1e-11, atol=1e-12)


def test_energy():
    """Of springs without limits."""
    joints = machine([tendon(VALUES), tendon(VALUES, limits=(-1.0, 1.0), name="limited")])
    stretch = VALUES[:2] @ np.asarray(Y[0]) - 0.2
    energy = joints.assembly.energy(joints.poses(Y)).potential
    np.testing.assert_allclose(energy, 20.0 * stretch**2 / 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (mb.Tendon((), ()), "`joints` must name at least one hinge or slider"),
        (mb.Tendon(("shaft",), (1.0, 2.0)), r"Tendon shaft: `coefficients` must be of shape \(1,\)"),
        (mb.Tendon(("axle",), (1.0,)), "names the joint 'axle', which is not there"),
        (mb.Tendon(("shaft",), (1.0,), limits=(1.0, -1.0)), "`limits` must be in order, got 1.0 and -1.0"),
        (mb.Tendon(("shaft",), (1.0,), limits=3.0), "`limits` must be a pair of numbers or `None`"),
        (mb.Tendon(("shaft",), (1.0,), stiffness=(1.0, 2.0)), "`stiffness` must be a number"),
    ],
)  # fmt: skip
def test_messages(force, message):
    with pytest.raises(ValueError, match=message):
        machine([force])


@pytest.mark.parametrize(
    "make", [lambda: mb.Tendon("shaft", (1.0,)), lambda: mb.Controller("shaft", abs)]
)
def test_one_name_is_no_list_of_letters(make):
    with pytest.raises(TypeError, match=r"`joints` must be a tuple of names.*`\('shaft',\)`"):
        make()
