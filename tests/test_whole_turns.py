"""Springs, servo motors and stops beyond half a turn, in the coordinates of joints: closed forms, and MuJoCo."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody
INERTIA = 0.4
TIMES = jnp.linspace(0.5, 3.0, 6)
WEIGHTS = jnp.outer(TIMES, jnp.array([1.0, -0.3]))


def wheels(forces):
    """Two wheels about fixed axes; the first of them is the first body of its hinge."""
    at = {"a": (0.0, 0.0), "b": (2.0, 0.0)}
    bodies = [mb.Body(name, 1.0, INERTIA, position=at[name]) for name in at]
    hinges = [
        mb.Revolute("a", mb.GROUND, at=at["a"], name="shaft a"),
        mb.Revolute(mb.GROUND, "b", at=at["b"], name="shaft b"),
    ]
    return mb.Assembly(bodies, hinges, forces)


def servo(stiffness, target):
    return mb.Tendon(("shaft b",), (0.5,), 0.5 * stiffness * target, stiffness=stiffness)


def test_springs_and_servo_motors_oscillate_about_angles_beyond_half_a_turn():
    """`x = rest (1 - cos w t)`, with the energy and with gradients by stiffness and rest."""

    def exact(args):
        (first, second), rests = args
        rates = jnp.sqrt(jnp.stack([first, 0.25 * second]) / INERTIA)
        return rests[None] * (1 - jnp.cos(jnp.outer(TIMES, rates)))

    def solved(args):
        (first, second), rests = args
        forces = [mb.JointSpring("shaft a", first, rests[0]), servo(second, rests[1])]
        joints = mb.JointCoordinates(wheels(forces))
        given = joints.terms, dfx.Dopri8(), 0.0, 3.0, None, joints.state()
        controller = dfx.PIDController(rtol=1e-11, atol=1e-11)
        return joints, mj.diffeqsolve(
            *given, saveat=dfx.SaveAt(ts=TIMES), stepsize_controller=controller
        ).ys

    def weighted(args):
        joints, ys = solved(args)
        return jnp.sum(WEIGHTS * ys[0]), (ys[0], joints.energy(ys))

    args = jnp.array([5.0, 12.0]), jnp.array([4.0, -9.0])
    found, (x, energy) = jax.jit(jax.grad(weighted, has_aux=True))(args)
    np.testing.assert_allclose(x, exact(args), atol=1e-8)
    assert jnp.max(x[:, 0]) > 2 * jnp.pi
    # half of the square of the rest, times the stiffness; that of the servo has no value in its energy
    stored = np.array([5.0 * (x[:, 0] - 4.0) ** 2, 12.0 * (0.5 * x[:, 1]) ** 2]).sum(axis=0) / 2
    np.testing.assert_allclose(energy.potential, stored, rtol=1e-12)
    expected = jax.grad(lambda args: jnp.sum(WEIGHTS * exact(args)))(args)
    for part, other in zip(found, expected):
        np.testing.assert_allclose(part, other, rtol=1e-6)


def test_forces_of_joints_beyond_half_a_turn():
    """What a hinge does to a body beside its axis, on which a spring alone acts: along its path `m l x''`."""
    body = mb.Body("b", 1.0, INERTIA, position=(1.0, 0.0))
    hinge = mb.Revolute(mb.GROUND, "b", at=(0.0, 0.0), name="h")
    joints = mb.JointCoordinates(mb.Assembly([body], [hinge], [mb.JointSpring("h", 5.0)]))
    angles = jnp.array([2.0, 4.0, 9.7])
    forces = joints.joint_forces(0.0, (angles[:, None], jnp.zeros((3, 1))))
    along = jnp.stack([-jnp.sin(angles), jnp.cos(angles)], axis=1)
    found = jnp.sum(along * forces["h"].force, axis=1)
    np.testing.assert_allclose(found, -5.0 * angles / (INERTIA + 1.0), rtol=1e-12)


def test_at_rest_beyond_half_a_turn():
    """The equilibrium of a spring, and the frequency of small motions about it."""
    joints = mb.JointCoordinates(wheels([mb.JointSpring("shaft a", 5.0, 4.0), servo(12.0, -9.0)]))
    y = joints.state()
    q, _ = mj.equilibrium(joints.system, y[0])
    np.testing.assert_allclose(q, [4.0, -9.0], rtol=1e-10)
    near = mj.linearize(joints.terms, None, 0.0, (q, y[1]))
    expected = np.sqrt(np.array([0.25 * 12.0, 5.0]) / INERTIA)
    np.testing.assert_allclose(near.eigenvalues().imag[2:], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("force", "hinge"),
    [
        (mb.JointSpring("shaft a", 5.0, -4.0), "shaft a"),
        (mb.Tendon(("shaft b",), (-0.5,), 24.0, stiffness=12.0), "shaft b"),
        (mb.JointStop("shaft a", -3.0, 4.0, 1.0), "shaft a"),
        (mb.JointStop("shaft a", -jnp.inf, 6.0, 1.0), "shaft a"),
    ],
)
def test_poses_do_not_tell_whole_turns(force, hinge):
    assembly = wheels([force])
    assert mb.JointCoordinates(assembly).names == ("shaft a", "shaft b")
    with pytest.raises(
        ValueError, match=rf"half a turn of the hinges \['{hinge}'\]. Solve `mj.mul"
    ):
        assembly.system  # noqa: B018


@pytest.mark.parametrize(
    "force",
    [
        mb.JointSpring("shaft a", 5.0, 3.1416),
        mb.JointSpring("shaft a", 0.0, 4.0, 1.0),
        mb.Tendon(("shaft a",), (0.5,), lambda t, args: args, stiffness=12.0),  # not known
        mb.Tendon(("shaft a", "shaft b"), (0.5, 0.5), 24.0, stiffness=12.0),
        mb.JointStop("shaft a", -3.0, 3.0, 1.0),
    ],
)
def test_what_poses_are_enough_for(force):
    assert wheels([force]).system.constraint is not None


def test_hinges_beyond_half_a_turn_do_not_close_loops():
    """Of the four hinges of a linkage, the one farthest from the ground is left out otherwise."""
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [2.0, 1.5], [2.0, 0.0]])
    names = [mb.GROUND, "crank", "coupler", "rocker", mb.GROUND]
    bodies = [
        mb.Body(name, 1.0, 0.1, position=(a + b) / 2)
        for name, a, b in zip(names[1:], corners, corners[1:])
    ]
    hinges = [
        mb.Revolute(*pair, at=at, name=f"h{i}")
        for i, (*pair, at) in enumerate(zip(names, names[1:], corners))
    ]
    left_out = mb.JointSpring("h2", 5.0, 1.0)
    assert "h2" not in mb.JointCoordinates(mb.Assembly(bodies, hinges, [left_out])).names
    kept = mb.JointSpring("h2", 5.0, 4.0)
    assert "h2" in mb.JointCoordinates(mb.Assembly(bodies, hinges, [kept])).names
    every = [mb.JointSpring(f"h{i}", 5.0, 4.0) for i in range(4)]
    with pytest.raises(ValueError, match=r"beyond half a turn, form a closed loop, with \['h"):
        mb.JointCoordinates(mb.Assembly(bodies, hinges, every))


ARM = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" ref="0.4" stiffness="7" springref="5"/>
 <inertial pos="0.1 0 -0.3" mass="1" diaginertia="0.1 0.1 0.02"/>
 <body name="lower" pos="0 0 -0.5"><joint name="elbow" axis="0 1 0.2"/>
  <inertial pos="0 0.1 -0.2" mass="0.7" diaginertia="0.05 0.06 0.01"/></body></body></worldbody>
<tendon><fixed name="belt" stiffness="3" springlength="6"><joint joint="shoulder" coef="0.4"/>
 <joint joint="elbow" coef="-0.3"/></fixed></tendon>
<actuator><position joint="shoulder" kp="20" kv="2" gear="1.5"/>
 <position joint="elbow" kp="9" ctrlrange="{0}" forcerange="-60 60"/></actuator></mujoco>"""


def test_servo_motors_springs_and_tendons_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ARM.format("-6.3 6.3"))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (4.3, -7.9), (0.3, -1.1), (6.1, -6.0)
    mujoco.mj_forward(model, data)
    robot = mb.from_mujoco(model, control=lambda t, args: args)
    joints = mb.JointCoordinates(robot)
    y = jnp.asarray(data.qpos - model.qpos0), jnp.asarray(data.qvel)
    found = eqx.filter_jit(joints.terms.vf)(0.0, y, jnp.asarray(data.ctrl))[1]
    np.testing.assert_allclose(found, data.qacc, rtol=1e-9)
    with pytest.raises(ValueError, match=r"half a turn of the hinges \['shoulder', 'elbow'\]"):
        robot.system  # noqa: B018
    within = ARM.format("-2 2").replace('stiffness="7"', "")
    assert mb.from_mujoco(within, control=lambda t, args: args).system.constraint is not None
