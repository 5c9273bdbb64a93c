"""Optimal control by multiple shooting: known optima, derivatives, charts that are left, and what cannot be done."""

import functools
import itertools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import manifold_jax as mj
from manifold_jax._applications.quasi_newton import BlockHessian, Minimum
from manifold_jax._applications.shooting import Charts, Shooting
from manifold_jax._applications.trajectory_quality import Measured, message_of
from manifold_jax._applications.transcription import gaps_of, Transcription


CIRCLE = mj.Constraint(lambda t, y, u: y @ y - 1)
TURNING = dfx.ODETerm(lambda t, y, u: u[0] * jnp.stack([-y[1], y[0]]))
TIMES = np.array([0.0, 0.2, 0.5, 0.9, 1.4])  # of different lengths
GRAVITY = 9.81


def on_circle(angle):
    return jnp.array([np.cos(angle), np.sin(angle)])


def effort(t, y, u):
    return u @ u


def turn(**changed):
    """Turn a point on the circle by 1.2 rad."""
    given = dict(ts=TIMES, y0=on_circle(0.3), inputs=np.zeros((TIMES.size, 1)))
    given |= dict(cost=effort, goal=on_circle(1.5)) | changed
    return mj.optimize_trajectory(TURNING, CIRCLE, **given)


def test_the_shortest_way():
    """The least effort is a constant rate, which needs no trial of other inputs between the times."""
    found = turn()
    np.testing.assert_allclose(found.inputs, 1.2 / 1.4, atol=1e-9)
    assert found.cost == pytest.approx(1.2**2 / 1.4, abs=1e-8)
    assert found.success
    assert found.gap < 1e-12
    assert found.integration_error < 1e-7
    assert jnp.abs(jnp.sum(found.ys**2, axis=1) - 1).max() < 1e-15
    assert found.ys[0] == pytest.approx(np.asarray(on_circle(0.3)))
    assert found.ys[-1] == pytest.approx(np.asarray(on_circle(1.5)))
    assert found(0.35) == pytest.approx(np.mean(found.inputs[1:3], axis=0))
    assert found(9.0) == found.inputs[-1]


@pytest.mark.parametrize("constraint", [None, mj.Constraint(lambda t, y, u: jnp.zeros(0))])
def test_without_a_constraint(constraint):
    """A mass that a force moves by `d` from rest to rest in `T`: the least effort is `12 d^2 / T^3`."""
    mass = dfx.ODETerm(lambda t, y, u: (y[1], u))
    at_rest = lambda q: (jnp.array([q]), jnp.zeros(1))
    given = TIMES, at_rest(0.3), np.zeros((5, 1))
    found = mj.optimize_trajectory(mass, constraint, *given, cost=effort, goal=at_rest(1.5))
    assert found.cost == pytest.approx(12 * 1.2**2 / 1.4**3, rel=1e-9)
    np.testing.assert_allclose(found.inputs[:, 0], 6 * 1.2 / 1.4**2 * (1 - TIMES / 0.7), atol=1e-6)


def test_a_final_cost():
    """A constant rate `u`, for which `T u^2 + w |y1 - target|^2` is least."""
    target, weight, T = on_circle(1.5), 2.0, TIMES[-1]
    found = turn(goal=None, final_cost=lambda y: weight * jnp.sum((y - target) ** 2))
    total = lambda u: T * u**2 + weight * 2 * (1 - np.cos(1.2 - T * u))
    best = scipy.optimize.minimize_scalar(
        total, bounds=(0.0, 1.2 / T), method="bounded", options=dict(xatol=1e-10)
    )
    np.testing.assert_allclose(found.inputs, best.x, atol=1e-6)
    assert found.cost == pytest.approx(best.fun, abs=1e-10)


def test_a_goal_that_is_a_function():
    found = turn(goal=lambda y: y[1] - np.sin(1.5))
    np.testing.assert_allclose(found.inputs, 1.2 / 1.4, atol=1e-8)


def test_bounds_that_bind():
    """At most 1 rad/s, while the cost of a rate grows with time."""
    found = turn(cost=lambda t, y, u: (1 + 3 * t) * u[0] ** 2, bounds=(-1.0, np.array([1.0])))
    assert found.inputs.max() <= 1
    assert found.inputs[0, 0] == pytest.approx(1.0, abs=1e-5)
    assert found.cost == pytest.approx(reference_of_bounds(), rel=1e-5)


def reference_of_bounds():
    """The same in the angle, whose equation is linear: a quadratic program in the inputs alone."""
    fine = np.linspace(0.0, TIMES[-1], 28001)
    hats = np.stack([np.interp(fine, TIMES, row) for row in np.eye(TIMES.size)])
    H = scipy.integrate.simpson(hats[:, None] * hats[None] * (1 + 3 * fine), x=fine)
    way = scipy.integrate.simpson(hats, x=fine)
    found = scipy.optimize.minimize(
        lambda u: u @ H @ u,
        np.full(TIMES.size, 1.2 / 1.4),
        jac=lambda u: 2 * H @ u,
        method="SLSQP",
        bounds=[(-1, 1)] * TIMES.size,
        constraints=dict(type="eq", fun=lambda u: way @ u - 1.2, jac=lambda u: way),
        options=dict(ftol=1e-14),
    )
    return found.fun


def rate(y):
    """Angular velocity on the circle."""
    (q, v) = y
    return q[0] * v[1] - q[1] * v[0]


def test_a_limit_of_the_speed():
    """From rest to rest with at most 0.95 rad/s at the times, while the cost of a torque grows with time."""
    no_weight = lambda t, q, v, u: jnp.stack([-q[1], q[0]]) * u[0]
    disc = mj.MechanicalSystem(1.0, lambda t, q, u: q @ q - 1, no_weight)
    ts, at_rest = np.array([0.0, 0.2, 0.5, 0.9, 1.4, 1.6]), jnp.zeros(2)
    found = mj.optimize_trajectory(
        disc.terms,
        disc.constraint,
        ts,
        (on_circle(0.3), at_rest),
        np.zeros((6, 1)),
        cost=lambda t, y, u: (1 + t) * u @ u,
        goal=(on_circle(1.5), at_rest),
        path_constraint=lambda t, y, u: jnp.abs(rate(y)) - 0.95,
    )
    rates = jax.vmap(rate)(found.ys)
    assert found.success
    assert rates.max() == pytest.approx(0.95, abs=1e-5)
    assert found.cost == pytest.approx(reference_of_limit(ts, 0.95), rel=1e-6)


def reference_of_limit(ts, most):
    """The same in the angle: a quadratic program in the torques alone."""
    fine = np.linspace(0.0, ts[-1], 16001)
    hats = np.stack([np.interp(fine, ts, row) for row in np.eye(ts.size)])
    H = scipy.integrate.simpson(hats[:, None] * hats[None] * (1 + fine), x=fine)
    speeds = scipy.integrate.cumulative_trapezoid(hats, fine, initial=0)
    way = scipy.integrate.simpson(speeds, x=fine)
    at_knots = speeds[:, np.searchsorted(fine, ts - 1e-9)].T
    ends = np.stack([at_knots[-1], way])
    found = scipy.optimize.minimize(
        lambda u: u @ H @ u,
        np.zeros(ts.size),
        jac=lambda u: 2 * H @ u,
        method="SLSQP",
        constraints=[
            dict(type="eq", fun=lambda u: ends @ u - [0.0, 1.2], jac=lambda u: ends),
            dict(type="ineq", fun=lambda u: most - at_knots @ u, jac=lambda u: -at_knots),
        ],
        options=dict(ftol=1e-14),
    )
    return found.fun


def test_a_path_that_is_impossible():
    """The point must not be higher than where it starts."""
    found = turn(path_constraint=lambda t, y, u: y[1] - 0.2, max_iterations=60, throw=False)
    assert not found.success
    assert "apart, most at t = 0.2, the `path_constraint` 0" in found.message


@pytest.mark.parametrize("name", ["gap", "miss", "excess", "error"])
def test_what_is_not_a_number(name):
    """No comparison with NaN holds: such a motion is not found."""
    good = Measured(gap=0.0, at=0.2, miss=0.0, excess=-1.0, excess_at=0.2, error=0.0)
    found = Minimum(None, np.zeros(1), 0.0, 0.0, 7, is_final=True)
    assert not message_of(found, good)
    assert "nan" in message_of(found, good._replace(**{name: np.nan}))


def weight_and_torque(t, q, v, u):
    """A ball of 1 kg on a circle of 1 m, with a torque about the centre."""
    return jnp.stack([-q[1], q[0]]) * u[0] - jnp.array([0.0, GRAVITY])


BALL = mj.MechanicalSystem(1.0, lambda t, q, u: q @ q - 1, weight_and_torque)
HANGING = jnp.array([0.0, -1.0]), jnp.zeros(2)
RAISED = jnp.array([np.sin(2.5), -np.cos(2.5)]), jnp.zeros(2)
SWING = np.linspace(0.0, 3.0, 21)


def raised(**changed):
    given = dict(ts=SWING, y0=HANGING, inputs=np.zeros((SWING.size, 1)), cost=effort, goal=RAISED)
    return mj.optimize_trajectory(
        BALL.terms, BALL.constraint, **given | dict(bounds=(-6.0, 6.0)) | changed
    )


def angle_at_the_end(inputs):
    """Integrate the angle from the lowest point by other means."""
    torque = lambda t: np.interp(t, SWING, inputs)
    field = lambda t, y: [y[1], torque(t) - GRAVITY * np.sin(y[0])]
    pieces, y = itertools.pairwise(SWING), np.zeros(2)
    for a, b in pieces:
        y = scipy.integrate.solve_ivp(field, (a, b), y, "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    return y


def test_a_swing_that_leaves_its_charts():
    """The torque is too small to raise the ball at once. The guess goes straight up; the motion to and fro
    is up to 1.6 rad from there, where tangent coordinates end."""
    found = raised()
    assert found.success
    assert found.gap < 1e-10
    assert found.num_iterations < 200
    assert jnp.abs(found.inputs).max() < 6
    for q, v in zip(*map(np.asarray, found.ys), strict=True):
        assert abs(q @ q - 1) < 1e-14
        assert abs(q @ v) < 1e-13
    angles = np.unwrap(np.arctan2(found.ys[0][:, 0], -found.ys[0][:, 1]))
    assert angles.min() < -0.5 or angles.max() > 2.6  # it takes a swing
    end = angle_at_the_end(found.inputs[:, 0])
    assert np.cos(end[0] - 2.5) == pytest.approx(1.0, abs=1e-8)
    assert abs(end[1]) < 1e-4
    # Single shooting in the angle, from there, finds nothing better.
    turns = end[0]
    h = np.diff(SWING)[0]
    cost = lambda u: h / 3 * np.sum(u[:-1] ** 2 + u[:-1] * u[1:] + u[1:] ** 2)
    best = scipy.optimize.minimize(
        cost,
        found.inputs[:, 0],
        method="SLSQP",
        bounds=[(-6, 6)] * SWING.size,
        constraints=dict(type="eq", fun=lambda u: angle_at_the_end(u) - [turns, 0.0]),
        options=dict(maxiter=5, ftol=1e-12),
    )
    assert cost(np.asarray(found.inputs[:, 0])) == pytest.approx(float(found.cost), rel=1e-12)
    assert best.fun > float(found.cost) - 1e-4


def test_what_is_out_of_reach():
    given = dict(bounds=(-0.5, 0.5), max_iterations=60)
    found = raised(throw=False, **given)
    assert not found.success
    assert found.gap > 0.01
    assert "The goal may be out of reach within `bounds`" in found.message
    with pytest.raises(RuntimeError, match="No motion was found"):
        raised(**given)


def test_steps_that_are_too_coarse():
    """Two and a half radian in each of two steps; with eight it is exact enough."""
    fast = dfx.ODETerm(lambda t, y, u: (2.5 + u[0]) * jnp.stack([-y[1], y[0]]))
    ts, goal = np.array([0.0, 2.0, 4.0]), on_circle(0.3 + 10.5)
    given = ts, on_circle(0.3), np.full((3, 1), 0.1)
    solve = lambda steps: mj.optimize_trajectory(
        fast, CIRCLE, *given, cost=effort, goal=goal, steps=steps, throw=False
    )
    coarse, fine = solve(2), solve(8)
    assert not coarse.success
    assert "Write more `steps`" in coarse.message
    assert fine.success
    np.testing.assert_allclose(fine.inputs, 0.125, atol=1e-4)


def test_iterations_that_are_too_few():
    found = turn(cost=lambda t, y, u: u[0] ** 4, max_iterations=12, throw=False)
    assert not found.success
    assert "Write more `max_iterations`" in found.message


def test_a_turn_that_is_repeated():
    """A point that follows one that moves at a constant rate is where that is, also at the first time."""
    T = TIMES[-1]
    rate = 2 * np.pi / T
    target = lambda t: jnp.stack([jnp.cos(rate * t + 0.1), jnp.sin(rate * t + 0.1)])
    found = turn(
        y0=on_circle(0.4),
        goal=None,
        periodic=True,
        inputs=np.arange(5.0)[:, None],
        states=on_circle(0.4 + rate * TIMES).T,
        cost=lambda t, y, u: u @ u + 3 * jnp.sum((y - target(t)) ** 2),
        steps=8,
    )
    np.testing.assert_allclose(found.inputs, rate, atol=1e-5)
    np.testing.assert_allclose(found.ys[0], on_circle(0.1), atol=1e-6)
    np.testing.assert_array_equal(found.ys[0], found.ys[-1])
    np.testing.assert_array_equal(found.inputs[0], found.inputs[-1])
    assert found.gap < 1e-9


def test_a_forced_oscillation():
    """The steady state of a damped oscillator on a line, whose initial state is not known."""
    rate = np.pi
    along = lambda t, q, v, u: jnp.cos(rate * t) - 4 * q[1] - 0.6 * v[1] + u[0]
    force = lambda *given: jnp.stack([jnp.zeros(()), along(*given)])
    slider = mj.MechanicalSystem(1.0, lambda t, q, u: q[0] - 1, force)
    ts = np.array([0.0, 0.4, 0.7, 1.2, 1.5, 2.0])
    found = mj.optimize_trajectory(
        *(slider.terms, slider.constraint, ts, (jnp.array([1.0, 0.3]), jnp.zeros(2))),
        *(np.zeros((6, 1)),),
        cost=effort,
        periodic=True,
        steps=16,
    )
    amplitude = 1 / (4 - rate**2 + 0.6j * rate)
    exact = (
        np.real(amplitude * np.exp(1j * rate * ts)),
        np.imag(-rate * amplitude * np.exp(1j * rate * ts)),
    )
    for state, expected in zip(found.ys, exact, strict=True):
        np.testing.assert_allclose(state[:, 1], expected, atol=1e-6)
    assert found.cost < 1e-12


@functools.cache
def transcription(periodic=False):
    """Wind that changes with time, a final cost, a goal that is a function, and a path constraint."""
    push = lambda t, q, v, u: jnp.concatenate([u, jnp.sin(2 * t)[None] - GRAVITY]) - 0.3 * v
    ball = mj.MechanicalSystem(1.0, lambda t, q, u: q @ q - 1, push)
    unravel = jax.flatten_util.ravel_pytree((jnp.zeros(3), jnp.zeros(3)))[1]
    last = lambda y: jnp.stack([jnp.sum(y[0] ** 3), y[0][0] * y[1][1]])
    cost = lambda t, y, u: u @ u + t * y[0][1] ** 2
    path = lambda t, y, u: jnp.stack([t * y[0][0] * y[1][2] - u[1], u[0] * u[1] - y[0][2] ** 2])
    shooting = Shooting(ball.terms, ball.constraint, dfx.Tsit5(), cost, last, path, unravel, 2)
    random = np.random.default_rng(0)
    q = random.standard_normal((4, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    v = random.standard_normal((4, 3))
    v -= np.sum(q * v, axis=1, keepdims=True) * q
    us = random.standard_normal((4, 2))
    charts = Charts.around(shooting, np.array([0.0, 0.3, 0.7, 1.2]), np.append(q, v, axis=1), us)
    found = Transcription.of(shooting, charts, 2, ends_free=True, periodic=periodic)
    at = 0.1 * random.standard_normal(found.size)
    at[found.inputs] += us
    return found, at, random


@pytest.mark.parametrize("periodic", [False, True])
def test_derivatives(periodic):
    T, v, random = transcription(periodic)
    along, h = random.standard_normal(T.size), 1e-5
    central = lambda f: (f(v + h * along) - f(v - h * along)) / (2 * h)
    np.testing.assert_allclose(T.jacobian(v) @ along, central(T.residual), atol=1e-8)
    assert T.cost_gradient(v) @ along == pytest.approx(central(T.cost), abs=1e-8)
    # Blocks of second derivatives satisfy the secant equation of the last step.
    multipliers = random.standard_normal(T.residual(v).size)
    lagrangian = lambda v: T.cost_gradient(v) + T.jacobian(v).T @ multipliers
    hessian, step = BlockHessian(T), 0.1 * along
    hessian.at(v, multipliers)
    expected = lagrangian(v + step) - lagrangian(v)
    np.testing.assert_allclose(hessian.at(v + step, multipliers) @ step, expected, atol=1e-10)


@pytest.mark.parametrize("periodic", [False, True])
def test_new_charts_change_nothing(periodic):
    T, v, _random = transcription(periodic)
    new, moved, turn = T.recentered(v)
    for each in (T.at(v).knots.x, new.at(moved).knots.x):
        assert np.array_equal(each[0], each[-1]) == periodic
    np.testing.assert_allclose(new.at(moved).knots.x, T.at(v).knots.x, atol=1e-14)
    assert new.cost(moved) == pytest.approx(T.cost(v), abs=1e-13)
    np.testing.assert_allclose(
        np.einsum("knd,kde->kne", new.at(moved).knots.by_z, turn), T.at(v).knots.by_z, atol=1e-12
    )


def test_gaps_of_states_on_the_far_side():
    """The difference from the opposite point has no tangent part; the gap is nevertheless as long, over the root of two."""
    random = np.random.default_rng(1)
    bases = np.linalg.qr(random.standard_normal((6, 5, 2)))[0]
    near = np.einsum("knd,kd->kn", bases, random.standard_normal((6, 2)))
    differences = near + 3 * (np.arange(6) > 2)[:, None] * random.standard_normal((6, 5))
    gaps, slopes = gaps_of(differences, bases)
    across = np.linalg.qr(bases[0], mode="complete")[0][:, 2:].sum(axis=1)
    assert np.linalg.norm(gaps_of(across[None], bases[:1])[0]) == pytest.approx(np.sqrt(1.5))
    length = np.linalg.norm(differences, axis=1)
    np.testing.assert_allclose(np.linalg.norm(gaps[:3], axis=1), length[:3])
    assert np.all(np.linalg.norm(gaps, axis=1) >= length / np.sqrt(2) - 1e-12)
    along, h = random.standard_normal((6, 5)), 1e-6
    central = (
        gaps_of(differences + h * along, bases)[0] - gaps_of(differences - h * along, bases)[0]
    ) / (2 * h)
    np.testing.assert_allclose(np.einsum("kdn,kn->kd", slopes, along), central, atol=1e-8)


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        (dict(y0=np.float32([1.0, 0.0])), ValueError, "`y0` must be in double precision"),
        (dict(steps=3), ValueError, "`steps` must be an even number"),
        (dict(ts=TIMES[::-1]), ValueError, "`ts` must be at least three increasing"),
        (
            dict(inputs=np.zeros(5)),
            ValueError,
            r"`inputs` must be finite and have the shape \(5, m\)",
        ),
        (dict(bounds=(1.0, -1.0)), ValueError, "each lower bound must be below"),
        (
            dict(bounds=(np.zeros(2), 1.0)),
            ValueError,
            r"`bounds` must be two numbers, or arrays of shape \(1,\)",
        ),
        (dict(bounds=1.0), ValueError, r"`bounds` must be `\(lower, upper\)`"),
        (dict(goal=2 * on_circle(1.5)), ValueError, "`goal` is not on the manifold"),
        (dict(goal=jnp.ones(3)), ValueError, "`goal` must be a state like `y0`"),
        (
            dict(goal=lambda y: jnp.ones((2, 2))),
            ValueError,
            "`goal` must be a state like `y0`, or a function",
        ),
        (dict(cost=lambda t, y, u: u), ValueError, "`cost` must return one number"),
        (dict(cost=3.0), TypeError, "`cost` must be a function"),
        (dict(final_cost=lambda y: y), ValueError, "`final_cost` must return one number"),
        (dict(path_constraint=1.0), TypeError, "`path_constraint` must be a function"),
        (
            dict(path_constraint=lambda t, y, u: jnp.ones((2, 2))),
            ValueError,
            "`path_constraint` must return a number or",
        ),
        (dict(periodic=True), ValueError, "`goal` must be a function or None where"),
        (dict(states=jnp.zeros((4, 2))), ValueError, "`states` must have the shapes"),
        (dict(states=jnp.zeros((5, 2))), ValueError, "No guess of the state at t = 0.2"),
    ],
)
def test_bad_input(changed, error, message):
    with pytest.raises(error, match=message):
        turn(**changed)


def test_a_manifold_that_does_not_repeat():
    moving = mj.Constraint(lambda t, y, u: y @ y - 1 - t)
    with pytest.raises(ValueError, match="`periodic=True` needs a `constraint` that is the same"):
        mj.optimize_trajectory(
            *(TURNING, moving, TIMES, on_circle(0.3), np.ones((5, 1))), cost=effort, periodic=True
        )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (dict(cost=lambda t, y, u: jnp.sqrt(u @ u)), "`cost` or its derivative is not finite"),
        (
            dict(goal=lambda y: jnp.sqrt(jnp.abs(y[0] - y[0])) * y[:1]),
            "`final_cost` or `goal`, or the deriv",
        ),
        (
            dict(goal=lambda y: y - on_circle(1.5)),
            "`goal` returns 2 numbers that depend on each other",
        ),
        (dict(inputs=np.zeros((5, 0))), "`inputs` must be finite"),
        (
            dict(path_constraint=lambda t, y, u: jnp.sqrt(jnp.sum((y - on_circle(0.3)) ** 2)) - 2),
            "`path_constraint` or its derivative is not finite at t = 0 ",
        ),
    ],
)
def test_a_guess_without_derivatives(changed, message):
    """Comparisons with NaN would end the optimizer at once."""
    with pytest.raises(ValueError, match=message):
        turn(**changed)


def test_a_cost_that_is_not_integrated():
    """A narrow hill in the way, and numbers that are NaN, between the points of Simpson's rule."""
    hill = lambda t, y, u: u @ u + 50 * jnp.exp(-(((t - 0.35) / 0.005) ** 2)) * y[0] ** 2
    hole = lambda t, y, u: jnp.where(jnp.abs(t - 0.025) < 0.01, jnp.nan, u @ u)
    for cost in (hill, hole):
        found = turn(cost=cost, throw=False)
        assert "The steps are too coarse" in found.message
        assert not found.success


def test_a_cost_at_the_end_alone():
    found = turn(
        cost=lambda t, y, u: 0.0, goal=None, final_cost=lambda y: -y[1], bounds=(-3.0, 3.0)
    )
    np.testing.assert_allclose(found.ys[-1], [0.0, 1.0], atol=1e-5)


def test_terms_that_are_none():
    with pytest.raises(TypeError, match="such as `system.terms`, got MechanicalSystem"):
        mj.optimize_trajectory(BALL, BALL.constraint, TIMES, HANGING, np.zeros((5, 1)), cost=effort)


def test_nothing_that_can_move():
    fixed = mj.Constraint(lambda t, y, u: y - on_circle(0.3))
    given = TIMES, on_circle(0.3), np.zeros((5, 1))
    with pytest.raises(ValueError, match="nothing can move"):
        mj.optimize_trajectory(TURNING, fixed, *given, cost=effort)


def test_inside_jit():
    with pytest.raises(TypeError, match="outside of `jit`"):
        jax.jit(lambda y0: turn(y0=y0).cost)(on_circle(0.3))
