"""What MJCF files say that is easily overlooked: it acts as in MuJoCo, or is refused."""

import numpy as np
import pytest

import manifold_jax as mj


mujoco = pytest.importorskip("mujoco")
mb = mj.multibody

SOLID = '<inertial pos="0.1 0.2 0.3" mass="1" diaginertia="1 1.2 1.4"/>'
ARM = """<mujoco><option>{flags}</option><worldbody>
<body name="arm"><joint name="j" axis="0 1 0" {joint}/>{solid}<geom size="0.1" contype="{touches}"/>
<body name="hand" pos="0 0 -0.5"><joint name="k" axis="1 0 0"/>{solid}<geom size="0.1" contype="{touches}"/>
{parts}</body></body></worldbody>{more}</mujoco>"""


def arm(flags="", joint="", touches=0, parts="", more=""):
    given = dict(flags=flags, joint=joint, touches=touches, parts=parts, more=more)
    return mujoco.MjModel.from_xml_string(ARM.format(solid=SOLID, **given))


def test_no_constraints():
    """One flag switches off all of them: MuJoCo has no rows of constraints, and nothing is refused for them."""
    tendon = '<tendon><fixed name="t" limited="true" range="1 2" frictionloss="1" stiffness="1"><joint joint="j" coef="1"/></fixed></tendon>'
    equalities = """<equality><joint name="gear" joint1="k" joint2="j" polycoef="0.3 1 0 0 0"/>
    <connect name="loop" body1="hand" anchor="0 0 0"/><tendon tendon1="t"/></equality>"""
    floor = '<geom pos="0 0 -0.4" type="plane" size="1 1 1"/></worldbody>'
    xml = ARM.replace("</worldbody>", floor).format(
        flags='<flag constraint="disable"/>',
        joint='limited="true" range="10 20" frictionloss="1"',
        solid=SOLID,
        touches=1,
        parts="",
        more=tendon + equalities,
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.nefc == 0
    robot = mb.from_mujoco(model)
    assert robot.joint_names == ("j", "k")
    assert not robot.couplings.names
    assert len(robot.loads) == 1  # the tendon


def test_parts_without_mass_may_have_inertia():
    """A part turned by a quarter about z; MuJoCo's mass matrix of the two hinges has it, too."""
    part = '<body name="disc" euler="0 0 90"><inertial pos="7 0 0" mass="0" diaginertia="0.2 0.3 0.4"/></body>'
    model = arm(parts=part)
    robot = mb.from_mujoco(model)
    assert robot.names == ("arm", "hand")
    found = np.asarray(robot.bodies.inertia)[1]
    np.testing.assert_allclose(found, np.diag([1.0 + 0.3, 1.2 + 0.2, 1.4 + 0.4]), atol=1e-15)
    masses = [np.zeros((2, 2)), np.zeros((2, 2))]
    for matrix, own in zip(masses, (model, arm())):
        data = mujoco.MjData(own)
        mujoco.mj_forward(own, data)
        mujoco.mj_fullM(own, data, matrix)
    np.testing.assert_allclose(masses[0] - masses[1], np.diag([0.2, 0.3]), atol=1e-15)


def test_a_weld_without_torques_is_a_ball_joint():
    """MuJoCo's Jacobian of it has rank 3."""
    bodies = "".join(
        f'<body name="{name}" pos="{x} 0 0"><freejoint/>{SOLID}</body>'
        for name, x in (("a", 0), ("b", 1))
    )
    weld = '<equality><weld name="w" body1="a" body2="b" anchor="0.3 0.2 0.1" torquescale="0"/></equality>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option jacobian="dense"/><worldbody>{bodies}</worldbody>{weld}</mujoco>'
    )
    robot, data = mb.from_mujoco(model), mujoco.MjData(model)
    # the second body turned about their common point, `anchor` in its frame
    pivot, turn, rotation = np.array([1.3, 0.2, 0.1]), np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.6, 0.0, 0.8]), 0.7)
    mujoco.mju_quat2Mat(rotation, turn)
    data.qpos[7:10] = pivot - rotation.reshape(3, 3) @ [0.3, 0.2, 0.1]
    data.qpos[10:] = turn
    mujoco.mj_forward(model, data)
    assert np.linalg.matrix_rank(data.efc_J.reshape(-1, model.nv)) == 3
    (gap,) = robot.gaps(mb.state_of_mujoco(robot, model, data)[0]).values()
    assert gap.shape == (3,)
    np.testing.assert_allclose(gap, 0, atol=1e-15)


MOTOR = '<actuator><motor name="m" joint="j" {}/></actuator>'


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(more=MOTOR.format('damping="0 2 0"')), "actuator damping: m.* by"),
        (dict(flags='<flag filterparent="disable"/>', touches=1), "contact: "),
        (dict(flags='<flag sleep="enable"/>'), "sleep: flag sleep"),
    ],
)
def test_what_would_be_overlooked_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        mb.from_mujoco(arm(**given))


def test_what_flags_switch_off_is_not_refused():
    flags = '<flag spring="disable" damper="disable"/>'
    nonlinear = 'stiffness="0 1 0" damping="0 1 0"'
    robot = mb.from_mujoco(arm(flags, nonlinear, more=MOTOR.format('damping="2"')))
    assert len(robot.loads) == 1
    assert mb.from_mujoco(arm(touches=1)).names == ("arm", "hand")


def test_a_body_called_ground():
    with pytest.raises(ValueError, match="not 'ground', which is what does not move.* Rename it"):
        mb.from_mujoco(ARM.replace("hand", "ground").format(flags="", joint="", solid=SOLID, touches=0, parts="", more=""))  # fmt: skip


def test_actuators_after_one_with_several_controls():
    """Where an actuator with two controls is ignored, the limits of the next ones are still their own."""
    actuators = """<actuator><pid joint="k" kp="3"/><motor name="m" joint="j" gear="7" ctrllimited="true" ctrlrange="-3 3"/></actuator>"""
    model = arm(more=actuators)
    assert (model.nactuator, model.nu) == (2, 3)
    ignored = "actuator gain that is not constant", "actuator dynamics"
    robot = mb.from_mujoco(model, control=lambda t, args: args, ignore=ignored)
    (motor,) = robot.loads
    value = motor.laws.values.at(0.0, np.array([0.0, 0.0, 9.0]))
    np.testing.assert_allclose(value, [7 * 3.0])


def coupled(*equalities):
    """Three hinges side by side, and the positions from `qpos0` in which they are drawn."""
    bodies = "".join(f'<body><joint name="j{i}" axis="0 1 0"/>{SOLID}</body>' for i in (1, 2, 3))
    lines = "".join(
        f'<joint name="{i}" joint1="j{one}" joint2="j{other}" polycoef="{a} {b} 0 0 0"/>'
        for i, (one, a, b, other) in enumerate(equalities)
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody><equality>{lines}</equality></mujoco>"
    )
    robot, data = mb.from_mujoco(model), mujoco.MjData(model)
    # turned back from the drawing by so much to `qpos0`
    turned = robot.joint_coordinates(mb.state_of_mujoco(robot, model, data))
    return [-float(turned[f"j{i}"]) for i in (1, 2, 3)]


def test_couplings_that_need_a_start():
    """Equations of one joint by two others, nearest to zeros: by NumPy; and two of each other, `x = 0.1 + x / 2`."""
    found = coupled((1, 0.1, 1, 2), (1, 0, 1, 3))
    rows = np.array([[1.0, -1, 0], [1, 0, -1]])
    np.testing.assert_allclose(found, np.linalg.pinv(rows) @ [0.1, 0], atol=1e-12)
    found = coupled((1, 0.1, 0.5, 2), (2, 0.1, 0.5, 1))
    np.testing.assert_allclose(found, [0.2, 0.2, 0], atol=1e-12)
    with pytest.raises(ValueError, match=r"couplings of joints \['0', '1'\] contradict each other"):
        coupled((1, 0.1, 1, 2), (2, 0.1, 1, 1))


def test_names_that_mujoco_allows():
    """They are unique among elements of one type alone."""
    tendon = '<tendon><fixed name="m" stiffness="1"><joint joint="j" coef="1"/></fixed></tendon>'
    gear = '<equality><joint name="j" joint1="k" joint2="j"/></equality>'
    named = arm(parts=f"<body><joint/>{SOLID}</body>", more=tendon + MOTOR.format("") + gear)
    robot = mb.from_mujoco(named)
    assert robot.couplings.names == ("equality j",)
    xml = f'<mujoco><worldbody><body><joint/>{SOLID}<body name="body 1"><joint/>{SOLID}</body></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    robot = mb.from_mujoco(model)
    assert robot.names == ("unnamed body 1", "body 1")
    assert mb.state_of_mujoco(robot, model, mujoco.MjData(model))[0].position.shape == (2, 3)


def test_an_affine_gain_that_is_constant():
    general = '<actuator><general joint="j" gaintype="affine" gainprm="2 {} 0"/></actuator>'
    robot = mb.from_mujoco(arm(more=general.format(0)), control=lambda t, args: args)
    (motor,) = robot.loads
    np.testing.assert_allclose(motor.laws.values.at(0.0, np.array([3.0])), [6.0])
    with pytest.raises(ValueError, match="actuator gain that is not constant"):
        mb.from_mujoco(arm(more=general.format(1)))


def test_equalities_without_effect():
    """Of two bodies that do not move, and of a body and its part: MuJoCo's Jacobian of them is zero."""
    parts = f'<body name="part" pos="0 0 1">{SOLID}</body>'
    still = '<body name="one"/><body name="two" pos="1 1 1"/></worldbody>'
    equalities = """<equality><connect body1="one" body2="two" anchor="0 0 0"/><weld body1="two" body2="one"/>
    <connect body1="hand" body2="part" anchor="0 0 0"/></equality>"""
    xml = ARM.replace("</worldbody>", still).format(
        flags="", joint="", solid=SOLID, touches=0, parts=parts, more=equalities
    )
    model = mujoco.MjModel.from_xml_string(xml.replace("<option>", '<option jacobian="dense">'))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert not np.any(data.efc_J)
    assert mb.from_mujoco(model).joint_names == ("j", "k", "weld of part")
