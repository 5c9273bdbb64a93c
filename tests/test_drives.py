"""Hinges and sliders that move as prescribed: against formulas and SciPy, in the plane and in space."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import manifold_jax as mj


mb = mj.multibody
TS = np.linspace(0.0, 3.0, 16)


def solve(system, y0, args=None, tolerance=1e-11):
    return mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Dopri8(), system.constraint),
        TS[0],
        TS[-1],
        None,
        y0,
        args,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        saveat=dfx.SaveAt(ts=jnp.asarray(TS)),
    )


def crank_angle(t, args=None):
    return 3.0 * t + 0.5 * jnp.sin(2.0 * t)


CRANK = [
    mb.Body("crank", mass=1.0, inertia=0.1, position=(0.5, 0.0)),
    mb.Body("rod", mass=2.0, inertia=0.7, position=(2.0, 0.0)),
    mb.Body("slider", mass=0.5, inertia=0.01, position=(3.0, 0.0)),
]
JOINTS = [
    mb.Revolute(mb.GROUND, "crank", at=(0.0, 0.0), name="pivot"),
    mb.Revolute("crank", "rod", at=(1.0, 0.0)),
    mb.Revolute("rod", "slider", at=(3.0, 0.0)),
    mb.Prismatic(mb.GROUND, "slider", at=(3.0, 0.0), axis=(1.0, 0.0), name="guide"),
]


def crank_energy(t):
    """Of the slider-crank, from its angle alone."""

    def places(t):
        a = crank_angle(t)
        b = -jnp.arcsin(jnp.sin(a) / 2)
        x, y = jnp.cos(a), jnp.sin(a)
        return jnp.stack([x / 2, y / 2, a, x + jnp.cos(b), y / 2, b, x + 2 * jnp.cos(b)])

    p, v = jax.jvp(places, (t,), (1.0,))
    inertia = jnp.array([1.0, 1.0, 0.1, 2.0, 2.0, 0.7, 0.5])
    return inertia @ v**2 / 2 + 9.81 * (1.0 * p[1] + 2.0 * p[4])


@pytest.mark.slow
def test_a_machine_without_freedom():
    """More than one turn; the torque of the drive is its power over the speed."""
    drive = mb.Drive("pivot", crank_angle)
    machine = mb.Assembly(CRANK, [*JOINTS, drive], gravity=(0.0, -9.81))
    y0 = machine.state(assemble=True)
    assert y0[1].orientation[0] == pytest.approx(4.0)  # what the drive begins with
    sol = solve(machine.system, y0)
    a = crank_angle(TS)
    slider = jnp.cos(a) + jnp.sqrt(4 - jnp.sin(a) ** 2) - 3
    found = machine.joint_coordinates(sol.ys)
    assert found.keys() == {
        joint.name or f"Revolute {joint.first}-{joint.second}" for joint in JOINTS
    }
    np.testing.assert_allclose(found["guide"], slider, rtol=0, atol=1e-13)
    np.testing.assert_allclose(sol.ys[0].orientation[:, 0], a, rtol=0, atol=1e-13)
    last = jax.tree.map(lambda leaf: leaf[-1], sol.ys[0])
    gaps = machine.gaps(last, TS[-1])
    assert max(np.abs(gap).max() for gap in gaps.values()) < 1e-15
    power = jax.vmap(jax.grad(crank_energy))(TS)
    torque = machine.joint_forces(TS, sol.ys)["Drive pivot"].torque
    speed = jax.vmap(jax.grad(crank_angle))(TS)
    np.testing.assert_allclose(torque, power / speed, rtol=0, atol=1e-10)


def reference(acceleration, y0, *args):
    """Of one coordinate, by SciPy."""
    f = jax.jit(acceleration)
    found = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], f(t, *y, *args)],
        (TS[0], TS[-1]),
        y0,
        "DOP853",
        TS,
        rtol=1e-12,
        atol=1e-12,
    )
    return found.y[0]


def test_a_driven_slider():
    """A crane: its trolley moves by `x(t)`, the load swings."""
    bodies = [
        mb.Body("trolley", mass=3.0, inertia=1.0, position=(0.0, 0.0)),
        mb.Body("load", mass=2.0, inertia=0.3, position=(0.0, -1.5)),
    ]
    joints = [
        mb.Prismatic(mb.GROUND, "trolley", at=(0.0, 0.0), axis=(1.0, 0.0), name="rail"),
        mb.Revolute("trolley", "load", at=(0.0, 0.0), name="rope"),
        mb.Drive("rail", lambda t, rate: rate * t**2, name="motor"),
    ]
    crane = mb.Assembly(bodies, joints, gravity=(0.0, -9.81))
    y0 = crane.state(angular_velocities={"load": 0.4}, assemble=True, args=0.8)

    def swung(rate):
        ys = solve(crane.system, y0, rate).ys
        angles = crane.joint_coordinates(ys)["rope"]
        return angles[-1], angles

    # One program for the solution and its gradient.
    (_, angles), slope = jax.jit(jax.value_and_grad(swung, has_aux=True))(0.8)
    inertia, ml = 0.3 + 2.0 * 1.5**2, 2.0 * 1.5
    swing = lambda t, a, rate, drive: -ml * (9.81 * jnp.sin(a) + 2 * drive * jnp.cos(a)) / inertia
    expected = lambda drive: reference(swing, [0.0, 0.4], drive)
    np.testing.assert_allclose(angles, expected(0.8), rtol=0, atol=1e-9)
    difference = (expected(0.8 + 1e-4)[-1] - expected(0.8 - 1e-4)[-1]) / 2e-4
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    force = crane.joint_forces(0.0, y0, 0.8)["motor"].force
    a2 = swing(0.0, 0.0, 0.4, 0.8)  # hangs straight down at the start
    np.testing.assert_allclose(force, [(3.0 + 2.0) * 1.6 + ml * a2, 0.0], rtol=0, atol=1e-12)


def furuta(args):
    """A pendulum on an arm that is turned about the vertical."""
    bodies = [
        mb.Body("arm", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0)),
        mb.Body("pendulum", mass=0.7, inertia=(0.05, 0.04, 0.03), position=(1.0, 0.0, -0.4)),
    ]
    joints = [
        mb.Revolute(mb.GROUND, "arm", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="base"),
        mb.Revolute("arm", "pendulum", at=(1.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), name="hinge"),
        mb.Drive("base", lambda t, args: args * t**2),
    ]
    return mb.Assembly(bodies, joints, gravity=(0.0, 0.0, -9.81))


def furuta_acceleration(t, b, rate, drive):
    def lagrangian(t, b, rate):
        speed, y, y_rate = 2 * drive * t, 0.4 * jnp.sin(b), 0.4 * jnp.cos(b) * rate
        z, z_rate = -0.4 * jnp.cos(b), y * rate
        velocity = jnp.stack([-speed * y, speed + y_rate, z_rate])
        spin = jnp.stack([rate, speed * jnp.sin(b), speed * jnp.cos(b)])
        inertia = jnp.array([0.05, 0.04, 0.03])
        return 0.7 * velocity @ velocity / 2 + inertia @ spin**2 / 2 - 0.7 * 9.81 * z

    momentum = jax.grad(lagrangian, 2)
    force = jax.grad(lagrangian, 1)(t, b, rate)
    drift = jax.grad(momentum, 0)(t, b, rate) + jax.grad(momentum, 1)(t, b, rate) * rate
    return (force - drift) / jax.grad(momentum, 2)(t, b, rate)


def test_a_driven_hinge_in_space():
    robot, system = furuta(1.5), mb.parametrized(furuta)
    y0 = robot.state(angular_velocities={"pendulum": (1.0, 0.0, 0.0)}, assemble=True, args=1.5)

    expected = reference(furuta_acceleration, [0.0, 1.0], 1.5)
    sol = solve(system, y0, 1.5)
    found = robot.joint_coordinates(sol.ys)["hinge"]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-9)
    end = jax.tree.map(lambda leaf: leaf[-1], sol.ys)
    assert mj.constraint_violation(system.constraint, TS[-1], end, 1.5) < 1e-15

    def hinge_speed(q, v):
        angle = lambda q: robot.joint_coordinates((q, v))["hinge"]
        return jax.jvp(angle, (q,), (v,))[1]

    def hinge_acceleration(rate):
        """At the start, whose angles and speeds are the same for all rates."""
        q, v = jax.tree.map(jnp.asarray, y0)
        return jax.jvp(hinge_speed, (q, v), (v, system.accelerations(0.0, y0, rate)))[1]

    derivatives = lambda f: (jax.grad(f), jax.jacfwd(f))
    found = jax.jit(lambda rate: [slope(rate) for slope in derivatives(hinge_acceleration)])(1.5)
    exact = jax.grad(furuta_acceleration, 3)(0.0, 0.0, 1.0, 1.5)
    assert abs(exact) > 0.1
    np.testing.assert_allclose(found, [exact] * 2, rtol=1e-12)


def test_a_start_that_the_drive_does_not_allow():
    machine = mb.Assembly(CRANK, [*JOINTS, mb.Drive("pivot", crank_angle)])
    with pytest.raises(ValueError, match="velocities do not agree.*Drive pivot"):
        machine.state()
    gap = r"does not satisfy the joints: Drive pivot \(gap 1\.92 rad\)\. Give"
    with pytest.raises(ValueError, match=gap):
        machine.state(t=0.5)
    guided = mb.Assembly(CRANK, [*JOINTS, mb.Drive("guide", 0.5)])
    with pytest.raises(ValueError, match=r"the joints: Drive guide \(gap 0\.5 m\)\. Give"):
        guided.state()
    moved = {"crank": (0.5, 0.1)}
    with pytest.raises(ValueError, match=r"\(gap 0\.5 m\), .* \(gap 0\.1\), in m or the sine"):
        guided.state(positions=moved)
    later = machine.state(assemble=True, t=0.5)
    assert later[0].orientation[0] == pytest.approx(float(crank_angle(0.5)), abs=1e-14)


@pytest.mark.parametrize(
    ("drives", "error", "message"),
    [
        ([mb.Drive("crane", 0.0)], ValueError, "Drive crane names the joint 'crane', which is not"),
        ([mb.Drive("pivot", lambda t: t)], TypeError, r"`motion` of `Drive pivot`.*f\(t, args\)"),
        ([mb.Drive("pivot", (1.0, 2.0))], ValueError, "Drive pivot: `motion` must be a number"),
        ([mb.Drive("pivot", 0.0)] * 2, ValueError, "A joint has one drive.*'pivot'"),
        ([mb.Drive("weld", 0.0)], ValueError, "'weld' is a Fixed, which has no single coordinate"),
    ],
)
def test_what_is_refused(drives, error, message):
    with pytest.raises(error, match=message):
        mb.Assembly(CRANK, [*JOINTS, mb.Fixed("rod", "slider", name="weld"), *drives])
