"""Jumps of the state at events and at known times, with the derivative of the time of the event."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj


PID = dfx.PIDController(rtol=1e-9, atol=1e-9)
FALL = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -args[0]]))
# g, e, z0, v0
BALL = jnp.array([10.0, 0.8, 5.0, -0.1])


def bounced(t, y, args):
    return jnp.stack([y[0], -args[1] * y[1]])


BOUNCE = mj.Reset(lambda t, y, args: y[0], bounced, direction=False)


def drop(p, t1=8.0, solver=None, resets=(BOUNCE,), **options):
    options = dict(stepsize_controller=PID, max_resets=20) | options
    solver = dfx.Tsit5() if solver is None else solver
    return mj.diffeqsolve(FALL, solver, 0.0, t1, 0.1, p[2:], p[:2], resets=resets, **options)


def bounce_times(p, count):
    """In closed form."""
    g, e, z0, v0 = p
    v = jnp.sqrt(v0**2 + 2 * g * z0)
    flights = 2 * v / g * jnp.cumprod(jnp.full(count - 1, e))
    return (v0 + v) / g + jnp.concatenate([jnp.zeros(1), jnp.cumsum(flights)])


def height(p, t, count):
    """After `count` bounces."""
    g, e, z0, v0 = p
    since = t - bounce_times(p, count)[-1]
    return jnp.sqrt(v0**2 + 2 * g * z0) * e**count * since - g * since**2 / 2


def test_ten_bounces():
    """Times, states, first and second derivatives are those of the closed form, in both modes."""
    sol = drop(BALL)
    assert int(sol.resets.number) == 10
    np.testing.assert_allclose(sol.resets.times[:10], bounce_times(BALL, 10), rtol=1e-13)
    np.testing.assert_allclose(sol.resets.before[:10, 0], 0, atol=1e-13)
    np.testing.assert_array_equal(sol.resets.after[:10, 1], -0.8 * sol.resets.before[:10, 1])
    assert np.isinf(sol.resets.times[10:]).all()
    assert (sol.resets.indices == jnp.where(jnp.arange(20) < 10, 0, -1)).all()
    assert sol.stats["num_nondifferentiable_resets"] == 0
    np.testing.assert_allclose(sol.ys[0, 0], height(BALL, 8.0, 10), atol=1e-11)

    end = lambda p: drop(p).ys[0, 0]
    exact = jax.grad(height)(BALL, 8.0, 10)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(BALL), exact, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(BALL), exact, rtol=1e-9)
    hessian = jax.jit(jax.jacfwd(jax.grad(end)))(BALL)
    np.testing.assert_allclose(hessian, jax.hessian(height)(BALL, 8.0, 10), rtol=1e-7, atol=1e-7)


def test_steps_for_a_bounce():
    """At most two more per event, which end at it."""
    events, steps = [], []
    for t1 in (0.9, 8.0):
        sol = drop(BALL, t1)
        events.append(int(sol.resets.number))
        steps.append(int(sol.stats["num_steps"]))
    assert events == [0, 10]
    assert steps[1] <= steps[0] + 3 * events[1]


def test_gradients_of_what_is_reported():
    """Of the times of events and the states on both sides, of values saved between events, of all steps,
    and of the dense solution, which is two-sided."""
    ts = jnp.linspace(0.0, 3.0, 7)

    def values(p):
        saveat = dfx.SaveAt(ts=ts, dense=True)
        sol = drop(p, 3.0, saveat=saveat, max_steps=64)
        dense = jax.vmap(sol.evaluate)(jnp.array([0.5, 2.0, 2.9]))
        resets = sol.resets
        time = resets.times[0]
        both_sides = sol.evaluate(time), sol.evaluate(time, left=False)
        found = resets.times[:2], resets.before[:2], resets.after[:2], sol.ys, dense
        return found, (time, both_sides)

    forward, (time, (before, after)) = jax.jit(jax.jacfwd(values, has_aux=True))(BALL)
    reverse, _ = jax.jit(jax.jacrev(values, has_aux=True))(BALL)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-11), forward, reverse)
    exact = jax.jacfwd(bounce_times)(BALL, 2)
    np.testing.assert_allclose(reverse[0], exact, atol=1e-11)
    np.testing.assert_allclose(reverse[3][-1, 0], jax.grad(height)(BALL, 3.0, 2), atol=1e-11)
    np.testing.assert_allclose(reverse[4][1, 0], jax.grad(height)(BALL, 2.0, 1), atol=1e-11)
    np.testing.assert_allclose(time, bounce_times(BALL, 1)[0], rtol=1e-14)
    np.testing.assert_allclose(after[1], -0.8 * before[1], rtol=1e-12)
    np.testing.assert_allclose(jnp.stack([before[0], after[0]]), 0, atol=1e-12)


def test_gradient_of_saved_steps():
    def saved(p):
        sol = drop(p, 3.0, saveat=dfx.SaveAt(steps=True), max_steps=32)
        used = jnp.isfinite(sol.ts)
        return jnp.sum(jnp.where(used, sol.ts, 0)), jnp.sum(jnp.where(used[:, None], sol.ys, 0))

    forward, reverse = jax.jit(jax.jacfwd(saved))(BALL), jax.jit(jax.jacrev(saved))(BALL)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-11), forward, reverse)
    assert float(jnp.abs(reverse[0]).max()) > 0.1  # by the times of the events


SPRING = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -(args[0] ** 2) * y[0]]))
WALL = mj.Reset(lambda t, y, args: y[0] - args[1], lambda t, y, args: jnp.stack([y[0], -y[1]]))


def vibrate(p, dt0, solver=None):
    """An oscillator that starts at 1 and bounces off a wall at `p[1]`."""
    y0 = jnp.array([1.0, 0.0])
    solver = dfx.Tsit5() if solver is None else solver
    return mj.diffeqsolve(SPRING, solver, 0.0, 4.0, dt0, y0, p, resets=(WALL,)).ys[0]


def vibration(p):
    """After three bounces: the phase jumps by twice the angle that is left out."""
    left_out = 2 * (jnp.pi - jnp.arccos(p[1]))
    phase = p[0] * 4.0 + 3 * left_out
    return jnp.stack([jnp.cos(phase), -p[0] * jnp.sin(phase)])


@pytest.mark.parametrize(("solver", "order"), [(dfx.Tsit5(), 5), (dfx.Bosh3(), 3), (dfx.Heun(), 2)])
def test_order_of_convergence(solver, order):
    """Of the state and of its gradient, with constant steps; Heun's interpolation is a straight line."""
    p, errors = jnp.array([3.0, -0.3]), []
    twice = lambda p, dt: (vibrate(p, dt, solver),) * 2
    solve = jax.jit(jax.jacfwd(twice, has_aux=True))
    for n in (160, 320) if order > 2 else (640, 1280):
        jacobian, y = solve(p, jnp.array(4.0 / n))
        jacobian = jacobian - jax.jacfwd(vibration)(p)
        errors.append([jnp.abs(y - vibration(p)).max(), jnp.abs(jacobian).max()])
    orders = np.log2(np.array(errors[0]) / np.array(errors[1]))
    np.testing.assert_allclose(orders, order, atol=0.35)


def pendulum_field(t, y, args):
    q, v = y[:2], y[2:]
    tension = (v @ v - args[0] * q[1]) / (q @ q)
    return jnp.concatenate([v, -tension * q - args[0] * jnp.array([0.0, 1.0])])


CIRCLE = mj.Constraint(
    lambda t, y, args: jnp.stack([y[:2] @ y[:2] - 1.0, y[:2] @ y[2:]]),
)
HIT = mj.Reset(
    lambda t, y, args: y[0] - args[2],
    # Not tangent to the circle: the correction makes it so.
    lambda t, y, args: jnp.stack([y[0] + 1e-3, y[1], -args[1] * y[2], -args[1] * y[3]]),
    direction=True,
)


def swing(p, solver, t1=3.0, **options):
    """A pendulum in Cartesian coordinates that hits a wall."""
    y0 = jnp.array([np.sin(-1.0), -np.cos(1.0), 0.0, 0.0])
    options = dict(stepsize_controller=PID, resets=(HIT,), max_resets=8) | options
    return mj.diffeqsolve(dfx.ODETerm(pendulum_field), solver, 0.0, t1, 0.01, y0, p, **options)


P = jnp.array([9.81, 0.7, 0.2])
STABILIZED = mj.Stabilized(dfx.Tsit5(), CIRCLE, stabilization=mj.InvariantStabilization(5.0))
SOLVERS = {
    "projected": mj.Projected(dfx.Tsit5(), CIRCLE),
    "local": mj.LocalCoordinates(dfx.Tsit5(), CIRCLE),
    "stabilized": STABILIZED,
    "Kvaerno5": mj.Projected(dfx.Kvaerno5(), CIRCLE),
    "Rodas5P": mj.Projected(mj.Rodas5P(), CIRCLE),
}
QUICK = ("projected",)


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SOLVERS]
)
def test_on_the_manifold_before_and_after(name):
    """To round-off, with equal gradients in both modes, which are those of differences."""
    solver = SOLVERS[name]
    weights = jnp.array([1.0, 2.0, 0.3, 0.4])

    def end(p):
        sol = swing(p, solver)
        return sol.ys[0] @ weights, sol.resets

    run = jax.jit(end)
    _, resets = run(P)
    count = int(resets.number)
    assert count == 2
    violation = jax.vmap(lambda y: jnp.max(jnp.abs(CIRCLE(0.0, y, P))))
    assert violation(resets.after[:count]).max() < 1e-15
    assert violation(resets.before[:count]).max() < (1e-7 if name == "stabilized" else 1e-15)
    np.testing.assert_allclose(resets.before[:count, 0], 0.2, atol=1e-14)
    function = lambda p: end(p)[0]
    reverse, forward = jax.jit(jax.grad(function))(P), jax.jit(jax.jacfwd(function))(P)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    h, quotients = 1e-4, []
    for i in range(3):
        at = [run(P.at[i].add(k * h))[0] for k in (-2, -1, 1, 2)]
        quotients.append((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h))
    np.testing.assert_allclose(reverse, quotients, rtol=1e-6)


@pytest.mark.parametrize(
    "adjoint", [dfx.ForwardMode(), pytest.param(dfx.DirectAdjoint(), marks=pytest.mark.slow)]
)
def test_adjoints_of_diffrax(adjoint):
    derivative = jax.jacfwd if isinstance(adjoint, dfx.ForwardMode) else jax.jacrev
    end = lambda p, **options: drop(p, 2.5, max_steps=40, **options).ys[0]
    other = jax.jit(derivative(lambda p: end(p, adjoint=adjoint)))(BALL)
    np.testing.assert_allclose(other, jax.jit(jax.jacrev(end))(BALL), atol=1e-12)


def test_batch():
    """Trajectories with different numbers of events are those solved alone; one that fails is told."""
    many = jnp.stack([BALL, BALL.at[2].set(1.0), BALL.at[3].set(3.0), BALL.at[1].set(0.3)])

    def solve(p):
        sol = drop(p, 3.0, throw=False)
        return sol.ys[0], sol.resets, sol.result == dfx.RESULTS.successful

    *together, result = jax.jit(jax.vmap(solve))(many)
    assert result.tolist() == [True, True, True, False]
    alone = jax.jit(solve)
    for i in range(4):
        *one, _ = alone(many[i])
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-14),
            together,
            one,
        )
    assert together[1].number.tolist() == [2, 6, 1, 20]


def test_three_roots_in_one_step():
    """SciPy's issue 9228: a cubic with roots at 1, 2 and 3, and steps longer than that. All are found,
    and the derivative of each is that by itself."""

    def cubic(roots):
        a, b, c = roots
        field = lambda t, y, args: jnp.stack(
            [3 * t**2 - 2 * (a + b + c) * t + a * b + a * c + b * c, 0 * t]
        )
        reset = mj.Reset(lambda t, y, args: y[0], lambda t, y, args: jnp.stack([y[0], y[1] + 1.0]))
        y0 = jnp.stack([-a * b * c, jnp.zeros_like(a)])
        sol = mj.diffeqsolve(dfx.ODETerm(field), dfx.Tsit5(), 0.0, 10.0, 10.0, y0, resets=(reset,))
        times = sol.resets.times[:3]
        return times, (times, sol.resets.number, sol.ys[0, 1])

    roots = jnp.array([1.0, 2.0, 3.0])
    slopes, (times, number, count) = jax.jit(jax.jacrev(cubic, has_aux=True))(roots)
    assert number == 3
    assert count == 3
    np.testing.assert_allclose(times, roots, rtol=1e-14)
    np.testing.assert_allclose(slopes, np.eye(3), atol=1e-13)


def doses(p, times, **options):
    """Absorption and elimination, with doses at known times."""
    field = lambda t, y, args: jnp.stack([-args[0] * y[0], args[0] * y[0] - args[1] * y[1]])
    dose = mj.ResetAt(times, lambda t, y, args: jnp.stack([y[0] + args[2], y[1]]))
    return mj.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Tsit5(),
        0.0,
        24.0,
        None,
        jnp.zeros(2),
        p,
        resets=(dose,),
        stepsize_controller=PID,
        **options,
    )


def concentrations(p, times, t):
    since = jnp.maximum(t - times, 0)
    depot = p[2] * jnp.exp(-p[0] * since)
    blood = p[2] * p[0] / (p[1] - p[0]) * (jnp.exp(-p[0] * since) - jnp.exp(-p[1] * since))
    return jnp.stack([jnp.sum(jnp.where(t >= times, x, 0)) for x in (depot, blood)])


def test_known_times():
    """The first at the start, one after the end; a value saved at such a time is that after the jump, one
    unit of rounding before it is that before."""
    p, times = jnp.array([1.1, 0.3, 5.0]), jnp.array([18.0, 0.0, 6.0, 12.0, 24.0, 30.0, -1.0])
    ts = jnp.array([0.0, np.nextafter(6.0, 0), 6.0, np.nextafter(6.0, 7), 18.0, 24.0])

    def end(p, times):
        sol = doses(p, times, saveat=dfx.SaveAt(ts=ts))
        return sol.ys[-1, 1], sol

    derivatives = [jax.jit(mode(end, (0, 1), has_aux=True)) for mode in (jax.grad, jax.jacfwd)]
    (reverse, sol), (forward, _) = (derivative(p, times) for derivative in derivatives)
    assert sol.resets.times[:5].tolist() == [0.0, 6.0, 12.0, 18.0, np.inf]
    inside = times.at[jnp.array([4, 6])].set(
        40.0
    )  # those at the end and before the start are not made
    exact = jax.vmap(lambda t: concentrations(p, inside, t))(ts)
    np.testing.assert_allclose(sol.ys, exact, atol=3e-9)
    np.testing.assert_allclose(sol.ys[2] - sol.ys[1], [5.0, 0.0], atol=1e-12)
    exact = jax.grad(lambda p, times: concentrations(p, times, 24.0)[1], (0, 1))(p, inside)
    for of_p, of_times in (reverse, forward):
        np.testing.assert_allclose(of_p, exact[0], rtol=1e-7)
        np.testing.assert_allclose(of_times, exact[1], atol=1e-8)


def test_no_times():
    """A patient without doses."""
    jump = lambda t, y, args: y + 1
    none = (mj.ResetAt([], jump), mj.ResetAt(lambda args: jnp.zeros(0), jump))
    sol = solve_decay(none)
    assert sol.resets.number == 0
    np.testing.assert_allclose(sol.ys[-1], np.exp(-1.0), rtol=1e-6)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    ("controller", "dt0"),
    [
        (dfx.ConstantStepSize(), 0.125),  # steps end at the times
        (dfx.ConstantStepSize(), 0.1),  # and a few units of rounding beside them
        (dfx.PIDController(rtol=1e-3, atol=1e-3), None),
    ],
)
def test_known_times_at_the_ends_of_steps(controller, dt0, direction):
    """What is saved then is the value after the jump, also where a step would have ended there."""
    ts = direction * jnp.arange(0.0, 5.1, 0.5)
    jump = mj.ResetAt(direction * jnp.array([1.0, 2.0, 3.0]), lambda t, y, args: y + 1.0)
    sol = mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.zeros_like(y)),
        dfx.Tsit5(),
        0.0,
        direction * 5.0,
        None if dt0 is None else direction * dt0,
        jnp.zeros(()),
        saveat=dfx.SaveAt(ts=ts, dense=True),
        stepsize_controller=controller,
        resets=(jump,),
    )
    assert sol.ys.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 3, 3, 3]
    assert (direction * sol.resets.times[:3]).tolist() == [1, 2, 3]
    sides = [
        [float(sol.evaluate(direction * t, left=left)) for left in (True, False)]
        for t in (1.0, 2.0)
    ]
    assert sides == [[0, 1], [1, 2]]


def test_known_times_have_room_of_their_own():
    """More of them than `max_resets`, which is for events: the ones here come in between."""
    dose = mj.ResetAt(jnp.linspace(0.05, 0.95, 7), lambda t, y, args: y + 1.0)
    full = mj.Reset(lambda t, y, args: y - 2.5, lambda t, y, args: y - 3.0, direction=True)
    still = dfx.ODETerm(lambda t, y, args: jnp.zeros_like(y))
    parts = still, dfx.Tsit5(), 0.0, 1.0, 0.25, jnp.zeros(())
    sol = mj.diffeqsolve(*parts, resets=(dose, full), max_resets=2)
    assert sol.resets.times.shape == (9,)
    assert sol.resets.indices.tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0]
    assert sol.ys.tolist() == [1.0]


def cradle(masses, t1, restitution=1.0):
    """Balls on threads in a row, in contact where they hang; the first is let go."""
    n = masses.size
    field = lambda t, y, args: jnp.concatenate([y[n:], -9.81 * y[:n]])

    def collide(i):
        def jump(t, y, args):
            v, w, a, b = y[n + i], y[n + i + 1], args[i], args[i + 1]
            impulse = (1 + restitution) * a * b / (a + b) * (v - w)
            return y.at[n + i].add(-impulse / a).at[n + i + 1].add(impulse / b)

        return mj.Reset(lambda t, y, args: y[i + 1] - y[i], jump, direction=False)

    return mj.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Tsit5(),
        0.0,
        t1,
        None,
        jnp.zeros(2 * n).at[0].set(-0.3),
        masses,
        resets=tuple(collide(i) for i in range(n - 1)),
        stepsize_controller=PID,
    )


def test_newtons_cradle():
    """Collisions at one time happen one after the other, from ball to ball."""
    sol = cradle(jnp.ones(4), 0.9)
    assert sol.resets.indices[:4].tolist() == [0, 1, 2, -1]
    times = sol.resets.times[:3]
    np.testing.assert_allclose(times, np.pi / 2 / np.sqrt(9.81), rtol=1e-9)
    assert times[0] == times[1] == times[2]
    speed = 0.3 * np.sqrt(9.81)
    np.testing.assert_allclose(sol.resets.after[2, 4:], [0, 0, 0, speed], atol=1e-9)
    assert sol.stats["num_nondifferentiable_resets"] == 2


def test_a_chain_of_collisions_that_comes_back():
    """With unequal masses the second ball is thrown back onto the first, at the same time; nothing
    penetrates, momentum and energy are kept."""
    masses = jnp.array([1.0, 2.0, 1.0, 3.0])
    sol = cradle(masses, 0.9)
    count = int(sol.resets.number)
    indices = sol.resets.indices[:count].tolist()
    assert indices[:4] == [0, 1, 2, 1]
    before, after = sol.resets.before[:count, 4:], sol.resets.after[:count, 4:]
    np.testing.assert_allclose(before @ masses, after @ masses, atol=1e-12)
    np.testing.assert_allclose(before**2 @ masses, after**2 @ masses, atol=1e-12)
    assert jnp.diff(sol.ys[0, :4]).min() > -1e-12
    final = after[-1]
    assert (jnp.diff(final) > -1e-9).all()


def test_order_of_events_at_one_time():
    """The first in `resets` comes first, whatever the direction; both happen."""
    field = dfx.ODETerm(lambda t, y, args: jnp.array([1.0, 1.0, 0.0]))
    log = lambda k: lambda t, y, args: y.at[2].set(10 * y[2] + k)
    one = mj.Reset(lambda t, y, args: y[0] - 0.5, log(1.0))
    two = mj.Reset(lambda t, y, args: 0.5 - y[1], log(2.0))
    solve = lambda resets: mj.diffeqsolve(
        field, dfx.Tsit5(), 0.0, 1.0, 0.3, jnp.zeros(3), resets=resets
    )
    assert solve((one, two)).ys[0, 2] == 12
    assert solve((two, one)).ys[0, 2] == 21
    assert solve((one, two)).stats["num_nondifferentiable_resets"] == 2
    # A condition that is changed by a jump, without the state passing through zero.
    pushed = mj.Reset(
        lambda t, y, args: y[2] - 0.5, lambda t, y, args: y.at[2].set(7.0), direction=True
    )
    sol = solve((one, pushed))
    assert sol.ys[0, 2] == 7
    assert sol.resets.indices[:2].tolist() == [0, 1]
    assert sol.resets.times[0] == sol.resets.times[1]


def grow(resets, **kwargs):
    """Solve with `y[0] = exp(t)` up to rounding, and `y[1]` constant but for jumps."""
    return mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: y * jnp.array([1.0, 0.0])),
        dfx.Dopri8(),
        0.0,
        1.0,
        0.02,
        jnp.array([1.0, 0.0]),
        resets=resets,
        **kwargs,
    )


@pytest.mark.parametrize("time", [0.5, 0.7, 0.3000000000000001])
def test_a_known_time_at_which_a_condition_crosses(time):
    """The first in `resets` comes first, here, too, and the event has no derivative."""
    # The rounding of `y[0]` puts its crossing a little before or after the known time.
    crossing = mj.Reset(
        lambda t, y, args: y[0] - jnp.exp(time), lambda t, y, args: y.at[1].set(10 * y[1] + 1)
    )
    known = mj.ResetAt([time], lambda t, y, args: y.at[1].set(10 * y[1] + 2))
    away = mj.ResetAt([time], lambda t, y, args: y.at[:].set(jnp.array([0.1, 7.0])))

    for resets, digits in ((known, crossing), 21), ((crossing, known), 12):
        sol = grow(resets)
        assert sol.ys[0, 1] == digits
        assert sol.resets.number == 2
        np.testing.assert_array_equal(sol.resets.times[:2], [time] * 2)
        assert sol.stats["num_nondifferentiable_resets"] > 0
    sol = grow((away, crossing))  # from where the condition does not cross again
    assert sol.ys[0, 1] == 7
    assert sol.resets.number == 1


@pytest.mark.parametrize("direction", [None, True])
@pytest.mark.parametrize("known_first", [True, False])
def test_crossings_close_to_a_known_time(known_first, direction):
    """Each happens once, closely before or after it; also Boolean ones of the state, which may still be false where
    a step ends that meets them."""
    offsets = jnp.array([-1e-7, -1e-10, -1e-13, 0.0, 1e-14, 1e-13, 1e-12, 1e-10, 1e-7])
    log = lambda k: lambda t, y, args: y.at[1].set(10 * y[1] + k)

    def solve(offset, boolean):
        at = jnp.exp(0.7) * (1 + offset)
        above = lambda t, y, args: y[0] >= at if boolean else y[0] - at
        resets = mj.Reset(above, log(1.0), direction=direction), mj.ResetAt([0.7], log(2.0))
        return grow(resets[::-1] if known_first else resets, max_steps=200)

    for boolean in (False, True):
        sols = jax.jit(jax.vmap(lambda c, boolean=boolean: solve(c, boolean)))(offsets)
        digits = sols.ys[:, -1, 1]
        assert sols.resets.number.tolist() == [2] * len(offsets)
        assert digits[:2].tolist() == [12, 12]
        assert digits[-2:].tolist() == [21, 21]


def test_zero_without_slope_at_a_known_time():
    """A condition that only touches zero there happens once."""
    add = lambda x: lambda t, y, args: y + x
    touching = mj.Reset(lambda t, y, args: (t - 0.7) ** 2, add(100.0))
    for resets in (touching, mj.ResetAt([0.7], add(1.0))), (mj.ResetAt([0.7], add(1.0)), touching):
        sol = mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: jnp.zeros_like(y)),
            dfx.Dopri8(),
            0.0,
            1.0,
            0.02,
            jnp.zeros(1),
            resets=resets,
        )
        assert sol.ys[0, 0] == 101


def test_an_event_at_the_start():
    """On the surface and moving across it: at once. On its other side: not at all."""
    falling = BALL.at[2].set(0.0).at[3].set(-1.0)
    sol = drop(falling, 0.1)
    np.testing.assert_allclose(sol.resets.times[:2], [0.0, np.inf])
    np.testing.assert_allclose(sol.ys[0], [0.8 * 0.1 - 5 * 0.01, 0.8 - 1.0], atol=1e-12)
    rising = drop(falling.at[3].set(1.0), 0.1)
    assert rising.resets.number == 0
    below = drop(falling.at[2].set(-1.0), 0.1)
    assert below.resets.number == 0


def test_backwards_in_time():
    there = drop(BALL, 3.0).ys[0]
    back = mj.Reset(lambda t, y, args: y[0], lambda t, y, args: jnp.stack([y[0], -y[1] / args[1]]))
    sol = mj.diffeqsolve(
        FALL,
        dfx.Tsit5(),
        3.0,
        0.0,
        -0.1,
        there,
        BALL[:2],
        resets=(back,),
        stepsize_controller=PID,
    )
    np.testing.assert_allclose(sol.ys[0], BALL[2:], atol=1e-11)
    np.testing.assert_allclose(sol.resets.times[:2], bounce_times(BALL, 2)[::-1], rtol=1e-13)


def test_zeno():
    """Bounces without end become a result code, however short they become beside a step, and so does a
    ball that lies on the floor."""
    for p in (BALL, BALL.at[1].set(0.4), BALL.at[2:].set(0.0)):
        sol = drop(p, 12.0, throw=False, max_resets=200)
        assert sol.result == dfx.RESULTS.max_steps_reached
        assert sol.resets.number == 200
        assert jnp.min(sol.resets.before[:, 0]) > -1e-10
    random = np.random.default_rng(0)
    for p in jnp.asarray(random.uniform([5, 0.2, 0.5, -3], [15, 0.8, 6, 3], (20, 4))):
        sol = drop(p, 12.0, throw=False, max_resets=400)
        assert sol.resets.number == 400
        assert jnp.min(sol.resets.before[:, 0]) > -1e-10
    with pytest.raises(Exception, match="more events than `max_resets`"):
        drop(BALL, 12.0)


def test_grazing_is_told():
    """At a zero that is only just reached the time of the event has no derivative."""
    field = dfx.ODETerm(lambda t, y, args: jnp.stack([2 * (t - 1.0), jnp.ones_like(t)]))
    touch = mj.Reset(lambda t, y, args: y[0] - args, lambda t, y, args: y)
    solve = lambda level: mj.diffeqsolve(
        field, dfx.Tsit5(), 0.0, 2.0, 0.25, jnp.array([1.0, 0.0]), level, resets=(touch,)
    )
    assert solve(1e-10).stats["num_nondifferentiable_resets"] >= 1
    assert solve(0.5).stats["num_nondifferentiable_resets"] == 0
    assert solve(-0.1).resets.number == 0


def test_boolean_conditions():
    """Met to rounding; their time has no derivative unless it is a function of time alone."""
    below = mj.Reset(lambda t, y, args: y[0] < 0, bounced)
    solve = lambda p: drop(p, 3.0, resets=(below,))
    np.testing.assert_allclose(solve(BALL).ys, drop(BALL, 3.0).ys, atol=1e-10)
    with pytest.raises(Exception, match="has no derivative"):
        jax.grad(lambda p: solve(p).ys[0, 0])(BALL)
    with pytest.raises(Exception, match="true at `t0`"):
        solve(BALL.at[2].set(-1.0))
    late = mj.Reset(lambda t, y, args: t > 0.5, lambda t, y, args: y + 1.0)
    end = lambda p: drop(p, 0.7, resets=(late,)).ys[0, 0]
    np.testing.assert_allclose(jax.grad(end)(BALL), [-0.245, 0, 1, 0.7], atol=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_ball_comes_to_rest_on_a_moving_table(dtype):
    """Its last hops are smaller than the rounding of its height above the table, which it must not fall
    through: the solve ends with too many resets. Restitution, height of the table, and its motion."""
    table = lambda t, p: p[1] + p[2] * jnp.sin(p[3] * t)
    speed = lambda t, p: p[2] * p[3] * jnp.cos(p[3] * t)
    bounce = lambda t, y, p: jnp.stack([y[0], (1 + p[0]) * speed(t, p) - p[0] * y[1]])
    contact = mj.Reset(lambda t, y, p: y[0] - table(t, p), bounce, direction=False)
    fall = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], 0.2 * jnp.sin(5 * t) - 9.81]))
    tolerance = 1e-9 if dtype == jnp.float64 else 1e-5
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    given = dict(stepsize_controller=controller, resets=(contact,), max_resets=200, throw=False)
    ends = jnp.array([0.0, 2.5], dtype)

    @jax.jit
    @jax.vmap
    def rest(p):
        y0 = jnp.stack([p[1] + 1.0, 0 * p[1]])
        sol = mj.diffeqsolve(fall, dfx.Tsit5(), *ends, None, y0, p, **given)
        return sol.ys[0, 0] - table(sol.ts[0], p), sol.result == dfx.RESULTS.max_steps_reached

    heights, slopes = [0.0, 3.0, 100.0], [0.05, 0.3]
    cases = [(e, z, a, 2.5) for e in (0.1, 0.25, 0.5) for z in heights for a in slopes]
    cases += [(e, z, a, 3.3) for e in (0.3, 0.5, 0.66) for z in heights[:2] for a in (0.06, 0.2)]
    gap, stopped = rest(jnp.array(cases, dtype))
    assert gap.dtype == dtype
    assert stopped.all()
    np.testing.assert_allclose(gap, 0, atol=1e-12 if dtype == jnp.float64 else 1e-4)


def test_third_derivative_of_the_time_of_an_event():
    """That of log(2) / a, when a decay has reached one half."""
    half = mj.Reset(lambda t, y, a: y - 0.5, lambda t, y, a: y + 0.5, direction=False)
    given = dict(stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10), resets=(half,))
    decay = dfx.ODETerm(lambda t, y, a: -a * y)

    def time(a):
        sol = mj.diffeqsolve(
            decay,
            dfx.Dopri8(),
            0.0,
            1.0,
            0.1,
            jnp.array(1.0),
            a,
            adjoint=dfx.ForwardMode(),
            **given,
        )
        return sol.resets.times[0]

    third = jax.jit(jax.jacfwd(jax.jacfwd(jax.jacfwd(time))))(1.3)
    np.testing.assert_allclose(third, -6 * np.log(2) / 1.3**4, rtol=1e-8)


@pytest.mark.parametrize("boolean", [False, True])
def test_an_event_whose_sign_a_jump_changes_back(boolean):
    """Falling faster than 3 ends the solve, on the way to a bounce after which the ball rises. A real
    function has its time and derivative, a Boolean one the end of the step, before the bounce."""
    speed = lambda t, y, args, **kwargs: y[1] < -3.0 if boolean else y[1] + 3.0
    finder = None if boolean else optx.Newton(1e-12, 1e-12)

    def stop(p):
        sol = drop(p, event=dfx.Event(speed, finder, None if boolean else False))
        return sol.ts[0], sol

    if boolean:
        _, sol = stop(BALL)
        np.testing.assert_allclose(sol.ts[0], bounce_times(BALL, 1)[0], rtol=1e-13)
        assert sol.ys[0, 1] < -3
    else:
        (time, sol), slopes = eqx.filter_jit(jax.value_and_grad(stop, has_aux=True))(BALL)
        exact = lambda p: (3 + p[3]) / p[0]
        np.testing.assert_allclose(time, exact(BALL), rtol=1e-12)
        np.testing.assert_allclose(sol.ys[0, 1], -3, rtol=1e-12)
        np.testing.assert_allclose(slopes, jax.grad(exact)(BALL), rtol=1e-9, atol=1e-12)
    assert sol.result == dfx.RESULTS.event_occurred
    assert int(sol.resets.number) == 0


def test_a_steady_state_ends_a_solve_with_resets():
    """Event functions are given the controller of the user, whose tolerances this one asks for."""
    dose = mj.ResetAt([1.0, 2.0], lambda t, y, args: y + 1.0)
    event, given = (
        dfx.Event(dfx.steady_state_event()),
        dict(stepsize_controller=PID, resets=(dose,)),
    )
    decay, y0 = dfx.ODETerm(lambda t, y, args: -y), jnp.ones(1)
    sol = mj.diffeqsolve(decay, dfx.Tsit5(), 0.0, 100.0, None, y0, event=event, **given)
    assert sol.result == dfx.RESULTS.event_occurred
    assert int(sol.resets.number) == 2


def test_an_event_ends_a_solve_with_resets():
    """Between two bounces, with its derivative through the bounce before it; and at a bounce, if the
    jump changes its sign."""

    def stop(p, direction):
        event = dfx.Event(
            lambda t, y, args, **kwargs: y[1] - 2.0, optx.Newton(1e-12, 1e-12), direction
        )
        sol = drop(p, event=event)
        return sol.ts[0], (sol.ts[0], sol.ys[0], sol.result)

    exact = lambda p: (
        bounce_times(p, 1)[0] + (p[1] * jnp.sqrt(p[3] ** 2 + 2 * p[0] * p[2]) - 2) / p[0]
    )
    ends = lambda p: stop(p, False)
    derivatives = [jax.jit(mode(ends, has_aux=True)) for mode in (jax.jacfwd, jax.jacrev)]
    (forward, (time, y, result)), (reverse, _) = (derivative(BALL) for derivative in derivatives)
    assert result == dfx.RESULTS.event_occurred
    np.testing.assert_allclose(time, exact(BALL), rtol=1e-12)
    np.testing.assert_allclose(y[1], 2.0, rtol=1e-12)
    for of_time in (forward, reverse):
        np.testing.assert_allclose(of_time, jax.grad(exact)(BALL), rtol=1e-9)
    _, (time, y, result) = stop(BALL, True)
    assert result == dfx.RESULTS.event_occurred
    np.testing.assert_allclose(time, bounce_times(BALL, 1)[0], rtol=1e-13)
    np.testing.assert_allclose(y, [0.0, 0.8 * np.sqrt(100.01)], atol=1e-9)


def test_algebraic_states_follow_from_the_state_after_a_jump():
    """An index-1 system `x' = -z, 0 = z - k x`: the jump names `x`, and `z` is solved for again."""
    term = mj.MassMatrixTerm(
        lambda t, y, k: jnp.stack([-y[1], y[1] - k * y[0]]), jnp.array([1.0, 0.0])
    )
    refill = mj.Reset(
        lambda t, y, k: y[0] - 0.5, lambda t, y, k: jnp.stack([y[0] + 1.0, y[1]]), direction=False
    )

    def solve(k):
        y0 = jnp.stack([jnp.ones_like(k), k])
        sol = mj.diffeqsolve(
            term, mj.Rodas5P(), 0.0, 1.0, None, y0, k, resets=(refill,), stepsize_controller=PID
        )
        return sol.ys[0], (sol.ys[0], sol.resets)

    def exact(k):  # from 1 to 0.5, then from 1.5
        x = 1.5 * jnp.exp(-k * (1.0 - jnp.log(2.0) / k))
        return jnp.stack([x, k * x])

    k = jnp.array(1.3)
    modes = jax.jacfwd, jax.jacrev
    found = [jax.jit(mode(solve, has_aux=True))(k) for mode in modes]
    _, (y, resets) = found[0]
    np.testing.assert_allclose(resets.after[0], [1.5, 1.5 * 1.3], rtol=1e-9)
    np.testing.assert_allclose(y, exact(k), rtol=1e-8)
    for slope, _ in found:
        np.testing.assert_allclose(slope, jax.jacfwd(exact)(k), rtol=1e-6)


def test_a_limited_number_and_clipped_steps():
    """A reset that can happen twice, beside step size controllers that clip steps."""
    twice = mj.Reset(lambda t, y, args: y[0], bounced, direction=False, max_number=2)
    controller = dfx.ClipStepSizeController(PID, step_ts=[1.5], jump_ts=[2.0])
    sol = drop(
        BALL,
        4.5,
        resets=(twice,),
        stepsize_controller=controller,
        saveat=dfx.SaveAt(steps=True, t1=True),
        max_steps=200,
    )
    assert sol.resets.number == 2
    assert (sol.ts == 1.5).any()
    since = 4.5 - bounce_times(BALL, 2)[1]
    falls = 0.64 * np.sqrt(100.01) * since - 5 * since**2
    end = sol.ys[int(sol.stats["num_accepted_steps"]) - 1]
    np.testing.assert_allclose(end[0], falls, atol=1e-9)
    assert falls < 0  # through the floor


def test_single_precision():
    with jax.enable_x64(False):
        p = jnp.array(BALL, jnp.float32)

        def end(p):
            sol = drop(p, 3.0, stepsize_controller=PID32)
            return sol.ys[0, 0], sol

        gradient, sol = jax.jit(jax.grad(end, has_aux=True))(p)
        assert sol.ys.dtype == sol.resets.times.dtype == jnp.float32
        assert sol.resets.number == 2
        np.testing.assert_allclose(sol.resets.times[:2], bounce_times(p, 2), rtol=1e-5)
    np.testing.assert_allclose(gradient, jax.grad(height)(BALL, 3.0, 2), rtol=1e-3)


PID32 = dfx.PIDController(rtol=1e-4, atol=1e-4)


def solve_decay(resets, **options):
    term = dfx.ODETerm(lambda t, y, args: -y)
    y0 = jnp.ones(2)
    return mj.diffeqsolve(term, dfx.Tsit5(), 0.0, 1.0, 0.1, y0, resets=resets, **options)


CONDITION = lambda t, y, args: y[0] - 0.5


@pytest.mark.parametrize(
    ("resets", "error", "message"),
    [
        (lambda: mj.Reset(CONDITION, 1.0), TypeError, "`jump` must be a callable"),
        (lambda: mj.Reset(1.0, lambda t, y, args: y), TypeError, "`condition` must be a callable"),
        (lambda: mj.Reset(CONDITION, lambda y: y), TypeError, "`jump` must be a callable"),
        (lambda: mj.Reset(CONDITION, bounced, direction=2), ValueError, "`direction` must be"),
        (lambda: mj.Reset(CONDITION, bounced, samples=0), ValueError, "`samples` must be"),
        (lambda: mj.Reset(CONDITION, bounced, max_number=0), ValueError, "`max_number` must be"),
        (lambda: mj.ResetAt("noon", bounced), TypeError, "`times` must be a vector"),
        (lambda: mj.ResetAt(jnp.ones((2, 2)), bounced), TypeError, "`times` must be a vector"),
        (lambda: mj.ResetAt([1.0, np.nan], bounced), ValueError, "`times` has NaN"),
        (lambda: solve_decay(5), TypeError, "`resets` must be a tuple"),
        (lambda: solve_decay((bounced,)), TypeError, "one with a function"),
        (
            lambda: solve_decay((mj.Reset(CONDITION, bounced),), max_resets=0),
            ValueError,
            "`max_resets` must be a positive integer",
        ),
        (
            lambda: solve_decay((mj.Reset(CONDITION, lambda t, y, args: y[0]),)),
            ValueError,
            r"`resets\[0\].jump` must return a state like `y0`",
        ),
        (
            lambda: solve_decay((mj.Reset(CONDITION, lambda t, y, args: y.astype(complex)),)),
            TypeError,
            "must return a state like `y0`, of dtype float64",
        ),
        (
            lambda: solve_decay((mj.Reset(lambda t, y, args: y, lambda t, y, args: y),)),
            ValueError,
            "must return one real number",
        ),
        (
            lambda: solve_decay(
                (mj.Reset(CONDITION, lambda t, y, args: y),), controller_state=(1.0,)
            ),
            ValueError,
            "`controller_state`",
        ),
    ],
)
def test_bad_input(resets, error, message, as_a_user_meets_it):
    with pytest.raises(error, match=message):
        resets()


def test_failures_have_a_code_and_a_message():
    undefined = mj.Reset(lambda t, y, args: jnp.sqrt(y[0] - 0.5), lambda t, y, args: y)
    missing = mj.Reset(CONDITION, lambda t, y, args: y * jnp.nan)
    nowhere = mj.Reset(HIT.condition, lambda t, y, args: 0 * y)
    codes = dfx.RESULTS.nonfinite_input, dfx.RESULTS.nonlinear_divergence
    messages = "`event` or `resets`", "`jump` in `resets` returned is not finite"
    for reset, code, message in zip((undefined, missing), codes, messages, strict=True):
        assert solve_decay((reset,), throw=False).result == code
        with pytest.raises(Exception, match=message):
            solve_decay((reset,))
    sol = swing(P, SOLVERS["projected"], resets=(nowhere,), throw=False)
    assert sol.result == dfx.RESULTS.nonlinear_divergence
    with pytest.raises(Exception, match="could not be moved onto the manifold"):
        swing(P, SOLVERS["projected"], resets=(nowhere,))


@pytest.mark.parametrize("event", [None, dfx.Event(lambda t, y, args, **kwargs: y[0] - 0.1)])
def test_a_known_time_that_is_nan(event):
    """The solve fails before its first step, alone in a batch; infinity is a jump that is not made."""
    jump = lambda t, y, args: y + 1.0

    def solve(times, throw=False):  # an array that is traced, or a function
        reset = mj.ResetAt(times if event is None else lambda args: args, jump)
        return solve_decay((reset,), args=times, event=event, throw=throw, stepsize_controller=PID)

    def end(times):
        sol = solve(times)
        return sol.ys[-1, 0], sol

    times = jnp.array([[0.5, jnp.inf], [jnp.nan, 0.5], [0.5, 0.75]])
    slopes, sols = jax.jit(jax.vmap(jax.grad(end, has_aux=True)))(times)
    failed = sols.result == dfx.RESULTS.nonfinite_input
    assert failed.tolist() == [False, True, False]
    assert (failed == ~jax.vmap(dfx.is_okay)(sols.result)).all()
    assert sols.resets.number.tolist() == [1, 0, 2]
    assert sols.stats["num_steps"][1] == 0
    left = jnp.where(jnp.isinf(times), 0.0, jnp.exp(times - 1.0))
    np.testing.assert_allclose(slopes[::2], left[::2], rtol=1e-7)
    np.testing.assert_allclose(sols.ys[::2, -1, 0], jnp.exp(-1.0) + left[::2].sum(1), rtol=1e-7)
    with pytest.raises(Exception, match="`times` of an `mj.ResetAt` .* write infinity"):
        eqx.filter_jit(solve)(times[1], throw=True)


def test_the_derivative_by_known_times_that_coincide():
    """Exists for both together, with jumps of one reset or of two, and is not counted as missing."""
    one = lambda t, y, args: y**2 + 0.3 * t
    two = lambda t, y, args: 2.0 * y + 1.0
    within = (mj.ResetAt(lambda a: jnp.stack([a, a]), one),)
    across = tuple(mj.ResetAt(lambda a: a[None], jump) for jump in (one, two))
    for resets, after in ((within, one), (across, two)):

        def end(a, resets=resets):
            sol = solve_decay(resets, args=a, stepsize_controller=PID)
            return sol.ys[-1, 0], sol

        def exact(a, after=after):
            return after(a, one(a, jnp.exp(-a), None), None) * jnp.exp(a - 1.0)

        a = jnp.array(0.4)
        (value, sol), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(a)
        assert sol.resets.number == 2
        assert sol.stats["num_nondifferentiable_resets"] == 0
        np.testing.assert_allclose(value, exact(a), rtol=1e-7)
        np.testing.assert_allclose(slope, jax.grad(exact)(a), rtol=1e-7)


def test_an_event_that_a_jump_causes():
    """Its time, which is that of the jump, and the states have the derivatives of the closed form."""
    first = mj.Reset(
        lambda t, y, p: y[0] - p,
        lambda t, y, p: jnp.stack([y[0], 1.0 + 0.3 * p * y[0]]),
        direction=True,
    )
    second = mj.Reset(
        lambda t, y, p: y[1] + 0.1 * y[0],
        lambda t, y, p: jnp.stack([2.0 * y[0] + 3.0 * t, y[1] + y[0]]),
        direction=True,
    )

    def solve(p):
        sol = mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, p: jnp.stack([jnp.ones(()), 0.2 * y[0]])),
            dfx.Tsit5(),
            0.0,
            2.0,
            0.1,
            jnp.array([0.0, -1.0]),
            p,
            stepsize_controller=PID,
            resets=(first, second),
            max_resets=5,
        )
        found = sol.ys[0], sol.resets.times[1]
        return found, (*found, sol.resets.number)

    def exact(p):
        """Both at the time `p`; then x = 5 p + (t - p), and y grows by its integral."""
        x = 5.0 * p
        left = 2.0 - p
        y = 1.0 + 0.3 * p * p + p + 0.2 * (x * left + left**2 / 2)
        return jnp.stack([x + left, y]), p

    p = jnp.array(1.1)
    for mode in (jax.jacfwd, jax.jacrev):
        slopes, (state, time, number) = jax.jit(mode(solve, has_aux=True))(p)
        assert number == 2
        for ours, slope in zip(slopes, jax.jacfwd(exact)(p), strict=True):
            np.testing.assert_allclose(ours, slope, rtol=1e-11)
    np.testing.assert_allclose(state, exact(p)[0], rtol=1e-12)
    np.testing.assert_allclose(time, p, rtol=1e-14)


def test_gradient_of_a_value_saved_at_the_time_of_a_jump():
    """At the start and inside, the value saved is the one after the jump, with its derivative."""
    jump = mj.ResetAt([0.0, 1.0], lambda t, y, args: 3.0 * y + 1.0)

    def saved(y0):
        sol = mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -y),
            dfx.Tsit5(),
            0.0,
            2.0,
            0.1,
            y0,
            saveat=dfx.SaveAt(t0=True, ts=jnp.array([0.0, 0.5, 1.0, 1.5, 2.0])),
            stepsize_controller=PID,
            resets=(jump,),
        )
        return sol.ys

    decay = jnp.exp(-jnp.array([0.0, 0.5, 0.0, 0.5, 1.0]))
    slope = jnp.concatenate(
        [jnp.ones(1), jnp.array([3, 3, 9 / jnp.e, 9 / jnp.e, 9 / jnp.e]) * decay]
    )
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(saved))(jnp.ones(())), slope, rtol=1e-8)


def test_each_of_many_events_at_one_time_happens_once():
    """Whether it is the time that they have in common or a jump that causes them; one that another
    jump undoes does not happen."""
    log = lambda k: lambda t, y, args: y.at[1].set(10 * y[1] + k)
    field = dfx.ODETerm(lambda t, y, args: jnp.array([1.0, 0.0, 0.0]))
    solve = lambda resets: mj.diffeqsolve(
        field, dfx.Tsit5(), 0.0, 1.0, 0.3, jnp.zeros(3), resets=resets
    )
    at_half = [
        mj.Reset(lambda t, y, args: t - 0.5, log(float(k)), direction=True) for k in range(1, 6)
    ]
    sol = solve(tuple(at_half))
    assert sol.ys[0, 1] == 12345
    assert sol.resets.number == 5
    sets = mj.Reset(lambda t, y, args: y[0] - 0.5, lambda t, y, args: y.at[2].set(1.0))
    follow = [
        mj.Reset(lambda t, y, args, k=k: y[2] - 0.1 * k, log(float(k)), direction=True)
        for k in (1, 2, 3)
    ]
    sol = solve((follow[0], sets, *follow[1:]))
    assert sol.resets.indices[:5].tolist() == [1, 0, 2, 3, -1]
    assert sol.ys[0, 1] == 123
    undoes = mj.Reset(
        lambda t, y, args: y[2] - 0.15, lambda t, y, args: y.at[2].set(0.0), direction=True
    )
    sol = solve((sets, undoes, *follow))
    assert sol.resets.indices[:3].tolist() == [0, 1, -1]


def test_an_event_at_which_no_step_ends():
    """A field with noise, so that every attempt to end a step at the event ends next to it."""
    noisy = lambda t, y, args: jnp.stack([-1.0 + 1e-6 * jnp.sin(1e13 * t)])
    up = mj.Reset(lambda t, y, args: y[0], lambda t, y, args: y + 1.0, direction=False)
    sol = mj.diffeqsolve(
        dfx.ODETerm(noisy),
        dfx.Tsit5(),
        0.0,
        3.3,
        0.5,
        jnp.array([0.7]),
        resets=(up,),
        max_resets=10,
    )
    assert sol.resets.number == 3
    np.testing.assert_allclose(sol.resets.times[:3], [0.7, 1.7, 2.7], atol=1e-5)
    np.testing.assert_allclose(sol.resets.before[:3, 0], 0, atol=1e-5)
    assert sol.stats["num_steps"] < 80


def test_real_and_boolean_conditions_that_change_at_one_time():
    """A step of one unit of rounding lies between them; in it no real condition leaves zero."""
    thresholds = -1.2, -0.5, 0.0, 0.0, 0.0
    count = lambda k: lambda t, y, args: y.at[k + 1].add(1)
    real = [
        mj.Reset(lambda t, y, args, at=at: y[0] - at, count(k), direction=True)
        for k, at in enumerate(thresholds)
    ]
    boolean = [mj.Reset(lambda t, y, args: y[0] > 0, count(k)) for k in (5, 6)]
    sol = mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.zeros(8).at[0].set(1)),
        dfx.Tsit5(),
        0.0,
        10.0,
        0.1,
        jnp.zeros(8).at[0].set(-5.3),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-10),
        resets=(*real, *boolean),
        max_resets=30,
    )
    assert sol.resets.indices[:8].tolist() == [0, 1, 2, 3, 4, 5, 6, -1]
    assert sol.ys[0, 1:].tolist() == [1] * 7
