"""Mechanical systems with auxiliary states: actuators, controllers, quadratures."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from variants import variants

import manifold_jax as mj


GAINS = (9.0, 4.0, 0.2)  # proportional, derivative, and how slowly the motor follows


def rod(t, q, args):
    return q @ q - 1.0


def torque_and_weight(t, q, v, z, args):
    """The torque of the motor turns the rod; weight pulls."""
    return jnp.stack([-q[1], q[0]]) * z["motor"] + jnp.array([0.0, -9.81])


def controller(t, q, v, z, args):
    """The motor follows the command of a controller; its work and the time are summed up."""
    stiffness, damping, lag = args
    angle = jnp.arctan2(q[1], q[0])
    rate = q[0] * v[1] - q[1] * v[0]
    command = -stiffness * angle - damping * rate
    compass = 3.0 * jnp.stack([-z["compass"][1], z["compass"][0]])
    return {
        "motor": (command - z["motor"]) / lag,
        "work": z["motor"] * rate,
        "compass": compass,
    }


START = (
    jnp.array([0.8, 0.6]),
    jnp.array([-0.3, 0.4]),
    {"motor": jnp.array(0.5), "work": jnp.array(0.0), "compass": jnp.array([1.0, 0.0])},
)
COMPASS = mj.Constraint(lambda t, z, args: z["compass"] @ z["compass"] - 1.0)


def system(**options):
    options = {"auxiliary_constraint": COMPASS, **options}
    return mj.MechanicalSystem(1.0, rod, torque_and_weight, auxiliary=controller, **options)


def solve(built, hook, args=GAINS, t1=2.0, y0=START, **options):
    options = {
        "saveat": dfx.SaveAt(ts=jnp.linspace(0.0, t1, 5)),
        "stepsize_controller": dfx.PIDController(rtol=1e-9, atol=1e-9),
        **options,
    }
    return mj.diffeqsolve(built.terms, hook, 0.0, t1, None, y0, args, **options)


def in_angles(ts):
    """The same with an angle for the rod, by SciPy."""
    stiffness, damping, lag = GAINS

    def f(t, x):
        angle, rate, motor, _ = x
        turn = motor - 9.81 * np.cos(angle)
        return [rate, turn, (-stiffness * angle - damping * rate - motor) / lag, motor * rate]

    start = [np.arctan2(0.6, 0.8), 0.5, 0.5, 0.0]
    options = dict(t_eval=ts, method="DOP853", rtol=1e-12, atol=1e-12)
    return scipy.integrate.solve_ivp(f, (0, ts[-1]), start, **options).y


HOOKS = {
    "projected": lambda c: mj.Projected(dfx.Tsit5(), c),
    "error metric": lambda c: mj.Projected(dfx.Tsit5(), c, projection=mj.NewtonProjection("error")),
    "tangent": lambda c: mj.LocalCoordinates(dfx.Tsit5(), c),
}


@pytest.mark.parametrize("name", variants(HOOKS, ["projected"]))
def test_controlled_rod(name):
    """Agrees with the equations in angles; `q`, `v` and the part of `z` with a constraint are on
    the manifold, the rest of `z` is not moved."""
    built = system()
    sol = solve(built, HOOKS[name](built.constraint))
    q, v, z = sol.ys
    angle, rate, motor, work = in_angles(np.asarray(sol.ts))
    np.testing.assert_allclose(np.arctan2(q[:, 1], q[:, 0]), angle, atol=2e-8)
    np.testing.assert_allclose(q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0], rate, atol=2e-8)
    np.testing.assert_allclose(z["motor"], motor, atol=2e-8)
    np.testing.assert_allclose(z["work"], work, atol=2e-8)
    compass = np.stack([np.cos(3 * sol.ts), np.sin(3 * sol.ts)], axis=1)
    np.testing.assert_allclose(z["compass"], compass, atol=2e-8)
    assert mj.constraint_violation(built.constraint, sol.ts, sol.ys, GAINS) < 1e-15


@pytest.mark.parametrize(
    "stabilization", [mj.Baumgarte(5.0, 5.0), mj.VelocityStabilization()], ids=type
)
def test_stabilized_accelerations(stabilization):
    built = system(stabilization=stabilization)
    sol = solve(built, dfx.Tsit5())
    q, _, z = sol.ys
    angle, _, motor, _ = in_angles(np.asarray(sol.ts))
    np.testing.assert_allclose(np.arctan2(q[:, 1], q[:, 0]), angle, atol=1e-7)
    np.testing.assert_allclose(z["motor"], motor, atol=1e-6)


def test_of_a_lagrangian_and_without_a_constraint_on_further_states():
    lagrangian = lambda t, q, v, args: v @ v / 2 - 9.81 * q[1]
    motor = lambda t, q, v, z, args: jnp.stack([-q[1], q[0]]) * z["motor"]
    built = mj.MechanicalSystem.from_lagrangian(lagrangian, rod, motor, auxiliary=controller)
    sol = solve(built, mj.Projected(dfx.Tsit5(), built.constraint))
    expected = in_angles(np.asarray(sol.ts))
    np.testing.assert_allclose(sol.ys[2]["work"], expected[3], atol=2e-8)


@pytest.mark.slow
def test_gradient_with_respect_to_a_gain():
    """Of the work, forward = reverse = differences."""
    built = system()
    hook = mj.Projected(dfx.Bosh3(), built.constraint)

    def work(lag, adjoint=None):
        steps = dict(stepsize_controller=dfx.StepTo(jnp.linspace(0.0, 1.0, 41)), max_steps=64)
        steps |= {} if adjoint is None else {"adjoint": adjoint}
        saveat = dfx.SaveAt(t1=True)
        return solve(built, hook, (9.0, 4.0, lag), 1.0, saveat=saveat, **steps).ys[2]["work"][0]

    run = jax.jit(work)
    reverse = jax.jit(jax.grad(work))(0.2)
    forward = jax.jvp(lambda lag: work(lag, dfx.ForwardMode()), (0.2,), (1.0,))[1]
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    np.testing.assert_allclose(reverse, (run(0.2 + 1e-5) - run(0.2 - 1e-5)) / 2e-5, rtol=1e-6)


def test_consistent_start():
    """Far off in all three parts; weights for each of them."""
    built = system()
    off = (2 * START[0], START[1] + 1.0, {**START[2], "compass": jnp.array([3.0, 4.0])})
    weights = (2.0, 1.0, {"motor": 1.0, "work": 1.0, "compass": 1.0})
    for projection in (None, mj.NewtonProjection(metric=weights)):
        (q, v, z), info = mj.consistent_state(
            built.constraint, 0.0, off, GAINS, projection=projection
        )
        np.testing.assert_allclose(q, [0.8, 0.6], atol=1e-15)
        np.testing.assert_allclose(q @ v, 0.0, atol=1e-15)
        np.testing.assert_allclose(z["compass"], [0.6, 0.8], atol=1e-15)
        assert z["motor"] == off[2]["motor"]
        assert info.success


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_arguments():
    with pytest.raises(TypeError, match=r"`force` must be a callable `Q\(t, q, v, z, args\)`"):
        mj.MechanicalSystem(1.0, rod, lambda t, q, v, args: q, auxiliary=controller)
    with pytest.raises(TypeError, match=r"`auxiliary` must be a callable `h\(t, q, v, z, args\)`"):
        mj.MechanicalSystem(1.0, rod, torque_and_weight, auxiliary=lambda t, z: z)
    with pytest.raises(TypeError, match="`auxiliary_constraint` must be an `mj.Constraint`"):
        system(auxiliary_constraint=lambda t, z, args: z)
    with pytest.raises(ValueError, match="`auxiliary_constraint` is for the states of `auxiliary`"):
        mj.MechanicalSystem(1.0, rod, lambda t, q, v, args: q, auxiliary_constraint=COMPASS)
    built = system()
    with pytest.raises(
        ValueError, match=r"`y` must be the tuple `\(q, v, z\)`.*got shapes \(\(2,\), \(2,\)\)"
    ):
        solve(built, mj.Projected(dfx.Tsit5(), built.constraint), y0=START[:2])
    wrong = mj.MechanicalSystem(
        1.0, rod, torque_and_weight, auxiliary=lambda t, q, v, z, args: z["motor"]
    )
    with pytest.raises(
        ValueError, match="`auxiliary` must return .* of the structure and shapes of z"
    ):
        solve(wrong, mj.Projected(dfx.Tsit5(), wrong.constraint))
