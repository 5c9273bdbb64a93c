"""Rigid bodies with joints and forces: equal to systems written by hand, to laws and to MuJoCo.

What MJCF has to do with it is in `test_multibody_mujoco.py`.
"""

import functools
import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody
GRAVITY = (0.0, 0.0, -9.81)


@eqx.filter_jit
def end(system, y0, args=None, t1=0.3, tolerance=1e-13, solver=None):
    hook = mj.Projected(dfx.Tsit5() if solver is None else solver, system.constraint)
    control = dfx.PIDController(rtol=tolerance, atol=tolerance)
    sol = mj.diffeqsolve(
        system.terms, hook, 0.0, t1, None, y0, args, stepsize_controller=control, max_steps=65536
    )
    return jax.tree.map(lambda leaf: leaf[-1], sol.ys)


@eqx.filter_jit
def accelerations(system, y, args=None):
    return system.accelerations(0.0, y, args)


# Equal to systems written by hand


def test_four_bar_is_that_of_the_gallery():
    problem = mj.problems.four_bar()
    y0 = cases.four_bar_state(cases.four_bar(problem.args), problem.y0)
    q, v = end(mb.parametrized(cases.four_bar), y0, problem.args)
    for actual, expected in zip((q, v), problem.reference(0.3)):
        expected = expected.reshape(3, 3)
        np.testing.assert_allclose(actual.position, expected[:, :2], rtol=0, atol=1e-11)
        np.testing.assert_allclose(actual.orientation, expected[:, 2], rtol=0, atol=1e-11)


def test_slider_crank_is_that_of_the_gallery():
    """Revolute and prismatic joints, a spring with a damper, and a force at a point."""
    problem = mj.problems.slider_crank()
    robot = cases.slider_crank(problem.args)
    crank, _, rod = np.asarray(problem.y0[0])
    y0 = robot.state(None, {"crank": crank, "rod": rod}, assemble=True)
    q, v = end(robot.system, y0)
    for actual, expected in zip((q, v), problem.reference(0.3)):
        values = [actual.orientation[0], actual.position[2, 0], actual.orientation[1]]
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-11)


def test_heavy_top_is_that_of_the_gallery():
    problem = mj.problems.heavy_top()
    args = jax.tree.map(np.asarray, problem.args)
    c = args.center
    top = mb.Body("top", args.mass, args.inertia - args.mass * (c @ c - c * c))
    tip = mb.Spherical("top", mb.GROUND, points=(-c, np.zeros(3)))
    robot = mb.Assembly([top], [tip], gravity=(0.0, 0.0, -args.gravity))
    R = np.array([[1, 0, 0], [0, np.cos(0.6), -np.sin(0.6)], [0, np.sin(0.6), np.cos(0.6)]])
    spin = R @ np.array([0.0, 0.0, 12.0])
    moving = {"top": np.cross(spin, R @ c)}
    y0 = robot.state({"top": R @ c}, {"top": problem.y0[0]}, moving, {"top": spin})
    q, v = end(robot.system, y0)
    for actual, expected in zip((q, v), problem.reference(0.3)):
        np.testing.assert_allclose(actual.orientation[0], expected, rtol=0, atol=1e-11)


@eqx.filter_jit
def fallen(system, y0):
    """By small constant steps, of an error below 1e-12."""
    hook = mj.Projected(dfx.Tsit5(), system.constraint)
    sol = mj.diffeqsolve(system.terms, hook, 0.0, 0.05, 0.002, y0)
    return jax.tree.map(lambda leaf: leaf[-1], sol.ys)


@pytest.mark.slow
def test_bricard_is_that_in_natural_coordinates():
    """A closed loop in space that only moves as its equations depend on each other."""
    robot, (system, y0) = cases.bricard(), cases.bricard_in_natural_coordinates()
    q, _ = fallen(robot.system, robot.state())
    expected, _ = fallen(system, y0)
    assert np.abs(q.position - robot.state()[0].position).max() > 2e-3
    np.testing.assert_allclose(q.position, expected["x"], rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("across", [1e-2, 1e-3])
def test_thin_rods_in_natural_coordinates(across, monkeypatch):
    """Whose equations are of very different strengths, of which the weakest pass for dependent: right, or
    not a number."""
    monkeypatch.setattr(cases, "MOMENTS", np.array([across, 1 / 12, 1 / 12]))
    robot, (system, y0) = cases.bricard(), cases.bricard_in_natural_coordinates()
    expected = accelerations(robot.system, robot.state()).position
    found = accelerations(system, y0)["x"]
    if across < 5e-3:
        assert np.isnan(found).all()
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_loops_in_space_whose_equations_depend_on_each_other():
    """A planar linkage of hinges in space: dependent equations are found and named."""
    problem = mj.problems.four_bar()
    with pytest.raises(
        ValueError, match=r"3 of the 23 equations .* `Assembly\(..., redundant=True"
    ):
        cases.four_bar_in_space(problem.args, problem.y0).state()
    robot = cases.four_bar_in_space(problem.args, problem.y0, redundant=True)
    flat = cases.four_bar(problem.args)
    v = np.asarray(problem.y0[1]).reshape(3, 3)
    upright = lambda p: np.array([p[0], 0.0, p[1]])
    moving = {name: upright(v[i, :2]) for i, name in enumerate(cases.BARS)}
    spins = {name: np.array([0.0, -v[i, 2], 0.0]) for i, name in enumerate(cases.BARS)}
    a = accelerations(robot.system, robot.state(None, None, moving, spins))
    expected = accelerations(flat.system, cases.four_bar_state(flat, problem.y0))
    np.testing.assert_allclose(a.position[:, [0, 2]], expected.position, rtol=0, atol=1e-10)
    np.testing.assert_allclose(a.position[:, 1], 0, rtol=0, atol=1e-10)


# Laws


@functools.cache
def every_joint():
    """A chain with every kind of joint, and one of every force, in a pose without symmetry."""
    rng = np.random.default_rng(3)
    names = [f"body {i}" for i in range(7)]
    bodies = [
        mb.Body(
            name,
            rng.uniform(0.5, 2),
            rng.uniform(0.5, 0.9, 3),
            position=rng.normal(size=3),
            orientation=mb.quaternion(rng.normal(size=3), rng.uniform(0, 3)),
        )
        for name in names
    ]
    chain = [mb.GROUND, *names]
    pairs = list(itertools.pairwise(chain))
    at = rng.normal(size=(7, 3))
    first, second = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    axes = rng.normal(size=(3, 3))
    joints = [
        mb.Revolute(*pairs[0], at=at[0], axis=axes[0], name="hinge"),
        mb.Universal(*pairs[1], at=at[1], axis=(first, second)),
        mb.Prismatic(*pairs[2], at=at[2], axis=axes[1], name="slider"),
        mb.Fixed(*pairs[3]),
        mb.Cylindrical(*pairs[4], at=at[4], axis=axes[2]),
        mb.Spherical(*pairs[5], at=at[5]),
        mb.Distance(*pairs[6], between=(at[5], at[6]), name="rod"),
    ]
    forces = [
        mb.Spring(names[0], names[5], 3.0, 0.4, 0.2, between=(at[1], at[4])),
        mb.Damper(names[1], mb.GROUND, 0.3, between=(at[2], at[3])),
        mb.LinearActuator(names[2], names[6], lambda t, args: args, between=(at[0], at[6])),
        mb.JointSpring("hinge", 2.0, 0.3, 0.1),
        mb.Motor("slider", lambda t, args: 2 * args),
        mb.Force(names[3], (1.0, 2.0, 3.0), point=(0.1, 0.2, 0.3)),
        mb.Torque(names[4], (0.3, 0.2, -0.1)),
    ]
    robot = mb.Assembly(bodies, joints, forces, gravity=GRAVITY)
    q, v = robot.state()
    noise = mb.Pose(rng.normal(size=q.position.shape), rng.normal(size=q.orientation.shape))
    (q, v), _ = mj.project(robot.system.constraint, 0.0, (q, jax.tree.map(jnp.add, v, noise)))
    return robot, (q, v)


def test_joint_forces_obey_newton_and_euler():
    """Masses times accelerations, and rates of angular momentum, are the forces that joints are said to
    transmit, the weight, and the applied ones; those by the power they do."""
    robot, y = every_joint()
    q, v = y
    args = jnp.asarray(0.7)

    @eqx.filter_jit
    def motion(robot, y):
        system = robot.system
        a = system.accelerations(0.0, y, args)
        nothing = eqx.tree_at(lambda r: (r.loads, r.gravity), robot, ((), jnp.zeros(3)))
        applied = jax.tree.map(
            jnp.subtract, system.force(0.0, q, v, args), nothing.system.force(0.0, q, v, args)
        )
        states = {name: robot.motion(y, name) for name in robot.names}
        ahead = jax.tree.map(lambda leaf: leaf, (v, a))
        spins = lambda y: jnp.stack([robot.motion(y, n).angular_velocity for n in robot.names])
        _, turning = jax.jvp(spins, (y,), (ahead,))
        return a, applied, states, turning, robot.joint_forces(0.0, y, args)

    a, applied, states, turning, reactions = motion(robot, y)
    R = np.asarray(mb_rotation(q.orientation))
    G = np.asarray(mb_rates(q.orientation))
    force = np.array(applied.position)
    torque = np.einsum("nij,njk,nk->ni", R, G, np.asarray(applied.orientation)) / 2
    index = {name: i for i, name in enumerate(robot.names)}
    for group in robot.joints:
        for k, name in enumerate(group.attachment.names):
            for side, sign in ((0, -1), (1, 1)):
                i = group.attachment.bodies[side][k]
                if i == len(index):
                    continue
                # both act at the second point
                body = robot.names[group.attachment.bodies[1][k]]
                at, _ = robot.point(y, body, group.attachment.points[1][k])
                arm = np.asarray(at) - np.asarray(q.position[i])
                F, T = (sign * np.asarray(part) for part in reactions[name])
                force[i] += F
                torque[i] += T + np.cross(arm, F)
    mass = np.asarray(robot.bodies.mass)[:, None]
    np.testing.assert_allclose(mass * np.asarray(a.position), force, rtol=0, atol=1e-11)
    inertia = R @ np.asarray(robot.bodies.inertia) @ np.swapaxes(R, 1, 2)
    for i, name in enumerate(robot.names):
        w = np.asarray(states[name].angular_velocity)
        euler = inertia[i] @ np.asarray(turning[i]) + np.cross(w, inertia[i] @ w)
        np.testing.assert_allclose(euler, torque[i], rtol=0, atol=1e-11)
    assert all(np.abs(np.concatenate(force)).max() > 0.1 for force in reactions.values())


def mb_rotation(p):
    a, b, c, d = np.asarray(p).T
    vector = np.stack([b, c, d], axis=1)
    cross = np.cross(np.eye(3)[None], vector[:, None, :])
    return (
        (2 * a * a - 1)[:, None, None] * np.eye(3)
        + 2 * vector[:, :, None] * vector[:, None, :]
        + 2 * a[:, None, None] * cross
    )


def mb_rates(p):
    """`G(p)`, `omega = 2 G p'` in the frame of the body."""
    a, b, c, d = np.asarray(p).T
    rows = [[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def test_energy_of_weight_and_springs_is_kept():
    robot, y = every_joint()

    @eqx.filter_jit
    def rate(robot, y):
        args = jnp.zeros(())
        a = robot.system.accelerations(0.0, y, args)
        return jax.jvp(lambda y: robot.energy(y).total, (y,), ((y[1], a),))[1]

    # without dampers and constant forces nothing but weight and springs is left
    loads = tuple(
        eqx.tree_at(lambda load: load.laws.damping, load, jnp.zeros_like(load.laws.damping))
        for load in robot.loads
        if hasattr(load, "laws")
    )
    assert len(loads) == 3  # between points, in hinges, in sliders
    robot = eqx.tree_at(lambda r: r.loads, robot, loads)
    assert abs(rate(robot, y)) < 1e-10
    assert abs(robot.energy(y).potential) > 0.1


def test_points_and_coordinates_are_those_of_the_motion():
    robot, y = every_joint()
    v = y[1]
    (_, velocity), slope = jax.jit(
        lambda y: jax.jvp(
            lambda q: robot.point((q, v), "body 2", (0.1, -0.2, 0.3)), (y[0],), (y[1],)
        )
    )(y)
    np.testing.assert_allclose(slope[0], velocity, rtol=0, atol=1e-13)
    coordinates = robot.joint_coordinates(robot.state())
    assert set(coordinates) == {"hinge", "slider"}
    np.testing.assert_allclose(list(coordinates.values()), 0, atol=1e-14)
    several = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), y)
    np.testing.assert_array_equal(robot.energy(several).total, [robot.energy(y).total] * 2)
    assert robot.motion(several, "body 1").angular_velocity.shape == (2, 3)


def test_more_joints_are_no_more_operations():
    def operations(n):
        names = [f"body {i}" for i in range(n)]
        bodies = [
            mb.Body(name, 1.0, (0.1, 0.1, 0.1), position=(i, 0, 0)) for i, name in enumerate(names)
        ]
        pairs = zip([mb.GROUND, *names[:-1]], names)
        joints = [mb.Spherical(*p, at=(i - 0.5, 0, 0)) for i, p in enumerate(pairs)]
        robot = mb.Assembly(bodies, joints, gravity=GRAVITY)
        y = robot.state()
        field = lambda y: (
            robot.system.force(0.0, *y, None),
            robot.system.holonomic(0.0, y[0], None),
        )
        return len(jax.make_jaxpr(field)(y).eqns)

    assert operations(3) == operations(40)


# Transformations


def swing(values):
    """A rod on a hinge with a spring, from its mass, length and stiffness."""
    mass, length, stiffness = values
    zero = jnp.zeros_like(mass)
    rod = mb.Body("rod", mass, mass * length**2 / 12, position=jnp.stack([length / 2, zero]))
    hinge = mb.Revolute(mb.GROUND, "rod", at=(0.0, 0.0), name="hinge")
    spring = mb.JointSpring("hinge", stiffness)
    return mb.Assembly([rod], [hinge], [spring], gravity=(0.0, -9.81))


def swung(system, y0, args):
    """The angle after a while, by few constant steps."""
    hook = mj.Projected(dfx.Heun(), system.constraint)
    return mj.diffeqsolve(system.terms, hook, 0.0, 0.4, 0.05, y0, args).ys[0].orientation[-1, 0]


def test_gradients_and_batches():
    values = jnp.asarray([2.0, 0.5, 3.0])
    drawn = lambda values: swing(values).state()
    system = mb.parametrized(swing)
    value = lambda values: swung(system, drawn(values), values)
    closed_over = lambda values: swung(swing(values).system, drawn(values), None)
    run, slope = jax.jit(value), jax.jit(jax.grad(value))(values)
    h = 1e-5
    differences = [(run(values + h * e) - run(values - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(slope, differences, rtol=1e-6, atol=1e-8)
    other = jax.jit(jax.grad(closed_over))(values)
    np.testing.assert_allclose(other, slope, rtol=1e-9)
    batch = values[None] * jnp.asarray([[1.0], [1.3]])
    single = [run(row) for row in batch]
    np.testing.assert_allclose(jax.jit(jax.vmap(value))(batch), single, rtol=0, atol=1e-13)


def test_a_mechanism_is_built_once_in_a_solve():
    """Not in each of its stages and corrections."""
    built = []

    def build(values):
        built.append(values)
        return swing(values)

    values = jnp.asarray([2.0, 0.5, 3.0])
    y0, system = swing(values).state(), mb.parametrized(build)
    jax.make_jaxpr(lambda values: swung(system, y0, values))(values)
    assert len(built) == 1


@pytest.mark.slow
def test_lengths_and_masses_from_a_motion():
    """Of a four-bar linkage, from an independent solution with noise: within three standard errors."""
    problem = mj.problems.four_bar(t1=1.0)
    true = {"coupler": 2.5, "rocker": 2.0}  # a length and a mass

    def args_of(values):
        lengths = problem.args.lengths.at[1].set(values["coupler"])
        masses = problem.args.masses.at[2].set(values["rocker"])
        return problem.args._replace(lengths=lengths, masses=masses)

    def y0(values):
        parts = (part.reshape(3, 3) for part in problem.with_args(args_of(values)).y0)
        return tuple(mb.Pose(part[:, :2], part[:, 2]) for part in parts)

    ts, sigma = np.linspace(0.05, 1.0, 20), 1e-3
    exact = problem.reference(ts)[0][:, 3:5]  # the centre of the coupler
    data = exact + sigma * np.random.default_rng(0).normal(size=exact.shape)
    found = mj.fit(
        mb.parametrized(lambda values: cases.four_bar(args_of(values))),
        {"coupler": 2.4, "rocker": 1.7},
        ts,
        data,
        t0=0.0,
        y0=y0,
        observe=lambda t, y, values: y[0].position[1],
        sigma=sigma,
    )
    for name, value in true.items():
        error = found.standard_errors[name]
        assert error < 0.05 * value
        assert abs(found.parameters[name] - value) < 3 * error


# States


def test_assembling_keeps_what_is_given():
    problem = mj.problems.four_bar()
    robot = cases.four_bar(problem.args)
    y = robot.state(None, {"crank": 2.0}, None, {"crank": 1.5}, assemble=True)
    assert max(np.abs(gap).max() for gap in robot.gaps(y[0]).values()) < 1e-14
    assert robot.motion(y, "crank").orientation == 2.0
    assert robot.motion(y, "crank").angular_velocity == 1.5
    residual = robot.system.constraint(0.0, y)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(residual)) < 1e-14


def test_assembling_inside_of_jit():
    """Lengths and what is given may be traced: the state is the same, and its derivatives, in both modes and
    twice, are those of finite differences."""
    args = mj.problems.four_bar().args

    def state(s):
        longer = args.lengths * (1 + s * jnp.array([0.1, 0.2, 0.3, 0.1]))
        robot = cases.four_bar(args._replace(lengths=longer))
        given = {"crank": 0.9 + 0.3 * s}, None, {"crank": 6.0 + s}
        return robot.state(None, *given, assemble=True)

    eager, traced = state(0.0), jax.jit(state)(0.0)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), eager, traced)
    assert traced[0].orientation[0] == 0.9  # what is given stays what it is
    assert traced[1].orientation[0] == 6.0
    total = lambda s: sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(state(s)))
    reverse = jax.jit(jax.value_and_grad(total))
    values, slopes = zip(*(reverse(s) for s in (-2e-4, -1e-4, 0.0, 1e-4, 2e-4)))
    slope = (8 * (values[3] - values[1]) - (values[4] - values[0])) / 12e-4
    for derivative in (slopes[2], jax.jit(jax.jacfwd(total))(0.0)):
        np.testing.assert_allclose(derivative, slope, rtol=1e-9)
    bend = (8 * (slopes[3] - slopes[1]) - (slopes[4] - slopes[0])) / 12e-4
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.grad(total)))(0.0), bend, rtol=1e-8)


def test_states_that_are_refused():
    problem = mj.problems.four_bar()
    robot = cases.four_bar(problem.args)
    with pytest.raises(
        ValueError, match=r"does not satisfy the joints: .*pivot \(gap .*\), in m or"
    ):
        robot.state()
    too_far = problem.args._replace(lengths=jnp.asarray([1.0, 1.0, 1.0, 10.0]))
    with pytest.raises(ValueError, match=r"cannot be closed: check lengths"):
        cases.four_bar(too_far).state(assemble=True)
    y = robot.state(None, {"crank": 2.0}, assemble=True)
    known = dict(zip(cases.BARS, y[0].position)), dict(zip(cases.BARS, y[0].orientation))
    with pytest.raises(ValueError, match=r"velocities do not agree .* crank-ground \(gap"):
        robot.state(*known, None, {"crank": 1.0})
    with pytest.raises(ValueError, match="names the body 'crnak'"):
        robot.state({"crnak": (0, 0)})
    with pytest.raises(ValueError, match="ground does not move"):
        robot.state({"ground": (0, 0)})
    with pytest.raises(ValueError, match=r"`positions` of 'crank' must be of shape \(2,\)"):
        robot.state({"crank": (0, 0, 0)})
    too_far = jax.jit(
        lambda x: cases.four_bar(problem.args._replace(lengths=x)).state(assemble=True)
    )
    with pytest.raises(Exception, match="joints cannot be closed, .* least of all"):
        too_far(jnp.asarray([1.0, 1.0, 1.0, 10.0]))


def test_a_fixed_pose_is_not_moved():
    body = mb.Body("a", 1.0, 1.0, position=(1.0, 2.0), orientation=0.3)
    robot = mb.Assembly([body], [mb.Fixed("a", mb.GROUND)], gravity=(0.0, -9.81))
    y = robot.state()
    a = accelerations(robot.system, y)
    np.testing.assert_allclose(a.position, 0, atol=1e-13)
    force, torque = robot.joint_forces(0.0, y)["Fixed a-ground"]
    np.testing.assert_allclose(force, (0.0, -9.81), atol=1e-13)  # on the ground
    np.testing.assert_allclose(torque, 0, atol=1e-13)


def test_a_body_without_joints():
    robot = mb.Assembly([A], gravity=GRAVITY)
    a = accelerations(robot.system, robot.state())
    np.testing.assert_allclose(a.position, [GRAVITY], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("spring", "expected"),
    [
        (mb.Spring("a", "b", 3.0, 0.0, 0.5, between=((0, 0, 0),) * 2), (0.5, -1.0, 0.0)),
        (mb.Damper("a", "b", 0.5, between=((0, 0, 0),) * 2), (0.5, -1.0, 0.0)),
        (mb.Spring("a", "b", 3.0, 1.0, between=((0, 0, 0),) * 2), np.full(3, np.nan)),
        (mb.LinearActuator("a", "b", 1.0, between=((0, 0, 0),) * 2), np.full(3, np.nan)),
    ],
)
def test_points_of_springs_that_coincide(spring, expected):
    """What has a limit is that, with its derivatives; what has none is not a number."""
    robot = mb.Assembly([A, B], [], [spring])
    q, v = robot.state(None, None, {"a": (1.0, -2.0, 0.0)})
    on_b = lambda q: robot.system.force(0.0, q, v, None).position[1]
    value, slope = jax.jit(lambda q: (on_b(q), jax.jacfwd(on_b)(q)))(q)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-15)
    if np.isfinite(expected).all():
        stiffness = robot.loads[0].laws.stiffness[0]
        np.testing.assert_allclose(slope.position[:, 1], -stiffness * np.eye(3), atol=1e-15)
        slope = jax.jit(jax.grad(lambda q: robot.energy((q, v)).potential))(q)
        np.testing.assert_array_equal(slope.coordinates, 0)


def test_a_rotational_damper_is_the_damping_of_a_hinge():
    hinge = mb.Revolute("b", "a", at=(0, 0, 0), axis=(1.0, 2.0, 0.5), name="hinge")
    damped = mb.RotationalDamper("b", "a", 0.7), mb.JointSpring("hinge", damping=0.7)
    robots = [mb.Assembly([A, B], [hinge], [damper]) for damper in damped]
    y = robots[0].state(None, None, None, {"a": (2.0, 4.0, 1.0)}, assemble=True)
    found, expected = (accelerations(robot.system, y).coordinates for robot in robots)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    assert (
        np.abs(found - accelerations(mb.Assembly([A, B], [hinge]).system, y).coordinates).max()
        > 0.1
    )


def test_states_of_single_precision():
    """Large mechanisms are closed to rounding."""
    with jax.enable_x64(False):
        args = mj.problems.four_bar().args
        robot = cases.four_bar(args._replace(lengths=100 * args.lengths))
        y = robot.state(None, {"crank": 2.0}, assemble=True)
    assert y[0].coordinates.dtype == jnp.float32


# What is refused


def spatial(name="a", **changes):
    return mb.Body(**(dict(name=name, mass=1.0, inertia=(1.0, 1.0, 1.0)) | changes))


A, B = spatial("a"), spatial("b")


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: spatial(inertia=(1.0, 1.0)), r"Body 'a': `inertia` must be a number or of shape \(3,\) .*got shape \(2,\)"),
        (lambda: spatial(inertia=(1.0, 1.0, -1.0)), "must be positive definite"),
        (lambda: spatial(inertia=np.ones((3, 3))), "must be positive definite"),
        (lambda: spatial(inertia=(1.0, 1.0, 3.0)), "the largest exceeds"),
        (lambda: spatial(inertia=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]), "not symmetric"),
        (lambda: spatial(mass=0.0), "`mass` must be positive"),
        (lambda: spatial("ground"), "is what does not move"),
        (lambda: spatial(orientation=(1, 1, 0, 0)), "norm 1"),
        (lambda: spatial(position=(0, 0)), r"`position` must be of shape \(3,\)"),
        (lambda: mb.Assembly([A, A]), r"several called \['a'\]"),
        (lambda: mb.Assembly([A, mb.Body("p", 1.0, 1.0)]), "either in the plane or in space"),
        (lambda: mb.Assembly([]), "at least one"),
        (lambda: mb.Assembly([mb.Body("p", 1.0, 1.0)]), "without any joint"),
        (lambda: mb.Assembly([A], gravity=(0, 1)), r"`gravity` must be of shape \(3,\)"),
        (lambda: joint(mb.Revolute("a", "c", at=(0, 0, 0), axis=(1, 0, 0))), "names the body 'c'"),
        (lambda: joint(mb.Revolute("a", "a", at=(0, 0, 0), axis=(1, 0, 0))), "'a' with itself"),
        (lambda: joint(mb.Revolute("a", "b", at=(0, 0, 0), axis=(0, 0, 0))), "is zero"),
        (lambda: joint(mb.Revolute("a", "b", at=(0, 0, 0))), "needs an `axis`"),
        (lambda: joint(mb.Revolute("a", "b", axis=(1, 0, 0))), "either `at`"),
        (lambda: joint(mb.Spherical("a", "b", at=(0, 0))), r"`at` must be of shape \(3,\)"),
        (lambda: joint(mb.Spherical("a", "b", points=(0, 0, 0))), "must be a pair"),
        (lambda: joint(mb.Distance("a", "b")), "either `between`"),
        (lambda: joint(mb.Distance("a", "b", ((0, 0, 0), (0, 0, 0)))), "positive number"),
        (lambda: joint(mb.Universal("a", "b", at=(0, 0, 0), axis=(1, 0, 0))), "pair of axes"),
        (lambda: joint(mb.Universal("a", "b", at=(0, 0, 0), axis=((1, 0, 0), (1, 1, 0)))), "45 degrees"),
        (lambda: joint(*[mb.Spherical("a", "b", at=(0, 0, 0), name="j")] * 2), "several called"),
        (lambda: joint("hinge"), "sequence of joints"),
        (lambda: mb.Assembly([mb.Body("p", 1.0, 1.0)], [mb.Spherical("p", "ground", at=(0, 0))]), "joints in the plane are"),
        (lambda: mb.Assembly([A], [], [mb.Motor("hinge", 1.0)]), "names the joint 'hinge'"),
        (lambda: force(mb.Motor("ball", 1.0)), "has no single coordinate"),
        (lambda: force(mb.Force("a", lambda t: t)), "must be a callable"),
        (lambda: force(mb.Spring("a", "b", (1.0, 2.0), between=((0, 0, 0), (1, 0, 0)))), "must be a number"),
        (lambda: mb.parametrized(3.0), "must be a callable"),
        (lambda: spatial(mass=None), "`mass` must be a number, got None"),
        (lambda: spatial(mass=np.inf), "`mass` must be finite"),
        (lambda: spatial(inertia=(1.0, 1.0, np.nan)), "`inertia` must be finite"),
        (lambda: mb.Body("p", 1.0, 1.0, orientation=np.nan), "`orientation` must be finite"),
        (lambda: spatial(orientation=0.3), r"of shape \(4,\), a unit quaternion, got shape"),
        (lambda: mb.quaternion((0, 0, 0), 1.0), "`axis` is zero"),
        (lambda: mb.quaternion((0, 1), 1.0), r"`axis` must be of shape \(3,\)"),
        (lambda: mb.Assembly(A), "`bodies` must be a sequence"),
        (lambda: mb.Assembly([A], mb.Spherical("a", "b", at=(0, 0, 0))), "`joints` must be a sequence"),
        (lambda: mb.Assembly([A], [], None), "`forces` must be a sequence"),
        (lambda: joint(mb.Spherical("a", "b", at=(0, 0, 0), name=3)), "`name` of a joint must be a string"),
        (
            lambda: mb.Assembly([mb.Body("p", 1.0, 1.0)], [mb.Revolute("p", "ground", at=(0, 0), axis=(0, 0, 1))]),
            "a Revolute in the plane has no `axis`",
        ),
        (lambda: joint(mb.Distance("a", "b", ((0, 0, 0), (1, 0, 0)), "long")), "`length` must be a number"),
        (lambda: joint(mb.Distance("a", "b", ((0, 0, 0), (1, 0, 0)), np.inf)), "`length` must be finite"),
        (lambda: force(mb.Spring("a", "b", np.nan, between=((0, 0, 0), (1, 0, 0)))), "`stiffness` must be finite"),
        (lambda: force(mb.LinearActuator("a", "b", None, ((0, 0, 0), (1, 0, 0)))), "`value` must be a number, got None"),
        (lambda: force(mb.Force("a", (1.0, 2.0))), r"`value` must be of shape \(3,\), got shape \(2,\)"),
        (lambda: force(mb.RotationalDamper("a", "a", 1.0)), "connects 'a' with itself"),
        (lambda: force(mb.Torque(mb.GROUND, (0, 0, 1))), "the ground does not move"),
        (lambda: joint(mb.Spherical("a", "b", at=(0, 0, 0))).state(None, {"a": (2, 0, 0, 0)}), "`orientations` of 'a' must be a quaternion of norm 1"),
        (lambda: mb.Assembly([mb.Body("p", 1.0, 1.0)], [mb.Revolute("p", "ground", at=(0, 0))]).state(None, None, None, {"p": (0, 0, 1)}), "`angular_velocities` of 'p' must be a number"),
    ],
)  # fmt: skip
def test_what_is_refused(as_a_user_meets_it, build, message):
    with pytest.raises((ValueError, TypeError), match=message):
        build()


def joint(*joints):
    return mb.Assembly([A, B], joints)


def force(*forces):
    return mb.Assembly([A, B], [mb.Spherical("a", "b", at=(0, 0, 0), name="ball")], forces)


def test_values_of_the_wrong_shape_are_refused():
    robot = force(mb.Force("a", lambda t, args: (1.0, 2.0)))
    with pytest.raises(ValueError, match=r"`value` must be of shape \(3,\), got shape \(2,\)"):
        accelerations(robot.system, robot.state())
    twice = lambda args: mb.Assembly([A], [], redundant=True)
    with pytest.raises(ValueError, match=r"write `parametrized\(build, redundant=True\)`"):
        accelerations(mb.parametrized(twice), robot.state())
    with pytest.raises(TypeError, match="must return an `mj.multibody.Assembly`"):
        accelerations(mb.parametrized(lambda args: 3.0), robot.state())
