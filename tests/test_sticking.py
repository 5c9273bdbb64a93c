"""Contacts that stay and are given up: constraints that are switched on and off by resets."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


def switched(name, value):
    def jump(t, y, args):
        q, v = y
        return {**q, name: jnp.full_like(q[name], value)}, v

    return jump


def solve(system, resets, t1, q, v, args):
    return mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Tsit5(), system.constraint),
        0.0,
        t1,
        None,
        (q, v),
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        resets=resets,
        max_resets=4,
    )


def states_at(resets, number):
    return (jax.tree.map(lambda x: x[number], y) for y in (resets.before, resets.after))


def string(t, q, args):
    """A ball on a string of length 1, which can be slack."""
    return jnp.where(q["taut"] > 0.5, (q["ball"] @ q["ball"] - 1) / 2, 0.0)


def weight(t, q, v, args):
    return {"ball": jnp.stack([0 * args[1], -args[1]]), "taut": jnp.zeros_like(q["taut"])}


def tension(y, args):
    return y[1]["ball"] @ y[1]["ball"] - args[1] * y[0]["ball"][1]


STRING = mj.MechanicalSystem(1.0, string, weight, redundant=True)
SLACK = (
    mj.Reset(
        lambda t, y, args: jnp.where(y[0]["taut"] > 0.5, tension(y, args), 1.0),
        switched("taut", 0.0),
        direction=False,
    ),
    mj.Reset(
        lambda t, y, args: jnp.where(y[0]["taut"] > 0.5, 1.0, 1 - y[0]["ball"] @ y[0]["ball"]),
        switched("taut", 1.0),
        direction=False,
    ),
)


def whirl(args):
    """From the lowest point with the speed `args[0]`; gravity is `args[1]`."""
    one, zero = jnp.ones_like(args[0]), jnp.zeros_like(args[0])
    q = {"ball": jnp.stack([zero, -one]), "taut": one}
    v = {"ball": jnp.stack([args[0], zero]), "taut": zero}
    sol = solve(STRING, SLACK, 1.5, q, v, args)
    after = sol.resets.after
    return (
        sol.resets.times[1] - sol.resets.times[0],
        after[0]["ball"][1],
        after[1]["ball"][1],
    ), sol


def flight(args):
    """Its duration, and position and velocity of the ball on the taut string after it, which begins at the
    angle a, where gravity alone turns the ball, and ends at -3 a."""
    speed, g = args
    a = jnp.arcsin((speed**2 - 2 * g) / (3 * g))
    v = jnp.sqrt(g * jnp.sin(a))
    along = jnp.stack([jnp.sin(3 * a), jnp.cos(3 * a)])
    falling = v * jnp.stack([-jnp.sin(a), -3 * jnp.cos(a)])
    end = jnp.stack([jnp.cos(3 * a), -jnp.sin(3 * a)])
    return 4 * v * jnp.cos(a) / g, end, (falling @ along) * along


def test_a_string_that_is_slack_for_a_while():
    """Release and capture are those of the closed form. The string takes the velocity along it away, with its
    energy, and nothing else."""
    args = jnp.array([np.sqrt(3.4 * 9.81), 9.81])
    values, sol = jax.jit(whirl)(args)
    assert sol.resets.indices.tolist() == [0, 1, -1, -1]
    assert sol.stats["num_nondifferentiable_resets"] == 0
    for ours, exact in zip(values, flight(args), strict=True):
        np.testing.assert_allclose(ours, exact, atol=1e-8)
    before, after = states_at(sol.resets, 1)
    np.testing.assert_allclose(before[0]["ball"], after[0]["ball"], atol=1e-13)
    direction, change = before[0]["ball"], after[1]["ball"] - before[1]["ball"]
    outwards = before[1]["ball"] @ direction
    np.testing.assert_allclose(change, -outwards * direction, atol=1e-13)
    lost = (before[1]["ball"] @ before[1]["ball"] - after[1]["ball"] @ after[1]["ball"]) / 2
    np.testing.assert_allclose(lost, outwards**2 / 2, rtol=1e-13)
    for taut in states_at(sol.resets, 0), [after]:
        for y in taut:
            np.testing.assert_allclose(y[0]["ball"] @ y[0]["ball"], 1, rtol=1e-15)
    np.testing.assert_allclose(after[0]["ball"] @ after[1]["ball"], 0, atol=1e-15)
    assert after[0]["taut"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_of_the_slack_string(mode):
    args = jnp.array([np.sqrt(3.4 * 9.81), 9.81])
    jacobian = jax.jit(mode(lambda p: whirl(p)[0]))(args)
    for ours, exact in zip(jacobian, jax.jacfwd(flight)(args), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-7, atol=1e-7)


def rod_and_floor(t, q, args):
    """Two masses on a rod of length 1; while it stands the first is on the floor."""
    along = q["ends"][1] - q["ends"][0]
    return (along @ along - 1) / 2, jnp.where(q["stands"] > 0.5, q["ends"][0, 1], 0.0)


def no_slip(t, q, v, args):
    return jnp.where(q["stands"] > 0.5, v["ends"][0, 0], 0.0)


def weights(t, q, v, args):
    heavy = args["masses"] * args["gravity"]
    down = jnp.stack([jnp.zeros_like(heavy), -heavy], axis=1)
    return {"ends": down, "stands": jnp.zeros_like(q["stands"])}


def masses(q, args):
    return {"ends": jnp.stack([args["masses"]] * 2, axis=1), "stands": jnp.ones_like(q["stands"])}


ROD = mj.MechanicalSystem(
    masses, rod_and_floor, weights, velocity_constraint=no_slip, redundant=True
)
LANDING = mj.Reset(
    lambda t, y, args: jnp.where(y[0]["stands"] > 0.5, 1.0, y[0]["ends"][0, 1]),
    switched("stands", 1.0),
    direction=False,
)


@pytest.mark.slow
def test_a_rod_that_lands():
    """It turns about its foot from the landing, with the angular momentum about this point that it had. The
    foot stays where it landed, a place that is not known before."""
    m, M, g = 1.0, 2.0, 9.81
    args = {"masses": jnp.array([m, M]), "gravity": jnp.array(g)}
    r = np.array([-0.65, np.sqrt(1 - 0.65**2)])
    foot, moving, turning = np.array([0.0, 0.02]), np.array([0.2, -1.0]), -4.0
    still = jnp.zeros(())
    q = {"ends": jnp.array([foot, foot + r]), "stands": still}
    v = jnp.array([moving, moving + turning * np.array([-r[1], r[0]])])
    sol = solve(ROD, (LANDING,), 0.4, q, {"ends": v, "stands": still}, args)
    assert sol.resets.number == 1
    (q, v), (_, w) = states_at(sol.resets, 0)
    q, v, w = (np.asarray(x["ends"]) for x in (q, v, w))
    r = q[1] - q[0]
    rate = r[0] * v[1, 1] - r[1] * v[1, 0]
    np.testing.assert_allclose(w, [[0, 0], [-rate * r[1], rate * r[0]]], atol=1e-12)
    kinetic = lambda v: 0.5 * (m * v[0] @ v[0] + M * v[1] @ v[1])
    lost = 0.5 * (m * v[0] @ v[0] + M * (v[1] @ r) ** 2)
    np.testing.assert_allclose(kinetic(v) - kinetic(w), lost, rtol=1e-12)
    end, u = (np.asarray(x["ends"][0]) for x in sol.ys)
    np.testing.assert_allclose(end[0], q[0], atol=1e-15)
    np.testing.assert_allclose(u[0], 0, atol=1e-15)
    np.testing.assert_allclose(kinetic(u) + M * g * end[1, 1], kinetic(w) + M * g * r[1], rtol=1e-9)
