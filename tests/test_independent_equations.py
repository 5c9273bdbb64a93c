"""Closed loops with as many equations as are independent: `Assembly.without_dependent_equations`."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody


def largest_gap(robot, ys):
    return max(float(jnp.max(jnp.abs(gap))) for gap in robot.gaps(ys[0]).values())


@pytest.mark.slow
def test_a_loop_in_space_moves_as_with_all_equations():
    """Bricard's mechanism: 30 equations of hinges for five rods that move in one way."""
    robot = cases.bricard()
    fewer = robot.without_dependent_equations()
    # Seven coordinates of each body, and one motion.
    assert len(fewer.independent.rows) == 5 * 7 - 1
    assert not fewer.system.redundant
    y = robot.state(angular_velocities={"rod 1": (0.0, 0.4, 0.0)}, assemble=True)
    hook = mj.Projected(dfx.Tsit5(), fewer.system.constraint)
    sol = mj.diffeqsolve(fewer.system.terms, hook, 0.0, 0.5, 0.01, y)
    assert largest_gap(fewer, sol.ys) < 1e-13  # of all 30
    end = jax.tree.map(lambda leaf: leaf[-1], sol.ys)
    all_equations = robot.system.accelerations(0.0, end, None)
    few = fewer.system.accelerations(0.0, end, None)
    np.testing.assert_allclose(few.coordinates, all_equations.coordinates, rtol=1e-9, atol=1e-9)


def test_light_beside_heavy_bodies():
    """A crank of a millionth of the mass, where eigenvalues do not tell which equations are needed."""
    problem = mj.problems.four_bar()
    args = problem.args._replace(masses=problem.args.masses * jnp.array([1e-6, 1.0, 1.0]))
    planar = cases.four_bar(args)
    flat = planar.system.accelerations(0.0, cases.four_bar_state(planar, problem.y0), args)
    loop = cases.four_bar_in_space(args, problem.y0, redundant=True)
    fewer = loop.without_dependent_equations()
    _, v = (np.asarray(part).reshape(3, 3) for part in problem.y0)
    of_bodies = lambda rows: dict(zip(cases.BARS, rows, strict=True))
    in_space = lambda v: np.array([v[0], 0.0, v[1]])
    y = loop.state(
        velocities=of_bodies([in_space(row) for row in v]),
        angular_velocities=of_bodies([(0.0, -row[2], 0.0) for row in v]),
    )
    a = fewer.system.accelerations(0.0, y, None)
    np.testing.assert_allclose(
        a.position[:, ::2], flat.position, rtol=1e-8
    )  # rounding times the ratio
    # What the ground exerts, and the weight, change the momentum of all bodies.
    forces = fewer.joint_forces(0.0, y)
    ground = sum(
        np.asarray(forces[f"Revolute {name}-ground"].force) for name in ("crank", "rocker")
    )
    mass = np.asarray(args.masses)[:, None]
    weight = mass.sum() * np.array([0.0, 0.0, -float(args.gravity)])
    np.testing.assert_allclose(
        weight - ground, np.sum(mass * a.position, axis=0), rtol=1e-8, atol=1e-8
    )


def test_drives_are_kept():
    """A crank that is turned as prescribed: none of its equations is left out."""
    problem = mj.problems.four_bar()
    drive = mb.Drive("Revolute crank-ground", lambda t, args: args * t**2)
    driven = cases.four_bar_in_space(
        problem.args, problem.y0, [drive]
    ).without_dependent_equations()
    # 20 of joints and norms are independent, and one of the drive.
    assert len(driven.independent.rows) == 21
    args, y = jnp.asarray(0.3), driven.state(args=0.3)
    a = driven.system.accelerations(0.0, y, args)
    spin = lambda y: driven.motion(y, "crank").angular_velocity
    _, turning = jax.jvp(spin, (y,), ((y[1], a),))
    # of the ground relative to the crank, about -y
    np.testing.assert_allclose(turning, [0, 0.6, 0], atol=1e-12)


def test_singular_drawings_and_traced_numbers_are_refused():
    bar = lambda name, x, length: mb.Body(name, 1.0, length**2 / 12, position=(x, 0.0))
    bodies = [bar("crank", 0.5, 1.0), bar("coupler", 2.0, 2.0), bar("rocker", 2.5, 1.0)]
    pins = (
        ("crank", mb.GROUND, 0),
        ("crank", "coupler", 1),
        ("coupler", "rocker", 3),
        ("rocker", mb.GROUND, 2),
    )
    joints = [mb.Revolute(a, b, at=(float(x), 0.0)) for a, b, x in pins]
    folded = mb.Assembly(bodies, joints)  # a parallelogram in one line
    with pytest.raises(ValueError, match="1 of the 8 equations .* in the drawing, and 0 nearby"):
        folded.without_dependent_equations()
    traced = eqx.filter_jit(lambda robot: robot.without_dependent_equations())
    with pytest.raises(ValueError, match="needs known numbers"):
        traced(folded)


def test_assemblies_without_dependent_equations_stay_as_they_are():
    arm = mb.Assembly([mb.Body("arm", 1.0, 0.1)], [mb.Revolute("arm", mb.GROUND, at=(0.0, 0.0))])
    assert arm.without_dependent_equations().independent is None


def on_a_turntable():
    """A four-bar linkage in the plane of x and z, its last joint a ball joint; the table turns about z."""
    rods = {"crank": (0, 0, 0.25), "coupler": (0.4, 0, 0.6), "rocker": (0.8, 0, 0.35)}
    bodies = [mb.Body(name, 1.0, (0.1, 0.12, 0.05), position=at) for name, at in rods.items()]
    bodies.append(mb.Body("table", 3.0, (1.0, 1.0, 1.0)))
    y = (0.0, 1.0, 0.0)
    joints = [
        mb.Revolute(mb.GROUND, "table", at=(0, 0, 0), axis=(0, 0, 1)),
        mb.Revolute("table", "crank", at=(0, 0, 0), axis=y),
        mb.Revolute("crank", "coupler", at=(0, 0, 0.5), axis=y),
        mb.Revolute("table", "rocker", at=(0.8, 0, 0), axis=y),
        mb.Spherical("coupler", "rocker", at=(0.8, 0, 0.7)),
    ]
    return mb.Assembly(bodies, joints).without_dependent_equations()


def turned(robot, angle):
    """The drawing, turned about z."""
    half = jnp.asarray(mb.quaternion((0, 0, 1), angle))
    q = robot.bodies.drawing
    c, s = jnp.cos(angle), jnp.sin(angle)
    R = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return mb.Pose(q.position @ R.T, jnp.broadcast_to(half, q.orientation.shape))


def test_the_choice_holds_when_the_plane_of_a_linkage_turns():
    """What follows from the other equations is across that plane."""
    robot = on_a_turntable()
    joints = mb.JointCoordinates(robot)
    assert len(joints.independent) == 2
    in_poses = eqx.filter_jit(lambda q: robot.system.holonomic.jacobian(0.0, q, None))
    in_joints = eqx.filter_jit(lambda q: joints.system.holonomic.jacobian(0.0, q, None))
    place = dict(zip(joints.names, range(4)))["Revolute ground-table"]
    smallest = lambda J: np.linalg.svd(J, compute_uv=False)[-1]
    expected = smallest(in_poses(turned(robot, 0.0))), smallest(in_joints(jnp.zeros(4)))
    for angle in (0.5, np.pi / 2, 2.5):
        found = (
            smallest(in_poses(turned(robot, angle))),
            smallest(in_joints(jnp.zeros(4).at[place].set(angle))),
        )
        np.testing.assert_allclose(found, expected, rtol=1e-9)
