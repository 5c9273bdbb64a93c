"""Regulators along trajectories: Riccati equations on tangent spaces, and feedback with their gains."""

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj


mb = mj.multibody
CIRCLE = mj.Constraint(lambda t, y, u: y @ y - 1)
TURNING = dfx.ODETerm(lambda t, y, u: u[0] * jnp.stack([-y[1], y[0]]))
WEIGHTS = dict(state_weights=3.0, input_weights=0.5)


def around(number, **changed):
    """Twice the arguments of `regulate`: a point on the circle with the angular velocity 1."""
    ts = jnp.linspace(0.0, 2.0, number)
    ys = jnp.stack([jnp.cos(ts), jnp.sin(ts)], axis=1)
    return dict(ts=ts, ys=ys, inputs=jnp.ones((number, 1))) | WEIGHTS | changed


def test_a_point_on_a_circle():
    """`-S' = q - S^2 / r`, `S(2) = 0` is solved by a hyperbolic tangent."""
    found = mj.regulate(TURNING, CIRCLE, **around(6))
    expected = np.sqrt(1.5) * np.tanh(np.sqrt(6) * (2 - found.ts))
    np.testing.assert_allclose(found.riccati[:, 0, 0], expected, atol=1e-14)
    tangents = np.stack([-found.ys[:, 1], found.ys[:, 0]], axis=1)
    np.testing.assert_allclose(found.gains[:, 0], 2 * expected[:, None] * tangents, atol=1e-14)
    for t in (0.2, 1.3):  # between the times: a cubic of the circle
        on_it = jnp.stack([jnp.cos(t), jnp.sin(t)])
        assert found(t, on_it)[0] == pytest.approx(1.0, abs=1e-3)
    h, s = 0.4, 0.5
    middle = (found.ys[0] + found.ys[1]) / 2 + h / 8 * (tangents[0] - tangents[1])
    assert found(0.2, middle)[0] == pytest.approx(1.0, abs=1e-15)
    assert found(5.0, found.ys[-1])[0] == pytest.approx(1.0, abs=1e-15)  # held after the end
    assert found(-1.0, found.ys[0] + tangents[0] * s)[0] == pytest.approx(1 - expected[0])


def test_without_a_constraint():
    """A pendulum that a torque holds upright, for ever: the gains of the algebraic Riccati equation."""
    pendulum = dfx.ODETerm(lambda t, y, u: jnp.stack([y[1], 9.81 * jnp.sin(y[0]) + u[0]]))
    A, B = np.array([[0, 1], [9.81, 0]]), np.array([[0.0], [1.0]])
    S = scipy.linalg.solve_continuous_are(A, B, 3.0 * np.eye(2), 0.5 * np.eye(1))
    given = around(2, ys=jnp.zeros((2, 2)), inputs=jnp.zeros((2, 1)), final_weights=S)
    found = mj.regulate(pendulum, None, **given)
    np.testing.assert_allclose(found.gains, np.broadcast_to(2 * S[1], (2, 1, 2)), rtol=1e-11)


def pushed(t, q, v, u):
    """Weight and a horizontal force."""
    return jnp.concatenate([u, jnp.array([-9.81])])


BALL = mj.MechanicalSystem(1.0, lambda t, q, u: q @ q - 1, pushed)
START = (jnp.array([0.48, 0.6, 0.64]), jnp.array([0.6, -0.48, 0.0]))
PUSH = jnp.array([0.3, -0.2])
BALL_WEIGHTS = dict(
    state_weights=jnp.array([4.0, 1.0, 2.0, 0.3, 0.5, 0.2]),
    input_weights=jnp.array([0.5, 0.2]),
    final_weights=3.0,
)


TIMES = jnp.linspace(0.0, 1.0, 41)


def open_loop(t, y):
    return PUSH


def swing(law, start, times=TIMES):
    field = dfx.ODETerm(lambda t, y, args: BALL.terms.vf(t, y, law(t, y)))
    hook = mj.Projected(dfx.Dopri8(), BALL.constraint)
    control = dfx.PIDController(rtol=1e-9, atol=1e-9)
    save = dfx.SaveAt(ts=times)
    return mj.diffeqsolve(
        field, hook, 0.0, 1.0, None, start, saveat=save, stepsize_controller=control
    )


def ambient_riccati():
    """The Riccati equation in all six coordinates, whatever the manifold, back from the end."""
    end = jax.tree.map(lambda leaf: leaf[-1], swing(open_loop, START).ys)
    x1, unravel = jfu.ravel_pytree(end)
    field = lambda x, u: jfu.ravel_pytree(BALL.terms.vf(0.0, unravel(x), u))[0]
    Q, R, F = (jnp.diag(jnp.broadcast_to(w, k)) for w, k in zip(BALL_WEIGHTS.values(), (6, 2, 6)))

    def back(t, state, args):
        x, S = state
        A, B = jax.jacfwd(field, (0, 1))(x, PUSH)
        return field(x, PUSH), -(A.T @ S + S @ A - S @ B @ jnp.linalg.solve(R, B.T) @ S + Q)

    control = dfx.PIDController(rtol=1e-10, atol=1e-10)
    term, solver = dfx.ODETerm(back), dfx.Dopri8()
    sol = dfx.diffeqsolve(term, solver, 1.0, 0.0, None, (x1, F), stepsize_controller=control)
    return sol.ys[1][0]


def test_the_error_is_of_second_order():
    S, errors = ambient_riccati(), []
    sol = swing(open_loop, START)
    for stride in (2, 1):
        ts, ys = jax.tree.map(lambda leaf, k=stride: leaf[::k], (sol.ts, sol.ys))
        inputs = jnp.broadcast_to(PUSH, (ts.size, 2))
        found = mj.regulate(BALL.terms, BALL.constraint, ts, ys, inputs, **BALL_WEIGHTS)
        T = found.bases[0]
        errors.append(np.abs(found.riccati[0] - T.T @ S @ T).max() / np.abs(T.T @ S @ T).max())
    assert errors[1] < 6e-3
    assert 3.7 < errors[0] / errors[1] < 4.2


def test_it_returns_to_its_trajectory():
    """A ball that falls from the upper half of a sphere, pushed aside."""
    sol = swing(open_loop, START)
    inputs = jnp.broadcast_to(PUSH, (41, 2))
    feedback = jax.jit(
        lambda ys: mj.regulate(
            BALL.terms,
            BALL.constraint,
            TIMES,
            ys,
            inputs,
            state_weights=jnp.repeat(jnp.array([100.0, 1.0]), 3),
            input_weights=1e-3,
            final_weights=10.0,
        )
    )(sol.ys)
    aside, _ = mj.consistent_state(BALL.constraint, 0.0, (START[0] + 0.05, START[1] - 0.1))
    distances = [
        float(jnp.abs(run.ys[0][-1] - sol.ys[0][-1]).max())
        for run in (swing(open_loop, aside), swing(feedback, aside))
    ]
    assert distances[0] > 1e-3
    assert distances[1] < 2e-5


@pytest.mark.slow
def test_an_acrobot_with_a_loop():
    """Two arms and two forearms that meet, upside down, with a motor in one shoulder alone: at rest the
    gains are those of the algebraic Riccati equation, and hold it."""
    points = {"left": ((0.0, 0.0), (-0.05, 0.2)), "right": ((0.1, 0.0), (0.15, 0.2))}
    bodies, joints, hand = [], [], np.array([0.05, 0.3])
    for side, (shoulder, elbow) in points.items():
        for name, (a, b) in {"arm": (shoulder, elbow), "forearm": (elbow, hand)}.items():
            middle, length = (np.add(a, b) / 2, np.linalg.norm(np.subtract(b, a)))
            bodies.append(mb.Body(f"{side} {name}", 1.0, length**2 / 12, position=middle))
        joints += [
            mb.Revolute(mb.GROUND, f"{side} arm", at=shoulder, name=f"{side} shoulder"),
            mb.Revolute(f"{side} arm", f"{side} forearm", at=elbow),
        ]
    joints.append(mb.Revolute("left forearm", "right forearm", at=hand))

    def robot(law):
        motor = mb.Controller(("left shoulder",), law)
        return mb.Assembly(bodies, joints, [motor], gravity=(0.0, -9.81)).system

    plant, none = robot(lambda t, y, args: args), jnp.zeros(1)
    drawing = mb.Assembly(bodies, joints).state()
    rest = (mj.equilibrium(plant, drawing[0], none).q, drawing[1])
    near = mj.linearize(plant.terms, plant.constraint, 0.0, rest, none)
    assert jnp.sum(near.eigenvalues().real > 1) == 2  # it would fall in two ways
    A, B, T = near.matrix, near.by_args, near.basis
    S = scipy.linalg.solve_continuous_are(A, B, np.eye(4), np.eye(1))
    twice = lambda leaf: jnp.stack([leaf, leaf])
    feedback = mj.regulate(
        plant.terms,
        plant.constraint,
        jnp.array([0.0, 0.1]),
        jax.tree.map(twice, rest),
        twice(none),
        state_weights=1.0,
        input_weights=1.0,
        final_weights=T @ S @ T.T,
    )
    np.testing.assert_allclose(feedback.gains[0], B.T @ S @ T.T, rtol=1e-8, atol=1e-8)
    held = robot(lambda t, y, args: feedback(t, y))
    closed = mj.linearize(held.terms, held.constraint, 0.0, rest, None).eigenvalues()
    expected = np.linalg.eigvals(A - B @ B.T @ S)
    assert np.max(expected.real) < 0
    np.testing.assert_allclose(np.sort(closed.real), np.sort(expected.real), rtol=1e-7)


BAD = {
    "at least two times": dict(ts=jnp.zeros(1)),
    "increase from each time": dict(ts=jnp.zeros(3)),
    r"`ys` must have a leading axis for the 3 times": dict(ys=jnp.ones((2, 2))),
    r"`inputs` must have a leading axis for the 3 times": dict(inputs=jnp.ones((4, 1))),
    r"`inputs` must have the shape \(3, m\)": dict(inputs=jnp.ones(3)),
    r"`state_weights` must be a number, or have the shape \(2,\)": dict(state_weights=jnp.ones(5)),
    "`input_weights` must be positive": dict(input_weights=0.0),
    "from t = 1 to 2 the tangent space turns by more than 60 degrees": dict(
        ys=jnp.array([[1.0, 0.0], [0.8, 0.6], [-0.6, 0.8]])
    ),
    "`state_weights` must not be negative": dict(state_weights=-1.0),
    "Riccati equation cannot be solved from t = 1": dict(state_weights=1e300, input_weights=1e-300),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_arguments(message):
    with pytest.raises(ValueError, match=message):
        mj.regulate(TURNING, CIRCLE, **around(3, **BAD[message]))


def test_inputs_that_do_nothing_and_equations_twice():
    idle = dfx.ODETerm(lambda t, y, u: jnp.stack([-y[1], y[0]]))
    with pytest.raises(ValueError, match="`inputs` have no effect on the motion"):
        mj.regulate(idle, CIRCLE, **around(6))
    twice = mj.Constraint(lambda t, y, u: jnp.stack([y @ y - 1, 2 * (y @ y) - 2]))
    with pytest.raises(ValueError, match="at t = 0 the linearization is not finite"):
        mj.regulate(TURNING, twice, **around(6))
