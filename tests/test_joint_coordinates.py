"""Assemblies in the coordinates of their joints: the same motions as in the poses of all bodies."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj


mb = mj.multibody
GRAVITY = (0.3, -0.2, -9.81)


def body(name, i, at):
    """A body with moments that differ, turned in the drawing."""
    turned = mb.quaternion((1.0, 0.3 * i, -0.5), 0.4 + 0.3 * i)
    inertia = np.diag([0.2, 0.25, 0.3]) + 0.005 * (i + 1) * np.ones((3, 3))
    return mb.Body(name, 1.0 + 0.3 * i, inertia, position=at, orientation=turned)


def every_joint():
    """Each kind of joint in the tree, some with the parent as the second body, and loops: a rod, a ball joint
    and a drive; one body moves freely on a spring."""
    bodies = [
        body(name, i, np.array([0.5 * i, 0.2 * i, -0.3 * i])) for i, name in enumerate("abcdefghi")
    ]
    joints = [
        mb.Revolute(mb.GROUND, "a", at=(0, 0, 0.2), axis=(0.2, 1, 0.1), name="hinge"),
        mb.Universal("b", "a", at=(0.3, 0.1, 0), axis=((1, 0, 0.5), (-0.5, 0.2, 1)), name="cardan"),
        mb.Cylindrical("c", "b", at=(0.8, 0.3, -0.5), axis=(1, 1, 0), name="screw"),
        mb.Spherical("d", "c", at=(1.2, 0.5, -0.7), name="ball"),
        mb.Prismatic("e", "d", at=(1.7, 0.7, -1.0), axis=(0, 1, 0.4), name="slider"),
        mb.Fixed("e", "f", name="weld"),
        mb.Revolute("g", "b", at=(0.4, 0.4, -0.2), axis=(1, 0, 0.3), name="branch"),
        mb.Universal("d", "g", at=(1.0, 0.5, 0.1), axis=((1, 0, 0), (0, 0, 1)), name="closing"),
        mb.Spherical("h", "f", at=(2.8, 1.0, -2.0), name="hand"),
        mb.Distance("f", mb.GROUND, between=((2.5, 1.0, -1.5), (3.0, 0, 1)), name="rod"),
        mb.Drive("hinge", lambda t, args: 0.2 * jnp.sin(3 * t), name="drive"),
    ]
    forces = [
        mb.Spring("i", "f", points=((0.1, 0, 0), (0, 0.2, 0)), stiffness=20.0, length=0.5),
        mb.JointSpring("slider", stiffness=5.0, damping=0.3),
        mb.Torque("d", (0.1, -0.2, 0.3)),
        mb.Controller(
            ("branch",), lambda t, y, args: y[0].position[3, :1] - y[1].orientation[6, 1:2]
        ),
    ]
    return mb.Assembly(bodies, joints, forces, gravity=GRAVITY)


def in_the_plane(damping=0.4, rotors=()):
    """A slider-crank whose slider is the first body of its joint, and a body that moves freely on a damper."""
    bodies = [
        mb.Body("crank", 1.0, 0.1, position=(0.3, 0.1), orientation=0.4),
        mb.Body("rod", 0.7, 0.2, position=(1.0, 0.3), orientation=-1.9),
        mb.Body("slider", 2.0, 0.3, position=(1.7, 0.2), orientation=2.8),
        mb.Body("weight", 1.5, 0.2, position=(0.0, -1.0), orientation=-0.7),
    ]
    joints = [
        mb.Revolute("crank", mb.GROUND, at=(0, 0)),
        mb.Revolute("crank", "rod", at=(0.6, 0.2)),
        mb.Revolute("slider", "rod", at=(1.5, 0.1)),
        mb.Prismatic("slider", mb.GROUND, at=(1.7, 0.2), axis=(1, 0.2), name="guide"),
        mb.Distance("weight", "crank", between=((0.1, -0.9), (0.4, 0.0))),
    ]
    forces = [mb.Damper("weight", "rod", between=((0.0, -1.0), (1.0, 0.3)), damping=damping)]
    return mb.Assembly(bodies, joints, [*forces, *rotors], gravity=(0.2, -9.81))


MECHANISMS = {"in space": every_joint, "in the plane": in_the_plane}


def moving(assembly, seed=0):
    """The drawing, closed, with random velocities that the joints allow."""
    random = np.random.default_rng(seed)
    planar, names = assembly.bodies.planar, assembly.names
    return assembly.state(
        velocities={names[-1]: random.normal(size=2 if planar else 3)},
        angular_velocities={names[-1]: random.normal(size=() if planar else 3)},
        assemble=True,
    )


def perturbed(joints, y, seed=1):
    """Another state: positions and velocities moved along the manifold."""
    random, (q, v) = np.random.default_rng(seed), y
    J = np.asarray(eqx.filter_jit(joints.system.holonomic.jacobian)(0.0, q, None))
    free = scipy.linalg.null_space(J)
    q = q + 0.1 * free @ random.normal(size=free.shape[1])
    v = v + free @ random.normal(size=free.shape[1])
    move = lambda y: mj.project(joints.constraint, 0.0, y)[0]
    return jax.jit(move)((q, v))


def accelerations_of_poses(joints, y):
    a = joints.system.accelerations(0.0, y)
    return jax.jvp(lambda y: joints.poses(y)[1].coordinates, (y,), ((y[1], a),))[1]


@pytest.fixture(scope="module", params=MECHANISMS)
def case(request):
    """A mechanism, its coordinates, and a state away from the drawing, where every axis has moved."""
    assembly = MECHANISMS[request.param]()
    joints = mb.JointCoordinates(assembly)
    y = perturbed(joints, joints.state(moving(assembly)))
    return assembly, joints, y, eqx.filter_jit(joints.poses)(y)


def test_accelerations_are_those_in_poses_of_bodies(case):
    assembly, joints, y, poses = case
    assert max(np.abs(gap).max() for gap in assembly.gaps(poses[0]).values()) < 1e-13
    found = eqx.filter_jit(accelerations_of_poses)(joints, y)
    expected = eqx.filter_jit(assembly.system.accelerations)(0.0, poses).coordinates
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_jacobians_are_derivatives(case):
    """Of placements and equations of loops, also where the norms of quaternions are not one."""
    _, joints, (q, v), _ = case
    q = q + 0.1 * np.random.default_rng(0).normal(size=q.shape)
    equations = joints.system.holonomic
    found = eqx.filter_jit(equations.jacobian)(0.3, q, None)
    expected = jax.jit(jax.jacfwd(lambda q: equations(0.3, q, None)))(q)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    position = lambda q: joints.poses((q, v))[0].position
    _, velocity = jax.jvp(position, (q,), (v,))
    np.testing.assert_allclose(joints.poses((q, v))[1].position, velocity, rtol=0, atol=1e-14)


def test_states_and_poses_are_inverse(case):
    assembly, joints, y, poses = case
    for found, expected in zip(joints.state(poses), y, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    by_name = eqx.filter_jit(assembly.joint_coordinates)(poses)
    for name, value in zip(joints.names, y[0], strict=True):
        if name in by_name:
            np.testing.assert_allclose(by_name[name], value, rtol=0, atol=1e-14)
    assert set(joints.names) & set(by_name)


@eqx.filter_jit
def solve(terms, constraint, y0):
    hook = dfx.Dopri8() if constraint is None else mj.Projected(dfx.Dopri8(), constraint)
    control = dfx.PIDController(rtol=1e-11, atol=1e-11)
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 0.5, 6))
    return mj.diffeqsolve(
        terms, hook, 0.0, 0.5, None, y0, saveat=saveat, stepsize_controller=control
    )


def test_a_solve_stays_on_the_manifold_and_keeps_the_energy():
    assembly = in_the_plane(damping=0.0)
    joints = mb.JointCoordinates(assembly)
    sol = solve(joints.terms, joints.constraint, joints.state(moving(assembly)))
    poses = joints.poses(sol.ys)
    assert max(np.abs(gap).max() for gap in assembly.gaps(poses[0]).values()) < 1e-14
    energy = assembly.energy(poses)
    np.testing.assert_allclose(energy.total, energy.total[0], rtol=0, atol=1e-9)
    assert np.ptp(energy.kinetic) > 1


def chain(mass=0.7, length=0.8, rotors=()):
    """A double pendulum in space with a hinge and a slider: no loops."""
    bodies = [
        mb.Body("upper", 1.0, (0.1, 0.1, 0.01), position=(0, 0, -0.5)),
        mb.Body("lower", mass, (0.1, 0.1, 0.01), position=(0, 0, -1.4)),
    ]
    joints = [
        mb.Revolute(mb.GROUND, "upper", points=((0, 0, 0), (0, 0, 0.5)), axis=(0, 1, 0)),
        mb.Prismatic("upper", "lower", points=((0, 0, -length), (0, 0, 0.2)), axis=(0.3, 0, 1)),
    ]
    return mb.Assembly(bodies, joints, rotors, gravity=GRAVITY)


def test_trees_have_no_constraint():
    assembly = chain()
    joints = mb.JointCoordinates(assembly)
    assert joints.constraint is None
    assert joints.names == ("Revolute ground-upper", "Prismatic upper-lower")
    y0 = (jnp.array([0.4, 0.1]), jnp.array([1.0, -0.5]))
    energy = assembly.energy(joints.poses(solve(joints.terms, None, y0).ys))
    np.testing.assert_allclose(energy.total, energy.total[0], rtol=0, atol=1e-9)
    assert np.ptp(energy.kinetic) > 1


def test_a_tree_as_a_mechanical_system():
    """A bar on a hinge has no equations: steps of RATTLE are those of Verlet in its angle, and it hangs at rest."""
    bar, hinge = (
        mb.Body("bar", 2.0, 0.3, position=(0.5, 0)),
        mb.Revolute(mb.GROUND, "bar", at=(0, 0)),
    )
    joints = mb.JointCoordinates(mb.Assembly([bar], [hinge], gravity=(0, -9.81), redundant=True))
    q, v, h = jnp.array([0.4]), jnp.array([1.5]), 0.1
    fall = lambda q: -9.81 * np.cos(q) / 0.8
    middle = v + h / 2 * fall(q)
    after = q + h * middle
    hook = mj.rattle(joints.system)
    ys = mj.diffeqsolve(joints.terms, hook, 0.0, h, h, (q, v), max_steps=1).ys
    np.testing.assert_allclose(ys, ([after], [middle + h / 2 * fall(after)]), rtol=1e-13)
    found = mj.equilibrium(joints.system, jnp.array([-1.2]))
    assert float(found.q[0]) == pytest.approx(-np.pi / 2)
    assert found.multipliers.size == 0


def test_symplectic_steps_of_a_long_chain():
    """In the angles of many links masses have a bad condition, and rounding keeps the equations of a step
    from holding to the last digits. Steps are reversible."""
    links = range(8)
    bars = [mb.Body(f"{i}", 1.0, 0.01, position=(0.4 * i + 0.2, 0)) for i in links]
    ends = [mb.GROUND, *(bar.name for bar in bars)]
    hinges = [mb.Revolute(ends[i], ends[i + 1], at=(0.4 * i, 0)) for i in links]
    joints = mb.JointCoordinates(mb.Assembly(bars, hinges, gravity=(0, -9.81)))
    hook = mj.rattle(joints.system)

    @jax.jit
    def steps(q, v):
        sol = mj.diffeqsolve(joints.terms, hook, 0.0, 0.02, 0.01, (q, v), max_steps=2)
        return jax.tree.map(lambda leaf: leaf[-1], sol.ys)

    q0, v0 = jnp.linspace(0.3, 1.0, 8), jnp.linspace(1.0, -2.0, 8)
    q1, v1 = steps(q0, v0)
    q, v = steps(q1, -v1)
    assert jnp.max(jnp.abs(q1 - q0)) > 0.01
    np.testing.assert_allclose(q, q0, atol=1e-12)
    np.testing.assert_allclose(v, -v0, atol=1e-10)


def test_gradients_by_numbers_of_the_assembly():
    """Of accelerations: forward = reverse = differences, for the masses and the points of the joints, which
    move with the whole tree; vmapped = single."""
    joints = mb.JointCoordinates(in_the_plane())
    y = joints.state(moving(joints.assembly))

    def size(scale):
        assembly = joints.assembly
        points = assembly.joints[0].attachment.points
        changed = eqx.tree_at(
            lambda a: (a.bodies.mass, a.joints[0].attachment.points),
            assembly,
            (assembly.bodies.mass * scale[0], points.at[1, 1].multiply(scale[1])),
        )
        own = eqx.tree_at(lambda j: j.assembly, joints, changed)
        a = own.system.accelerations(0.0, y)
        return jnp.sum(own.poses((y[0], a))[1].position ** 2)

    at, h = jnp.array([1.0, 1.0]), 1e-4
    value, reverse = eqx.filter_jit(jax.value_and_grad(size))(at)
    forward = eqx.filter_jit(jax.jacfwd(size))(at)
    moved = at[None] + h * jnp.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    values = eqx.filter_jit(jax.vmap(size))(moved)
    differences = (values[1::2] - values[2::2]) / (2 * h)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(forward, differences, rtol=3e-6)
    np.testing.assert_allclose(values[0], value, rtol=1e-12)


def test_dependent_equations_of_loops_are_left_out():
    """A four-bar linkage in space: three of the five equations of its last hinge follow from the others."""
    problem = mj.problems.four_bar()
    linkage = cases.four_bar_in_space(problem.args, problem.y0)
    joints = mb.JointCoordinates(linkage.without_dependent_equations())
    assert len(joints.names) == 3
    assert joints.independent is not None
    assert len(joints.independent) == 2
    y = joints.state()
    found = eqx.filter_jit(accelerations_of_poses)(joints, y)
    hinged = joints.assembly.system
    expected = eqx.filter_jit(hinged.accelerations)(0.0, joints.poses(y)).coordinates
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def accelerations_of_lagrange(joints, y):
    """From the energies of the assembly: `d/dt dT/dv - d(T - V)/dq = J^T lambda`, in NumPy at the end."""
    energy = lambda q, v: joints.assembly.energy(joints.poses((q, v)))
    kinetic = lambda q, v: energy(q, v).kinetic
    lagrangian = lambda q, v: energy(q, v).kinetic - energy(q, v).potential
    (q, v), equations = y, joints.system.holonomic
    along = lambda f: jax.jvp(f, (q,), (v,))[1]

    @jax.jit
    def parts():
        momentum = lambda q: jax.grad(kinetic, 1)(q, v)
        rows = lambda q: jax.jacfwd(lambda q: equations(0.0, q, None))(q)
        M = jax.hessian(kinetic, 1)(q, v)
        return M, jax.grad(lagrangian)(q, v) - along(momentum), rows(q), -along(rows) @ v

    M, force, J, bias = map(np.asarray, parts())
    m = len(bias)
    whole = np.block([[M, J.T], [J, np.zeros((m, m))]])
    return np.linalg.solve(whole, np.concatenate([force, bias]))[: len(force)]


ROTORS = {"Revolute crank-ground": 0.7, "Revolute slider-rod": 0.4, "guide": 3.0}


def test_rotors():
    """In joints of a loop, also where the first body of a joint is the child, and one that closes the loop
    without them."""
    rotors = [mb.RotorInertia(joint, value) for joint, value in ROTORS.items()]
    assembly = in_the_plane(damping=0.0, rotors=rotors)
    bare = mb.JointCoordinates(in_the_plane(damping=0.0))
    joints = mb.JointCoordinates(assembly)
    assert set(ROTORS) <= set(joints.names)
    assert not set(ROTORS) <= set(bare.names)
    y = perturbed(joints, joints.state(moving(assembly)))
    found = eqx.filter_jit(joints.system.accelerations)(0.0, y)
    np.testing.assert_allclose(found, accelerations_of_lagrange(joints, y), rtol=1e-11)
    poses = eqx.filter_jit(joints.poses)(y)
    without = eqx.filter_jit(bare.system.accelerations)(0.0, bare.state(poses))
    shared = [name for name in bare.names if name in joints.names]
    pick = lambda names, a: np.asarray(a)[[names.index(name) for name in shared]]
    change = pick(joints.names, found) - pick(bare.names, without)
    assert np.abs(change).max() > 0.1 * np.abs(found).max()


def test_gradients_by_the_inertia_of_rotors():
    """A hinge and a slider without loops, by inertia: forward = reverse = differences; vmapped = single."""

    def size(inertia):
        names = "Revolute ground-upper", "Prismatic upper-lower"
        joints = mb.JointCoordinates(chain(rotors=list(map(mb.RotorInertia, names, inertia))))
        y = (jnp.array([0.4, 0.1]), jnp.array([1.0, -0.5]))
        return jnp.sum(joints.terms.vf(0.0, y, None)[1] ** 2)

    at, h = jnp.array([0.3, 0.5]), 1e-4
    value, reverse = jax.jit(jax.value_and_grad(size))(at)
    np.testing.assert_allclose(reverse, jax.jit(jax.jacfwd(size))(at), rtol=1e-12)
    moved = at[None] + h * jnp.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    values = jax.jit(jax.vmap(size))(moved)
    np.testing.assert_allclose(reverse, (values[1::2] - values[2::2]) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(values[0], value, rtol=1e-13)


def test_messages_of_rotors(as_a_user_meets_it):
    rotors = [mb.RotorInertia("Revolute ground-upper", 0.1)]
    with pytest.raises(ValueError, match=r"`RotorInertia` of.*\n?.*`mj.multibody.JointCoordinates"):
        chain(rotors=rotors).system  # noqa: B018
    system = mb.parametrized(lambda args: chain(rotors=rotors))
    with pytest.raises(ValueError, match="`RotorInertia` of the joints"):
        system.terms.vf(0.0, chain().state(assemble=True), None)
    everywhere = [*ROTORS, "Revolute crank-rod"]
    assembly = in_the_plane(rotors=[mb.RotorInertia(joint, 1.0) for joint in everywhere])
    with pytest.raises(
        ValueError, match="joints with `RotorInertia` or `Coupling`, .* form a closed"
    ):
        mb.JointCoordinates(assembly)
    with pytest.raises(ValueError, match="`inertia` must not be negative, got -1"):
        chain(rotors=[mb.RotorInertia("Prismatic upper-lower", -1.0)])
    with pytest.raises(ValueError, match="names the joint 'elbow', which is not there"):
        chain(rotors=[mb.RotorInertia("elbow", 1.0)])
    with pytest.raises(ValueError, match=r"a Distance, .*Rotors belong to `Revolute`"):
        in_the_plane(rotors=[mb.RotorInertia("Distance weight-crank", 1.0)])


def test_single_precision_stays_single(case):
    _, joints, y, _ = case
    single = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    joints, y = jax.tree.map(single, (joints, y))
    evaluate = lambda joints, y: (joints.system.accelerations(0.0, y), joints.poses(y))
    for found in jax.tree.leaves(eqx.filter_eval_shape(evaluate, joints, y)):
        assert found.dtype == jnp.float32


def test_messages(as_a_user_meets_it):
    assembly = chain()
    with pytest.raises(TypeError, match="`assembly` must be an `mj.multibody.Assembly`, got str"):
        mb.JointCoordinates("robot")
    joints = mb.JointCoordinates(assembly)
    q, v = assembly.state(assemble=True)
    shifted = lambda q: eqx.tree_at(lambda q: q.coordinates, q, q.coordinates.at[1, 1].add(0.1))
    with pytest.raises(
        ValueError, match="the positions of 'lower' are not those that the joints allow .gap 0.1"
    ):
        joints.state((shifted(q), v))
    with pytest.raises(ValueError, match="the velocities of 'lower' are not those"):
        joints.state((q, shifted(v)))
