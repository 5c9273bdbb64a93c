"""Contacts that yield, and friction: closed forms, and formulas written again with NumPy."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import manifold_jax as mj


mb = mj.multibody


def wheel(forces):
    body = mb.Body("wheel", 2.0, 0.4, position=(1.0, 0.0))
    hinge = mb.Revolute(mb.GROUND, "wheel", at=(1.0, 0.0), name="shaft")
    return mb.JointCoordinates(mb.Assembly([body], [hinge], forces))


def ends(joints, rate, times):
    start = jnp.zeros(1), jnp.full(1, rate)
    controller = dfx.PIDController(rtol=1e-11, atol=1e-11)
    sol = dfx.diffeqsolve(
        joints.terms,
        dfx.Dopri8(),
        0.0,
        times[-1],
        0.01,
        start,
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=controller,
    )
    return tuple(np.asarray(part)[:, 0] for part in sol.ys)


def restitution(c, speed):
    """Of Hunt & Crossley's law: `c v (1 + e) = log((1 + c v) / (1 - c v e))`."""
    gap = lambda e: c * speed * (1 + e) - np.log((1 + c * speed) / (1 - c * speed * e))
    return brentq(gap, 1e-3, min(1, (1 - 1e-12) / (c * speed)), xtol=1e-14)


def test_stops():
    """A wheel between two stops: half an oscillation at one that only yields, and the restitution of one that
    dissipates, whichever it is."""
    elastic = wheel([mb.JointStop("shaft", -jnp.inf, 0.5, stiffness=40.0)])
    half = np.pi * np.sqrt(0.4 / 40.0)
    x, v = ends(elastic, 2.0, np.array([0.25, 0.25 + half / 2, 0.25 + half, 1.0]))
    deepest = 0.5 + 2.0 * np.sqrt(0.4 / 40.0)
    np.testing.assert_allclose(x[:3], [0.5, deepest, 0.5], rtol=1e-9)
    np.testing.assert_allclose(v[[0, 2, 3]], [2, -2, -2], rtol=1e-8)
    stored = elastic.assembly.energy(elastic.poses((jnp.array([0.7]), jnp.zeros(1)))).potential
    np.testing.assert_allclose(stored, 40 * 0.2**2 / 2, rtol=1e-12)
    both = wheel([mb.JointStop("shaft", -0.3, 0.5, stiffness=400.0, dissipation=0.4)])
    _, v = ends(both, 2.0, np.array([0.2, 0.7, 1.7]))
    first = 2 * restitution(0.4, 2.0)
    second = first * restitution(0.4, first)
    np.testing.assert_allclose(v, [2, -first, second], rtol=1e-8)


def test_stops_beyond_half_a_turn():
    """Angles of joints continue beyond a turn; those that poses do not tell from others are nearest to the middle."""
    y = lambda x: (jnp.array([x]), jnp.zeros(1))
    made = lambda lower, upper: wheel([mb.JointStop("shaft", lower, upper, 4.0)])
    inf, turn = jnp.inf, 2 * np.pi
    for lower, upper, x, expected in (
        (-turn, turn, 4.0, 0.0),
        (-turn, turn, 7.0, -10 * (7 - turn)),
        (-inf, 1.0, -4.0, 0.0),
        (-1.0, 3.5, 3.6, -1.0),
    ):
        found = made(lower, upper).terms.vf(0.0, y(x), None)[1]
        np.testing.assert_allclose(found, [expected], atol=1e-12)
    joints = made(-1.0, 3.5)
    for x, nearest, torque in (
        (3.3, 3.3, 0),
        (3.6, 3.6, -0.4),
        (-1.2, -1.2, 0.8),
        (5.9, 5.9 - turn, 0),
    ):
        poses = joints.poses(y(x - turn))
        np.testing.assert_allclose(joints.state(poses)[0], [nearest], rtol=1e-12)
        found = joints.assembly.system.force(0.0, *poses, None).orientation
        np.testing.assert_allclose(found, [torque], atol=1e-12)


def test_friction_of_a_joint():
    """A wheel slows down: its speed above `slip` decreases evenly, and it creeps to rest."""
    joints = wheel([mb.JointFriction("shaft", 0.8, slip=0.03)])
    _, v = ends(joints, 3.0, np.array([0.5, 1.0, 4.0]))
    # of v' = -2 v / sqrt(v^2 + s^2): sqrt(v^2 + s^2) - s artanh(s / sqrt(v^2 + s^2)) decreases evenly
    size = np.sqrt(np.array([3.0, *v[:2]]) ** 2 + 0.03**2)
    evenly = size - 0.03 * np.arctanh(0.03 / size)
    np.testing.assert_allclose(np.diff(evenly), [-1.0, -1.0], rtol=1e-8)
    assert abs(v[2]) < 1e-9


CONTACT = dict(stiffness=900.0, dissipation=0.7, friction=0.6, slip=0.05)
AT, NORMAL, POINT = (
    np.array([0.1, -0.2, 0.3]),
    np.array([1.0, 2.0, 5.0]),
    np.array([0.2, 0.1, -0.4]),
)


def contact(values, **options):
    given = CONTACT | dict(zip(CONTACT, values)) | dict(at=AT, normal=NORMAL) | options
    foot = mb.Body("foot", 1.5, (0.2, 0.3, 0.4))
    forces = [mb.GroundContact("foot", POINT, **given)]
    return mb.JointCoordinates(mb.Assembly([foot], [], forces))


def accelerations(values, y, **options):
    return contact(values, **options).system.accelerations(0.0, y)


def test_contact_with_the_ground():
    """The wrench on a body in a slanted plane, in four states: deep and fast, out again so fast that it would stick,
    above the plane, and resting. Gradients by all its numbers: forward = reverse = differences."""
    rng = np.random.default_rng(3)
    n, values = NORMAL / np.linalg.norm(NORMAL), np.array(list(CONTACT.values()))
    mass, inertia = 1.5, np.diag([0.2, 0.3, 0.4])
    solve = jax.jit(accelerations)
    joints = contact(values)
    pressed = []
    for depth, speed in ((0.03, -0.5), (0.02, 3.0), (-0.1, -1.0), (0.01, 0.0)):
        turn, spin = Rotation.random(random_state=rng), rng.normal(size=3)
        arm = turn.apply(POINT)
        slide = 0.0 if speed == 0 else 1.0
        moving = slide * np.cross(n, [0.3, -0.1, 0.9]) + speed * n
        place, velocity = AT - depth * n - arm, moving - np.cross(spin, arm)
        p = turn.as_quat(scalar_first=True)
        w, (x, y, z) = p[0], p[1:]
        rate = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]]) @ spin
        state = mb.Pose(place[None], p[None]), mb.Pose(velocity[None], rate[None])
        q, v = joints.state(jax.tree.map(jnp.asarray, state))
        a = solve(jnp.asarray(values), (q, v))
        k, c, mu, slip = values
        N = k * max(depth, 0) * max(0, 1 - c * speed)
        pressed.append(N > 0)
        u = moving - (moving @ n) * n
        force = N * n - mu * N * u / np.sqrt(u @ u + slip**2)
        np.testing.assert_allclose(a[:3], force / mass, atol=1e-10)
        R = turn.as_matrix()
        torque = R.T @ (np.cross(arm, force)) - np.cross(R.T @ spin, inertia @ R.T @ spin)
        local = np.linalg.solve(inertia, torque)
        ahead = jax.jvp(lambda y: spin_of(joints, y), ((q, v),), ((v, a),))[1]
        np.testing.assert_allclose(ahead, R @ local, atol=1e-9)
        if depth == 0.03:
            deep = (q, v)
    assert pressed == [True, False, False, True]
    size = lambda values: jnp.sum(accelerations(values, deep) ** 2)
    at = jnp.asarray(values)
    reverse, forward = jax.jit(lambda at: (jax.grad(size)(at), jax.jacfwd(size)(at)))(at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    steps = 1e-4 * np.abs(values)
    moved = at[None] + jnp.asarray(np.concatenate([np.diag(steps), -np.diag(steps)]))
    sizes = jax.jit(jax.vmap(size))(moved)
    np.testing.assert_allclose(reverse, (sizes[:4] - sizes[4:]) / (2 * steps), rtol=1e-6)


def spin_of(joints, y):
    return joints.assembly.motion(joints.poses(y), "foot").angular_velocity


def test_a_ball_rests_on_the_ground():
    """In the plane: it comes to rest where its weight is borne, and energy only decreases."""
    ball = mb.Body("ball", 2.0, 0.1, position=(0.0, 0.2))
    guide = mb.Prismatic(mb.GROUND, "ball", at=(0.0, 0.0), axis=(0.0, 1.0), name="height")
    contact = mb.GroundContact("ball", (0.0, 0.0), stiffness=500.0, dissipation=2.0)
    joints = mb.JointCoordinates(mb.Assembly([ball], [guide], [contact], gravity=(0.0, -10.0)))
    controller = dfx.PIDController(rtol=1e-9, atol=1e-9)
    given = joints.terms, dfx.Tsit5(), 0.0, 12.0, 0.01, joints.state()
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 12.0, 61))
    sol = dfx.diffeqsolve(*given, saveat=saveat, stepsize_controller=controller)
    np.testing.assert_allclose(sol.ys[0][-1, 0], -0.2 - 2.0 * 10 / 500, atol=1e-3)
    energy = joints.assembly.energy(joints.poses(sol.ys)).total
    assert jnp.max(jnp.diff(energy)) < 1e-8
    assert energy[0] - energy[-1] > 3


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (mb.JointStop("shaft", 1.0, 0.5, 1.0), "`lower` must be less than `upper`, got 1 and 0.5"),
        (mb.JointStop("shaft", -1.0, 0.5, 0.0), "`stiffness` must be positive, got 0.0"),
        (mb.JointStop("shaft", -1.0, jnp.nan, 1.0), "`upper` must be finite"),
        (mb.JointStop("shaft", None, 1.0, 1.0), "`lower` must be a number, got None"),
        (mb.JointFriction("shaft", -1.0), "`torque` must be not negative, got -1.0"),
        (mb.JointFriction("shaft", 1.0, slip=0.0), "`slip` must be positive, got 0.0"),
        (mb.JointFriction("axle", 1.0), "names the joint 'axle', which is not there"),
        (mb.GroundContact("wheel", (0.0, 0.0, 0.0), 1.0), r"`point` must be of shape \(2,\)"),
        (mb.GroundContact("tire", (0.0, 0.0), 1.0), "names the body 'tire', which is not there"),
        (mb.GroundContact("wheel", (0.0, 0.0), 1.0, normal=(0.0, 0.0)), "`normal` is zero"),
        (mb.GroundContact("wheel", (0.0, 0.0), 1.0, friction=-0.1), "`friction` must be not negative"),
    ],
)  # fmt: skip
def test_messages(force, message):
    with pytest.raises(ValueError, match=message):
        wheel([force])


def test_single_precision_stays_single():
    joints = contact(np.array(list(CONTACT.values())))
    single = lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf
    joints, y = jax.tree.map(single, (joints, joints.state()))
    found = eqx.filter_eval_shape(lambda joints, y: joints.system.accelerations(0.0, y), joints, y)
    assert found.dtype == jnp.float32
