"""Assemblies from MJCF and URDF: accelerations are MuJoCo's, what is not supported is refused."""

import functools

import equinox as eqx
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest

import manifold_jax as mj


mujoco = pytest.importorskip("mujoco")
mb = mj.multibody


@eqx.filter_jit
def accelerations(robot, y, args):
    """Of the centres of mass, and of the angular velocities in space."""
    a = robot.system.accelerations(0.0, y, args)
    ahead = y[1], a
    spins = lambda y: jnp.stack([robot.motion(y, n).angular_velocity for n in robot.names])
    return a.position, eqx.filter_jvp(spins, (y,), (ahead,))[1]


def those_of_mujoco(robot, model, data):
    mujoco.mj_rnePostConstraint(model, data)
    both, kind, rows = np.zeros(6), mujoco.mjtObj.mjOBJ_BODY, []
    for name in named_by_file(robot):
        i = mujoco.mj_name2id(model, kind, name)
        mujoco.mj_objectAcceleration(model, data, kind, i, both, 0)
        rows.append(both.copy())
    rows = np.array(rows)
    return rows[:, 3:] + model.opt.gravity, rows[:, :3]


def named_by_file(robot):
    """The bodies of the file, without links between joints of one body."""
    return [name for name in robot.names if "(" not in name]


class RandomTree:
    """MJCF of a tree with every joint that is read, in random places."""

    def __init__(
        self, seed, armature=False
    ):  # damped ball joints, too, and bodies with several joints
        self.armature = armature
        self.rng = np.random.default_rng(seed)
        types = ["hinge", "slide", "ball", "universal", "cylindrical", "none"]
        self.types = [str(t) for t in self.rng.permutation(types)] + ["free", "hinge"]
        if armature:
            self.types[0] = self.types[7] = "several"
        self.parents = [-1] + [int(self.rng.integers(-1, i)) for i in range(1, 6)] + [-1, 6]

    def numbers(self, size=1.0, n=3):
        return " ".join(f"{x:.17g}" for x in size * self.rng.normal(size=n))

    def positive(self, low, high):
        return f"{self.rng.uniform(low, high):.17g}"

    def joint(self, i):
        kind, at = self.types[i], self.numbers(0.3)
        if kind == "several":
            return "".join(self.joint_of_type(*part) for part in several(i))
        return self.joint_of_type(kind, i, at)

    def joint_of_type(self, kind, i, at=None):
        at = self.numbers(0.3) if at is None else at
        if kind in ("hinge", "slide"):
            spring = f'stiffness="{self.positive(0, 2)}" springref="{self.positive(-0.3, 0.3)}"'
            spring += f' damping="{self.positive(0, 0.5)}"'
            if self.armature:
                spring += f' armature="{self.positive(0.5, 2)}"'
            axis = self.numbers()
            return f'<joint name="j{i}" type="{kind}" pos="{at}" axis="{axis}" {spring}/>'
        if kind == "universal":
            axes = np.linalg.qr(self.rng.normal(size=(3, 3)))[0][:2]
            hinge = '<joint type="hinge" pos="{}" axis="{:.17g} {:.17g} {:.17g}"/>'
            return "".join(hinge.format(at, *axis) for axis in axes)
        if kind == "cylindrical":
            axis = self.numbers()
            slide = f'<joint type="slide" axis="{axis}"/>'
            return slide + f'<joint type="hinge" pos="{at}" axis="{axis}"/>'
        damping = f'damping="{self.positive(0.5, 2)}"' if self.armature else ""
        others = {
            "ball": f'<joint type="ball" pos="{at}" {damping}/>',
            "free": "<freejoint/>",
            "none": "",
        }
        return others[kind]

    def body(self, i):
        moments = " ".join(self.positive(0.5, 0.9) for _ in range(3))
        inertial = (
            f'<inertial pos="{self.numbers(0.2)}" quat="{self.numbers(1, 4)}" mass="{self.positive(0.5, 2)}" '
            f'diaginertia="{moments}"/>'
        )
        place = f'name="b{i}" pos="{self.numbers(0.5)}" quat="{self.numbers(1, 4)}"'
        children = "".join(self.body(k) for k, parent in enumerate(self.parents) if parent == i)
        return f"<body {place}>{self.joint(i)}{inertial}{children}</body>"

    def numbered_joints(self):
        """The types and numbers of all joints."""
        for i, kind in enumerate(self.types):
            yield from several(i) if kind == "several" else ((kind, i),)

    def xml(self):
        bodies = "".join(self.body(i) for i, parent in enumerate(self.parents) if parent == -1)
        motors = "".join(
            f'<motor joint="j{i}" gear="{self.positive(0.5, 2)}" ctrllimited="true" ctrlrange="-1 1"/>'
            f'<position joint="j{i}" kp="{self.positive(0.5, 2)}"/>'
            for kind, i in self.numbered_joints()
            if kind in ("hinge", "slide")
        )
        tendons, motors = self.with_tendons(motors) if self.armature else ("", motors)
        return (
            f'<mujoco><option gravity="{self.numbers(5)}"/><worldbody>{bodies}</worldbody>'
            f"{tendons}<actuator>{motors}</actuator></mujoco>"
        )

    def with_tendons(self, motors):
        """Two tendons, one with a spring, and motors with limits of their forces on these and on a joint."""
        names = [f"j{i}" for kind, i in self.numbered_joints() if kind in ("hinge", "slide")]
        parts = lambda own: "".join(
            f'<joint joint="{n}" coef="{self.numbers(1, 1)}"/>' for n in own
        )
        tendons = (
            f'<fixed name="rope" springlength="0.4" stiffness="3" damping="0.7">{parts(names[::2])}</fixed>'
            f'<fixed name="belt">{parts(names[1:4])}</fixed>'
        )
        limit = 'forcelimited="true" forcerange="-0.3 0.4"'
        motors += f'<position tendon="rope" kp="7" kv="0.3" gear="1.7" {limit}/>'
        motors += f'<position tendon="belt" kp="2" gear="-0.6"/><motor joint="{names[0]}" {limit}/>'
        motors += f'<position joint="{names[1]}" kp="0.2" forcelimited="true" forcerange="-90 90"/>'
        return f"<tendon>{tendons}</tendon>", motors


def several(i):
    """The types and numbers of the joints of one body: the first behind the one with all coordinates."""
    last = () if i == 7 else (("ball", f"{i}d"),)
    return ("slide", f"{i}a"), ("hinge", f"{i}b"), ("hinge", f"{i}c"), *last


@eqx.filter_jit
def accelerations_by_joints(robot, y, args):
    joints = mb.JointCoordinates(robot)
    q, v = joints.state(y)
    ahead = v, joints.system.accelerations(0.0, (q, v), args)

    def rates(y):
        poses = joints.poses(y)
        motions = [robot.motion(poses, name) for name in named_by_file(robot)]
        parts = zip(*((motion.velocity, motion.angular_velocity) for motion in motions))
        return tuple(jnp.stack(part) for part in parts)

    return eqx.filter_jvp(rates, ((q, v),), (ahead,))[1]


@pytest.mark.parametrize(("seed", "armature"), [(0, False), (1, False), (2, True)])
def test_accelerations_of_random_trees(seed, armature):
    tree = RandomTree(seed, armature)
    model = mujoco.MjModel.from_xml_string(tree.xml())
    robot = mb.from_mujoco(model, control=lambda t, args: args)
    data = mujoco.MjData(model)
    # away from the drawing, and moving
    mujoco.mj_integratePos(model, data.qpos, 0.5 * tree.rng.normal(size=model.nv), 1.0)
    data.qvel[:] = tree.rng.normal(size=model.nv)
    data.ctrl[:] = 1.5 * tree.rng.normal(size=model.nu)
    y = mb.state_of_mujoco(robot, model, data)
    gaps = robot.gaps(y[0]).values()
    assert max(np.abs(gap).max() for gap in gaps) < 1e-14
    solved = accelerations_by_joints if armature else accelerations
    actual = solved(robot, y, jnp.asarray(data.ctrl))
    if armature:
        at_limits = np.isin(data.actuator_force, [-0.3, 0.4])
        assert at_limits.any() and not at_limits[-1]  # noqa: PT018
    for ours, theirs in zip(actual, those_of_mujoco(robot, model, data)):
        assert np.abs(theirs).max() > 1
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11)


COUPLED = """<mujoco><worldbody><body name="base">
 <joint name="lift" type="slide" axis="0 0 1" armature="0.3" ref="0.2"/>
 <joint name="turn" pos="0.1 0 0" axis="0 1 0.2"/>
 <joint name="lean" axis="1 0 0" stiffness="2"/>
 <inertial pos="0.1 0.2 0" mass="2" diaginertia="0.3 0.4 0.5"/>
 <body name="finger" pos="0.3 0 0"><joint name="curl" axis="0 0 1"/><inertial pos="0.2 0 0.1" mass="1" diaginertia="0.1 0.2 0.2"/></body>
 <body name="thumb" pos="0 0.3 0"><joint name="bend" axis="0 1 0" ref="30"/><inertial pos="0.2 0.1 0" mass="1" diaginertia="0.1 0.1 0.1"/></body>
 <body name="nail" pos="0 0.3 0.1"><joint name="locked"/><inertial pos="0.2 0.1 0" mass="1" diaginertia="0.1 0.1 0.1"/></body>
</body></worldbody><equality>
 <joint name="second" joint1="bend" joint2="turn" polycoef="-0.1 0.7 0 -0.4 0"/>
 <joint name="first" joint1="turn" joint2="lift" polycoef="0.3 1.5 -2 0 1"/>
 <joint name="lock" joint1="locked" polycoef="0.2 0 0 0 0"/>
</equality></mujoco>"""


def test_coupled_joints():
    """Accelerations are those of a linear system of MuJoCo's mass matrix and forces, solved by NumPy."""
    model = mujoco.MjModel.from_xml_string(COUPLED)
    robot = mb.from_mujoco(model)
    joints = mb.JointCoordinates(robot)
    names = [model.joint(j).name for j in range(model.njnt)]
    assert joints.names == tuple(names)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    turn, bend = (np.polynomial.Polynomial(c) for c in ([0.3, 1.5, -2, 0, 1], [-0.1, 0.7, 0, -0.4]))
    z, w = rng.normal(scale=0.3, size=3), rng.normal(size=3)
    x = np.array([z[0], turn(z[0]), z[1], z[2], bend(turn(z[0])), 0.2])  # from `qpos0`
    data.qpos[:] = model.qpos0 + x
    slopes = turn.deriv()(z[0]), bend.deriv()(x[1])
    v = np.array([w[0], slopes[0] * w[0], w[1], w[2], slopes[0] * slopes[1] * w[0], 0])
    data.qvel[:] = v
    y = mb.state_of_mujoco(robot, model, data)
    assert max(np.abs(gap).max() for gap in robot.gaps(y[0]).values()) < 1e-14
    start = x - np.array([0, turn(0), 0, 0, bend(turn(0)), 0.2])  # from the drawing
    q = joints.state(y)[0]
    np.testing.assert_allclose(q, start, rtol=0, atol=1e-14)
    np.testing.assert_allclose(joints.state(y)[1], v, rtol=0, atol=1e-13)
    M = np.zeros((6, 6))
    for column, unit in zip(M, np.eye(6)):
        mujoco.mj_mulM(model, data, column, unit)
    J, rest = np.zeros((3, 6)), np.zeros(3)
    J[0, [1, 0]], rest[0] = (1, -slopes[0]), turn.deriv(2)(x[0]) * v[0] ** 2
    J[1, [4, 1]], rest[1] = (1, -slopes[1]), bend.deriv(2)(x[1]) * v[1] ** 2
    J[2, 5] = 1
    kkt = np.block([[M, J.T], [J, np.zeros((3, 3))]])
    force = data.qfrc_passive - data.qfrc_bias
    expected = np.linalg.solve(kkt, np.concatenate([force, rest]))[:6]
    actual = eqx.filter_jit(joints.system.accelerations)(0.0, (q, jnp.asarray(v)), None)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-11)
    with pytest.raises(
        ValueError, match=r"`Coupling` \['second', 'first'\]; bodies without mass.*`mj.multi"
    ):
        robot.system  # noqa: B018
    with pytest.raises(
        ValueError, match=r"couplings of joints \['second', 'first', 'lock', 'other'\] contra"
    ):
        mb.from_mujoco(COUPLED.replace("</equality>", CONTRADICTION))


CONTRADICTION = (
    '<joint name="other" joint1="turn" joint2="lift" polycoef="0.4 1.5 -2 0 1"/></equality>'
)


def test_a_loop_closed_by_an_equality():
    """The four-bar linkage of the gallery at rest."""
    problem = mj.problems.four_bar()
    q = np.asarray(problem.y0[0]).reshape(3, 3)
    masses, lengths = np.asarray(problem.args.masses), np.asarray(problem.args.lengths)
    angles = np.degrees(np.diff(q[:, 2] + [0, 0, np.pi], prepend=0.0))
    rods = [
        '<inertial pos="{:.17g} 0 0" mass="{:.17g}" diaginertia="{:.17g} {:.17g} {:.17g}"/>'.format(
            length / 2, m, *(m * length**2 / 12 * np.array([0.1, 1.0, 1.0]))
        )
        for m, length in zip(masses, lengths)
    ]
    xml = f"""<mujoco><option gravity="0 0 -{float(problem.args.gravity)}"/><worldbody>
    <body name="crank" axisangle="0 -1 0 {angles[0]:.17g}"><joint axis="0 -1 0"/>{rods[0]}
     <body name="coupler" pos="{lengths[0]:.17g} 0 0" axisangle="0 -1 0 {angles[1]:.17g}"><joint axis="0 -1 0"/>{rods[1]}
      <body name="rocker" pos="{lengths[1]:.17g} 0 0" axisangle="0 -1 0 {angles[2]:.17g}"><joint axis="0 -1 0"/>{rods[2]}
    </body></body></body></worldbody>
    <equality><connect name="closing" body1="rocker" anchor="{lengths[2]:.17g} 0 0"/></equality></mujoco>"""
    robot = mb.from_mujoco(xml, redundant=True)
    assert robot.names == cases.BARS
    y = robot.state()
    a, _ = accelerations(robot, y, None)
    flat = cases.four_bar(problem.args)
    by_name = lambda rows: dict(zip(cases.BARS, rows))
    still = flat.state(by_name(q[:, :2]), by_name(q[:, 2]))
    expected = eqx.filter_jit(flat.system.accelerations)(0.0, still).position
    np.testing.assert_allclose(a[:, [0, 2]], expected, rtol=0, atol=1e-10)


WELDED = """
<mujoco><worldbody>
<body name="a"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
<body name="b" pos="0 0 1"><freejoint/><inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body>
</worldbody><equality><weld name="glue" body1="a" body2="b" {}/></equality></mujoco>
"""


def test_a_weld_holds_bodies_as_they_are():
    robot = mb.from_mujoco(WELDED.format(""))
    assert robot.joint_names == ("glue",)
    a, _ = accelerations(robot, robot.state(), None)
    np.testing.assert_allclose(a, [[0, 0, -9.81]] * 2, atol=1e-12)
    with pytest.raises(ValueError, match="The weld 'glue' holds its bodies in another pose"):
        mb.from_mujoco(WELDED.format('relpose="0 0 2 1 0 0 0"'))


def test_urdf():
    robot = mb.from_mujoco(
        """<robot name="arm"><link name="base"/><link name="rod"><inertial><mass value="2"/>
        <origin xyz="0 0 -0.5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="pin" type="continuous"><parent link="base"/><child link="rod"/>
        <axis xyz="0 1 0"/></joint></robot>"""
    )
    assert robot.names == ("rod",)
    assert robot.joint_names == ("pin",)


BODY = """<mujoco><worldbody><body name="bob">{}<geom name="ball" size="0.1" {}/></body>{}
</worldbody>{}</mujoco>"""
FREE = '<joint name="j"/>'
QUIET = 'contype="0"'
COUPLED_TENDON = """<tendon><fixed name="rope"><joint joint="j" coef="1"/></fixed></tendon>
<equality><tendon name="belt" tendon1="rope"/></equality>"""


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (('<joint name="j" range="-1 1" limited="true"/>', QUIET, "", ""), "joint limit: j"),
        (('<joint name="j" frictionloss="1"/>', QUIET, "", ""), "friction loss: j"),
        (
            ('<joint name="j" type="ball" armature="1"/>', QUIET, "", ""),
            "armature of several coordinates: j",
        ),
        (('<joint name="j" type="ball" stiffness="1"/>', QUIET, "", ""), "stiffness of several .*: j"),
        ((FREE, "", '<geom name="floor" type="plane" size="1 1 1"/>', ""), "contact: .*ball"),
        (
            (FREE, QUIET, "", '<tendon><fixed name="rope" limited="true" range="0 1"><joint joint="j" coef="1"/></fixed></tendon>'),
            "tendon: rope",
        ),
        (
            (FREE, QUIET, "", COUPLED_TENDON),
            "equality of type tendon: belt",
        ),
        (
            (FREE, QUIET, "", '<actuator><general name="lag" joint="j" dyntype="filter"/></actuator>'),
            "actuator dynamics: lag",
        ),
        (
            (FREE, QUIET, '<body name="m" mocap="true"/>', ""),
            "mocap body",
        ),
    ],
)  # fmt: skip
def test_what_is_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        mb.from_mujoco(BODY.format(*parts))


def test_actuators_of_a_group_that_is_switched_off():
    xml = BODY.format(FREE, QUIET, "", '<actuator><motor joint="j" group="1"/></actuator>')
    xml = xml.replace("<mujoco>", '<mujoco><option actuatorgroupdisable="1"/>')
    assert not mb.from_mujoco(xml).loads


FLAGGED = """<mujoco><option><flag {}="disable" gravity="disable"/></option><worldbody><body>
<joint name="j" stiffness="2" springref="90" damping="3"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 2"/></body></worldbody>
<tendon><fixed stiffness="0.4" damping="0.7"><joint joint="j" coef="1"/></fixed></tendon><actuator><motor joint="j" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("flag", "clamped", "sprung", "damped"),
    [("clampctrl", 2.5, 1, 1), ("spring", 1, 0, 1), ("damper", 1, 1, 0)],
)
def test_flags(flag, clamped, sprung, damped):
    """Controls beyond their limits, no springs, or no dampers, of joints and of tendons."""
    model = mujoco.MjModel.from_xml_string(FLAGGED.format(flag))
    data, angle, rate = mujoco.MjData(model), 0.3, 0.9
    data.ctrl[:], data.qpos[:], data.qvel[:] = 2.5, angle, rate
    mujoco.mj_forward(model, data)
    joints = mb.JointCoordinates(mb.from_mujoco(model, control=lambda t, args: args))
    y = jnp.array([angle]), jnp.array([rate])
    found = joints.terms.vf(0.0, y, jnp.array([2.5]))[1]
    # the tendon is slack where the spring of the joint is
    springs, dampers = (2 + 0.4) * (np.pi / 2 - angle), -(3 + 0.7) * rate
    np.testing.assert_allclose(found, data.qacc, rtol=1e-12)
    expected = (clamped + sprung * springs + damped * dampers) / 2
    np.testing.assert_allclose(found, [expected], rtol=1e-12)


def test_contacts_that_the_file_excludes():
    other = '<body name="other" pos="1 0 0"><freejoint/><geom size="0.1"/></body>'
    excluded = '<contact><exclude body1="other" body2="bob"/></contact>'
    robot = mb.from_mujoco(BODY.format(FREE, "", other, excluded))
    assert robot.names == ("bob", "other")


def test_what_is_left_out_on_request():
    xml = BODY.format('<joint name="j" range="-1 1" limited="true"/>', QUIET, "", "")
    with pytest.raises(ValueError, match=r"mean nothing here: \['joint limits'\].*'joint limit'"):
        mb.from_mujoco(xml, ignore=("joint limits",))
    with pytest.raises(ValueError, match="`model` has no body that moves"):
        mb.from_mujoco("<mujoco/>")
    with pytest.raises(ValueError, match=r"mean nothing here: \['equality of type joint'\]"):
        mb.from_mujoco(xml, ignore=("joint limit", "equality of type joint"))
    both = xml.replace("<geom", '<joint name="k" axis="1 0 0"/><geom')
    assert mb.from_mujoco(both, ignore=("joint limit",)).joint_names == ("j k",)
    stop = mb.JointStop("j", -1.0, 1.0, 10.0)
    assert mb.from_mujoco(both, ignore=("joint limit",), forces=[stop]).joint_names == ("j", "k")
    robot = mb.from_mujoco(xml, ignore=("joint limit",))
    assert robot.joint_names == ("j",)
    shifted = both.replace('name="j" range', 'name="j" ref="20" range')
    robot = mb.from_mujoco(shifted, stops=functools.partial(mb.JointStop, stiffness=10.0))
    assert robot.joint_names == ("j", "k")
    (stops,) = (group.laws for group in robot.loads if hasattr(group.laws, "lower"))
    np.testing.assert_allclose((stops.lower[0], stops.upper[0]), np.radians([-21, -19]))
    ball = BODY.format('<joint type="ball" range="0 1" limited="true"/>', QUIET, "", "")
    with pytest.raises(ValueError, match="joint limit"):
        mb.from_mujoco(ball, stops=functools.partial(mb.JointStop, stiffness=10.0))
    with pytest.raises(TypeError, match="sequence of words"):
        mb.from_mujoco(xml, ignore="joint limit")
    with pytest.raises(TypeError, match="`model` must be"):
        mb.from_mujoco(3)
    robot = mb.from_mujoco(
        BODY.format(FREE, QUIET, "", '<actuator><motor joint="j"/></actuator>'),
        control=lambda t, args: jnp.zeros(()),
    )
    with pytest.raises(ValueError, match=r"shape \(nu,\)"):
        accelerations(robot, robot.state(), None)
