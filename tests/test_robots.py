"""Robots from URDF files with closed loops, against textbook equations of a five-bar in the plane."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robot_cases as cases
from scipy.spatial.transform import Rotation

import manifold_jax as mj
from manifold_jax._multibody.closures import motions_of
from manifold_jax._multibody.kinematic_tree import KinematicTree
from manifold_jax._multibody.urdf_elements import read_elements


mb = mj.multibody
TORQUES = np.array([0.7, -0.4])


def read(file=None, **options):
    given = dict(closures=cases.CLOSURES, configuration=cases.START, control=lambda t, args: args)
    return mb.read_urdf(file or cases.five_bar(), **(given | options))


@pytest.fixture(scope="module")
def robot():
    return read()


def angles_of(robot, y):
    """Of upper and lower links from the vertical, in the frames of the file."""
    rotations = (
        robot.frame(y, f"{side} {part}")[1]
        for side in ("left", "right")
        for part in ("upper", "lower")
    )
    return np.array([np.arctan2(R[0, 2], R[2, 2]) for R in map(np.asarray, rotations)])


def textbook(angles, rates, torques):
    """Accelerations of the four angles."""
    arms = [
        cases.arm(side, angles[i : i + 2], rates[i : i + 2])
        for i, side in ((0, "left"), (2, "right"))
    ]
    M, J = np.zeros((4, 4)), np.hstack([arms[0][2], -arms[1][2]])
    M[:2, :2], M[2:, 2:] = arms[0][0], arms[1][0]
    braking = cases.DAMPING * (rates[3] - rates[2])
    force = np.array([torques[0], 0, torques[1] + braking, -braking]) - np.concatenate(
        [arms[0][1], arms[1][1]]
    )
    system = np.block([[M, J.T], [J, np.zeros((2, 2))]])
    return np.linalg.solve(system, np.concatenate([force, arms[1][3] - arms[0][3]]))[:4]


def test_accelerations_are_those_of_the_textbook(robot):
    y = robot.assembly.state(
        angular_velocities={"left upper": (0, 1.3, 0), "right upper": (0, -0.8, 0)}, assemble=True
    )
    angles = angles_of(robot, y)
    assert np.allclose(cases.tip("left", angles[:2]), cases.tip("right", angles[2:]), atol=1e-14)
    np.testing.assert_allclose(angles[[0, 2]], [-0.6, 0.5], atol=1e-14)
    names = ("left upper", "left lower", "right upper", "right lower")
    spins = lambda y: jnp.stack([robot.assembly.motion(y, name).angular_velocity for name in names])
    a = robot.assembly.system.accelerations(0.0, y, TORQUES)
    rates, change = eqx.filter_jvp(spins, (y,), ((y[1], a),))
    expected = textbook(angles, np.asarray(rates[:, 1]), TORQUES)
    np.testing.assert_allclose(change[:, 1], expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(change[:, ::2], 0, atol=1e-11)


def test_bodies_joints_and_frames_have_the_names_of_the_file(robot):
    assert set(robot.assembly.names) == {"left upper", "left lower", "right upper", "right lower"}
    assert "about x about y about z" in robot.assembly.joint_names
    assert robot.motors == ("left shoulder", "right shoulder")
    assert robot.limits["left shoulder"] == (-2.0, 1.5)
    assert set(robot.configuration) == {"left shoulder", "right shoulder", "right elbow", "tip"}
    # What is welded to the left lower link is part of it.
    tip = robot.frames["right tip"]
    assert tip.body == "left lower"
    np.testing.assert_allclose(tip.at, robot.frames["left tip"].at, atol=1e-14)
    assert robot.frames["base"].body == mb.GROUND
    # Of 4 bodies with 7 coordinates, two motions are left; all equations are still reported.
    assert len(robot.assembly.independent.rows) == 4 * 7 - 2
    assert sum(gap.size for gap in robot.assembly.gaps(robot.assembly.state()[0]).values()) == 23


def end_of_swing(assembly, torques):
    """The tip after 0.2 s; all numbers of the file are leaves of the assembly."""
    system, start = assembly.system, assembly.state(assemble=True)
    hook = mj.Projected(dfx.Tsit5(), system.constraint)
    sol = mj.diffeqsolve(system.terms, hook, 0.0, 0.2, 0.02, start, torques)
    at, _ = assembly.point(jax.tree.map(lambda y: y[-1], sol.ys), "left lower", (0.0, 0.0, 0.22))
    return at @ jnp.array([1.0, 0.0, 0.3])


def mass(assembly):
    return assembly.bodies.mass


def hinge_point(assembly):
    return assembly.joints[0].attachment.points


def damping(assembly):
    loads = (load for load in assembly.loads if "damping of right elbow" in load.attachment.names)
    return next(loads).laws.damping


@pytest.mark.slow
def test_gradients_by_numbers_of_the_file(robot):
    """By a mass, a damping and a length: reverse mode and differences."""
    torques = jnp.asarray(TORQUES)
    both = eqx.filter_jit(eqx.filter_value_and_grad(end_of_swing))  # one program for all
    _, by_file = both(robot.assembly, torques)
    places = ((mass, (1,)), (damping, (0,)), (hinge_point, (1, 1, 2)))
    for leaf, place in places:
        shifted = lambda h, leaf=leaf, place=place: eqx.tree_at(
            leaf, robot.assembly, leaf(robot.assembly).at[place].add(h)
        )
        f = lambda h, shifted=shifted: float(both(shifted(h), torques)[0])
        h = 1e-4
        difference = (8 * (f(h) - f(-h)) - f(2 * h) + f(-2 * h)) / (12 * h)
        gradient = float(leaf(by_file)[place])
        assert abs(gradient) > 1e-5
        assert gradient == pytest.approx(difference, rel=1e-7)


def test_joints_of_chains_allow_what_the_file_allows():
    """Wherever the coordinates of the tree are, the bodies satisfy the equations of the joints that were made
    of it: hinges and sliders one after the other, and joints whose type is changed."""
    chain = cases.chain()
    robot = mb.read_urdf(chain, closures=cases.CHAIN_TYPES, gravity=(0.0, 0.0, 0.0))
    kinds = {name: group.kind for group in robot.assembly.joints for name in group.attachment.names}
    assert kinds == {
        "slide": mb.Prismatic,
        "across first across second": mb.Universal,
        "turn push": mb.Cylindrical,
        "ball": mb.Spherical,
        "cardan": mb.Universal,
    }
    links, joints = read_elements(chain)
    types = dict(zip(cases.CHAIN_TYPES["joint_name"], cases.CHAIN_TYPES["joint_type"], strict=True))
    tree = KinematicTree(links, joints, {joint.name: motions_of(joint, types) for joint in joints})
    drawn, _ = tree.place(np.zeros(tree.size))
    moved, _ = tree.place(np.random.default_rng(3).normal(size=tree.size))
    names, positions, orientations = robot.assembly.names, {}, {}
    for name, center in zip(names, np.asarray(robot.assembly.bodies.drawing.position), strict=True):
        turn = moved[name].rotation @ drawn[name].rotation.T
        positions[name] = moved[name].origin + turn @ (center - drawn[name].origin)
        orientations[name] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    y = robot.assembly.state(positions, orientations)  # refuses gaps above 1e-6
    gaps = robot.assembly.gaps(y[0])
    assert max(float(jnp.max(jnp.abs(gap))) for gap in gaps.values()) < 1e-14
    # And no more than that: as many motions as coordinates.
    assert 7 * len(names) - sum(gap.size for gap in gaps.values()) - len(names) == tree.size


def test_a_free_base_falls():
    """Without a support all links fall, and a torque of a motor turns nothing as a whole."""
    robot = read(floating_base=True, gravity=(0.0, 0.0, -9.81))
    y = robot.assembly.state()
    a = robot.assembly.system.accelerations(0.0, y, TORQUES)
    mass = robot.assembly.bodies.mass[:, None]
    assert len(robot.assembly.names) == 5
    falling = np.sum(mass * a.position, axis=0) / np.sum(mass)
    np.testing.assert_allclose(falling, [0, 0, -9.81], atol=1e-10)


def test_mimics_of_a_link_without_mass():
    """Two links mimic a third, without mass, by ratios with which they go beyond half a turn."""
    links = "".join(
        cases.link(name, mass, 0.2) for name, mass in (("a", 1.0), ("b", 0), ("c", 1.0))
    )
    mimic = '<mimic joint="middle" multiplier="{}"/>'
    file = f"""<robot name="gears">{cases.link("base")}{links}
    {cases.joint("left", "continuous", "base", "a", more=mimic.format(4))}
    {cases.joint("middle", "continuous", "base", "b")}
    {cases.joint("right", "continuous", "base", "c", more=mimic.format(-1))}</robot>"""
    given = {"closures": {"name_mot": ["left"]}, "control": lambda t, args: args}
    robot = mb.read_urdf(file, configuration={"middle": 1.0}, gravity=(0.0, 0.0, 0.0), **given)
    assert robot.configuration == {"left": 4.0, "middle": 1.0, "right": -1.0}
    joints = mb.JointCoordinates(robot.assembly)
    a = eqx.filter_jit(joints.system.accelerations)(0.0, joints.state(), jnp.array([0.85]))
    found = dict(zip(joints.names, a))
    expected = 0.85 * 4 / (0.2 * (16 + 1))  # of the middle one
    for name, ratio in (("left", 4), ("middle", 1), ("right", -1)):
        np.testing.assert_allclose(found[name], ratio * expected, rtol=1e-12)


def test_forces_keep_hinges_of_their_own():
    """Hinges that would become a universal joint, but that a stop needs."""
    links = cases.link("base") + cases.link("between") + cases.link("arm", 1.0, 0.2, 0.1)
    file = f"""<robot name="wrist">{links}{cases.joint("h", "continuous", "base", "between")}
    {cases.joint("k", "continuous", "between", "arm", axis=(1, 0, 0))}</robot>"""
    assert mb.read_urdf(file).assembly.joint_names == ("h k",)
    robot = mb.read_urdf(file, forces=[mb.JointStop("h", -1.0, 1.0, 10.0)])
    assert set(robot.assembly.joint_names) == {"h", "k"}


def test_stops_at_the_limits_of_the_file(as_a_user_meets_it):
    """They count from the drawing; hinges that have them stay single."""
    limit = '<limit lower="-0.4" upper="1.0" effort="0" velocity="0"/>'
    links = cases.link("base") + cases.link("between") + cases.link("arm", 1.0, 0.2, 0.1)
    first = cases.joint("h", "revolute", "base", "between", more=limit)
    second = cases.joint("k", "continuous", "between", "arm", axis=(1, 0, 0))
    file = f'<robot name="wrist">{links}{first}{second}</robot>'
    given, seen = dict(configuration={"h": 0.3}, gravity=(0.0, 0.0, 0.0)), []

    def stop(*of):
        seen.append(of)
        return mb.JointStop(*of, stiffness=7.0)

    robot = mb.read_urdf(file, stops=stop, **given)
    ((name, lower, upper),) = seen
    assert (name, robot.limits) == ("h", {"h": (-0.4, 1.0)})
    np.testing.assert_allclose((lower, upper), (-0.7, 0.7), rtol=1e-15)
    assert set(robot.assembly.joint_names) == {"h", "k"}
    joints = mb.JointCoordinates(robot.assembly)
    push = lambda x: joints.terms.vf(0.0, (jnp.array([x, 0.0]), jnp.zeros(2)), None)[1][0]
    beyond = jnp.array([-0.9, 0.69, 0.8])
    back = jax.jit(jax.vmap(push))(beyond)
    assert back[1] == 0
    np.testing.assert_allclose(back[0] / back[2], -2.0, rtol=1e-12)
    assert mb.read_urdf(file, stops=lambda *of: None, **given).assembly.joint_names
    with pytest.raises(TypeError, match="`stops` must return a force .* 'h' it returned float"):
        mb.read_urdf(file, stops=lambda *of: 3.0, **given)
    with pytest.raises(TypeError, match=r"`stops` must be a callable `f\(joint, lower, upper\)`"):
        mb.read_urdf(file, stops=mb.JointStop, **given)


def test_links_without_mass_that_are_no_joints():
    """A link without mass between three joints, and one between two hinges of which one is damped: the limit of
    links with little mass."""
    first = '<link name="first"/>'
    flap = cases.link("flap", 0.1, 0.1, 0.2) + cases.joint("j", "revolute", "first", "flap")
    damped = '<dynamics damping="0.3"/>'
    file = cases.five_bar().replace(first, first + flap)
    file = file.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/>' + damped)
    little = [cases.link(name, 1e-7, 1e-9) for name in ("first", "second")]
    heavy = file.replace(first, little[0]).replace('<link name="second"/>', little[1])
    found = []
    for text in (file, heavy):
        robot = read(text)
        assert {"first", "second"} <= set(robot.assembly.names)
        joints = mb.JointCoordinates(robot.assembly)
        q, v = joints.state()
        accelerations = eqx.filter_jit(joints.system.accelerations)(0.0, (q, v), TORQUES)
        found.append(dict(zip(joints.names, accelerations)))
    names = sorted(found[0])
    assert names == sorted(found[1])
    pick = lambda values: np.array([values[name] for name in names])
    np.testing.assert_allclose(pick(found[0]), pick(found[1]), rtol=1e-4, atol=1e-4)


def test_a_joint_that_mimics_another():
    """A crank with a motor, and a slider that mimics it, `x = 0.5 z - 0.1`: accelerations from the sum of the
    energies of both."""
    mimic = '<mimic joint="turn" multiplier="0.5" offset="-0.1"/>'
    file = f"""<robot name="press">{cases.link("base")}{cases.link("crank", 0.5, 0.2)}{cases.link("ram", 2.0, 0.1)}
    {cases.joint("turn", "continuous", "base", "crank")}
    {cases.joint("push", "prismatic", "base", "ram", more=mimic)}</robot>"""
    given = {"closures": {"name_mot": ["turn"]}, "control": lambda t, args: args}
    robot = mb.read_urdf(file, configuration={"turn": 0.8}, gravity=(0.0, 0.0, 0.0), **given)
    assert abs(robot.configuration["push"] - 0.3) < 1e-15
    again = mb.read_urdf(file, configuration=robot.configuration, **given)
    assert again.configuration == robot.configuration
    joints = mb.JointCoordinates(robot.assembly)
    still = jax.tree.map(jnp.zeros_like, joints.state())
    found = eqx.filter_jit(joints.system.accelerations)(0.0, still, jnp.array([0.7]))
    expected = 0.7 / (0.2 + 0.5**2 * 2.0) * np.array([1, 0.5])
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert not mb.read_urdf(file, ignore=("mimic",), **given).assembly.couplings.names
    with pytest.raises(ValueError, match="Joints cannot mimic others as `file` says"):
        mb.read_urdf(file, configuration={"turn": 0.8, "push": 0.0}, **given)
    with pytest.raises(ValueError, match=r"<mimic> of 'push' needs .*\['arm'\] have not"):
        mb.read_urdf(file.replace('mimic joint="turn"', 'mimic joint="arm"'), **given)


@pytest.mark.parametrize(
    ("parent", "child", "floating"), [("base", "ground", False), ("ground", "arm", True)]
)
def test_links_that_move_are_not_called_ground(parent, child, floating):
    links = cases.link(parent, 1.0, 0.1) + cases.link(child, 1.0, 0.1)
    file = f"<robot name='r'>{links}{cases.joint('j', 'continuous', parent, child)}</robot>"
    with pytest.raises(ValueError, match="the link 'ground' moves, .* Rename the link"):
        mb.read_urdf(file, floating_base=floating)
    fixed = file.replace("ground", "world").replace("base", "ground")
    assert mb.read_urdf(fixed).assembly.joint_names == ("j",)  # where it does not move


CHANGES = {  # of the file and the arguments, and what is said
    "gap": (
        ("0 0 0.4", "0 0 1.4"),
        {},
        r"loops cannot be closed: left tip-right tip \(gap 0\.\d+\)",
    ),
    "pose": (
        (),
        {"configuration": {"left shoulder": -1.5, "right shoulder": 1.5}},
        "cannot be closed",
    ),
    "friction": (("damping=", "friction='1' damping="), {}, "<friction>.*right elbow.*ignore="),
    "mimic": (("<axis", "<mimic joint='tip'/><axis"), {}, "<mimic>"),
    "not a file": (("<robot name='five-bar'>", "<mujoco>"), {}, "is not XML"),
    "axis": (("0 1 0", "0 0 0"), {}, "axis of the joint 'left shoulder' is zero"),
    "two parents": (
        ("</robot>", cases.joint("j", "revolute", "base", "left tip") + "</robot>"),
        {},
        r"\['left tip'\] are children of several joints",
    ),
    "inertia": (
        ('iyy="0.004"', 'iyy="-0.004"'),
        {},
        "'left upper': `inertia` must be positive definite",
    ),
    "number": (
        ('mass value="0.8"', 'mass value="much"'),
        {},
        "'value' of the link 'left upper' must be a number",
    ),
    "no mass": (
        ('mass value="0.8"', 'mass value="0"'),
        {},
        "the link 'left upper' has moments of inertia but no mass",
    ),
    "no such link": (
        (),
        {"closures": {"closed_loop": [["tip", "top"]], "type": ["6d"]}},
        r"has \['top'\]",
    ),
    "type": (
        (),
        {"closures": {"closed_loop": [["left tip", "right tip"]], "type": ["5d"]}},
        "'3d' .* or '6d'",
    ),
    "entries": ((), {"closures": {"loops": []}}, r"entries \['loops'\]"),
    "ball motor": (
        (),
        {
            "closures": cases.CLOSURES
            | {"joint_name": ["tip"], "joint_type": ["SPHERICAL"], "name_mot": ["tip"]}
        },
        r"'name_mot' has \['tip'\]",
    ),
    "no motors": ((), {"closures": cases.CLOSURES | {"name_mot": []}}, "`control` needs motors"),
    "configuration": (
        (),
        {"configuration": {"elbow": 1.0}},
        "'elbow', which is no hinge or slider",
    ),
    "locked": (
        (),
        {
            "closures": cases.CLOSURES | {"closed_loop": [["second", "left lower"]]},
            "configuration": {},
        },
        "'about z' cannot move",
    ),
    "base": (
        (cases.link("base", 1.0, 0.1), cases.link("base")),
        {"floating_base": True},
        "the root link 'base' has no mass",
    ),
    "ignored": ((), {"ignore": ("mass",)}, r"`ignore` has \['mass'\]"),
    "one word": ((), {"ignore": "mimic"}, r"sequence of words, write `ignore=\('mimic',\)`"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_messages_name_what_is_wrong(case):
    change, options, message = CHANGES[case]
    file = cases.five_bar()
    if change:
        assert change[0] in file
        file = file.replace(*change)
    given = dict(closures=cases.CLOSURES, configuration=cases.START, control=lambda t, args: args)
    with pytest.raises((TypeError, ValueError), match=message):
        mb.read_urdf(file, **(given | options))
