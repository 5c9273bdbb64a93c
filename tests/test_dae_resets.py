"""Resets of reduced differential-algebraic equations: the jump names unknowns."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import manifold_jax as mj


PID = dfx.PIDController(rtol=1e-10, atol=1e-12)


def diode(t, x, xdot, k):
    """A capacitor discharged by a diode, whose law determines `u` from the charge `c`."""
    return xdot["c"] + x["u"], x["u"] + x["u"] ** 3 - k * x["c"]


def diode_by_hand(k, t):
    """The solution from `c = 1`, where 1 is added whenever `c` has fallen to 1/2: `log u + 3 u^2 / 2 + k t`
    is constant in between."""
    u_of = lambda c: brentq(lambda u: u + u**3 - k * c, 0, 10, xtol=1e-15)
    phase = lambda u: np.log(u) + 1.5 * u**2
    c, times = 1.0, []
    while True:
        until = (phase(u_of(c)) - phase(u_of(0.5))) / k
        if until > t:
            last = phase(u_of(c)) - k * t
            u = brentq(lambda u, last=last: phase(u) - last, 1e-6, 10, xtol=1e-15)
            return np.array([(u + u**3) / k, u]), np.cumsum(times)
        t, c = t - until, 1.5
        times.append(until)


@pytest.mark.parametrize("form", ["ode", pytest.param("index-1", marks=pytest.mark.slow)])
def test_algebraic_unknowns_follow_from_what_the_jump_names(form):
    k = jnp.array(1.3)
    dae = mj.reduce_dae(diode, {"c": jnp.ones(()), "u": jnp.ones(())}, k, form=form)
    solver = mj.Rodas5P() if form == "index-1" else mj.Projected(dfx.Tsit5(), dae.constraint)
    unknowns = lambda t, z, k: dae.outputs(t, z, k)[0]
    refill = mj.Reset(
        lambda t, z, k: unknowns(t, z, k)["c"] - 0.5,
        dae.jump(lambda t, x, k: {**x, "c": x["c"] + 1}, fixed=("c",)),
        direction=False,
    )

    def solve(k):
        guess = {"c": 1.0, "u": 0.5}
        z0, _ = dae.consistent_state(0.0, guess, k, fixed=("c",), throw=False)
        sol = mj.diffeqsolve(
            dae.terms, solver, 0.0, 3.0, None, z0, k, resets=(refill,), stepsize_controller=PID
        )
        end = unknowns(3.0, sol.ys[0], k)
        end = jnp.stack([end["c"], end["u"]])
        return end, (end, sol.resets)

    derivative = jax.jacrev if form == "ode" else jax.jacfwd
    found, (end, resets) = jax.jit(derivative(solve, has_aux=True))(k)
    exact, times = diode_by_hand(1.3, 3.0)
    np.testing.assert_allclose(end, exact, rtol=1e-8)
    assert resets.number == len(times) == 2
    np.testing.assert_allclose(resets.times[:2], times, rtol=1e-8)
    after = unknowns(0.0, resets.after[0], k)
    np.testing.assert_allclose(after["c"], 1.5, rtol=1e-14)  # exactly what the jump says
    np.testing.assert_allclose(after["u"] + after["u"] ** 3, 1.5 * k, rtol=1e-14)
    h = 1e-5
    slope = (diode_by_hand(1.3 + h, 3.0)[0] - diode_by_hand(1.3 - h, 3.0)[0]) / (2 * h)
    np.testing.assert_allclose(found, slope, rtol=1e-6)


def pendulum(t, x, xdot, xddot, args):
    q, force = x["q"], -x["tension"] * x["q"] - jnp.stack([jnp.zeros(()), args["g"]])
    return xddot["q"] - force, q @ q - args["length"] ** 2


def pendulum_at_a_stop(args, end):
    """Angle and its rate from rest at -1, stopped at the angle where `x = 0.3`, by SciPy."""
    stop = lambda t, y: args["length"] * np.sin(y[0]) - 0.3
    stop.terminal, stop.direction = True, 1
    field = lambda t, y: [y[1], -args["g"] / args["length"] * np.sin(y[0])]
    t, y, number = 0.0, np.array([-1.0, 0.0]), 0
    while True:
        sol = solve_ivp(field, (t, end), y, method="DOP853", rtol=1e-12, atol=1e-13, events=stop)
        t, y = sol.t[-1], sol.y[:, -1]
        if sol.status == 0:
            return y, number
        y, number = np.array([y[0], -args["e"] * y[1]]), number + 1


@pytest.mark.slow
def test_a_stop_in_equations_of_order_two():
    args = {"g": jnp.array(9.81), "length": jnp.array(1.1), "e": jnp.array(0.7)}
    example = {"q": jnp.array([0.5, -0.9]), "tension": jnp.ones(())}
    dae = mj.reduce_dae(pendulum, example, args, order=2)

    def rebound(t, x, xdot, args):
        return x, {**xdot, "q": -args["e"] * xdot["q"]}

    stop = mj.Reset(
        lambda t, z, args: dae.outputs(t, z, args)[0]["q"][0] - 0.3,
        dae.jump(rebound, fixed=("q",)),
        direction=True,
    )

    def solve(args):
        q = args["length"] * jnp.stack([jnp.sin(-1.0), -jnp.cos(-1.0)])
        z0, _ = dae.consistent_state(0.0, {**example, "q": q}, args, throw=False)
        sol = mj.diffeqsolve(
            dae.terms,
            mj.Projected(dfx.Tsit5(), dae.constraint),
            0.0,
            2.5,
            None,
            z0,
            args,
            resets=(stop,),
            stepsize_controller=PID,
        )
        x, xdot, _ = dae.outputs(2.5, sol.ys[0], args)
        end = jnp.concatenate([x["q"], xdot["q"]])
        return end @ weights, (end, sol.resets)

    weights = jnp.array([0.3, -0.5, 1.1, 0.7])
    gradient, (end, resets) = jax.jit(jax.grad(solve, has_aux=True))(args)
    (angle, rate), number = pendulum_at_a_stop(args, 2.5)
    assert resets.number == number > 1
    sin, cos = np.sin(angle), np.cos(angle)
    reference = 1.1 * np.array([sin, -cos, rate * cos, rate * sin])
    np.testing.assert_allclose(end, reference, atol=1e-8)
    for states in (resets.before, resets.after):
        g = jax.vmap(lambda t, z: dae.constraint(t, z, args))
        assert np.max(np.abs(g(resets.times[:number], states[:number]))) < 1e-14
    for name in args:
        shifted = lambda h, name=name: pendulum_at_a_stop({**args, name: args[name] + h}, 2.5)[0]
        length = lambda h, name=name: 1.1 + h * (name == "length")

        def weighted(h, shifted=shifted, length=length):
            angle, rate = shifted(h)
            sin, cos = np.sin(angle), np.cos(angle)
            return length(h) * np.array([sin, -cos, rate * cos, rate * sin]) @ weights

        difference = (weighted(1e-4) - weighted(-1e-4)) / 2e-4
        np.testing.assert_allclose(gradient[name], difference, rtol=2e-6)


def test_what_a_jump_keeps_and_what_it_cannot_do():
    """Positions that are fixed and possible stay; from a jump that cannot be repaired comes no state."""
    args = {"g": jnp.array(9.81), "length": jnp.array(1.1), "e": jnp.array(0.7)}
    example = {"q": jnp.array([0.5, -0.9]), "tension": jnp.ones(())}
    dae = mj.reduce_dae(pendulum, example, args, order=2)
    z0, _ = dae.consistent_state(0.0, {**example, "q": jnp.array([0.0, -1.1])}, args)
    stretch = dae.jump(
        lambda t, x, xdot, args: ({**x, "q": args["e"] * x["q"]}, xdot), fixed=("q",)
    )
    after = jax.vmap(lambda e: stretch(0.0, z0, {**args, "e": e}))(jnp.array([1.0, 1.2]))
    np.testing.assert_allclose(after[0], z0, atol=1e-14)
    assert np.all(np.isnan(after[1]))
    push = lambda t, x, xdot, args: (x, {**xdot, "q": xdot["q"] + jnp.array([0.5, 0.2])})
    after = dae.jump(push, fixed=("q",))(0.0, z0, args)
    np.testing.assert_allclose(after, [0.0, -1.1, 0.5, 0.0], atol=1e-15)
    with pytest.raises(
        TypeError, match=r"`change` must be a callable `change\(t, x, xdot, args\)`"
    ):
        dae.jump(lambda t, x, args: x)
    with pytest.raises(ValueError, match=r"`change` must return \(x, xdot\), of the structure"):
        dae.jump(lambda t, x, xdot, args: x)(0.0, z0, args)
    with pytest.raises(ValueError, match=r"`change` must return \(x, xdot\), of the structure"):
        dae.jump(lambda t, x, xdot, args: ({**x, "q": x["q"][:1]}, xdot))(0.0, z0, args)
    with pytest.raises(ValueError, match="`fixed` names `tension`"):
        dae.jump(lambda t, x, xdot, args: (x, xdot), fixed=("tension",))(0.0, z0, args)
