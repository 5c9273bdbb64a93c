"""Problems of the gallery with switches and a moving stop: known solutions, closed forms, gradients."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import manifold_jax as mj
from manifold_jax.problems.battery import open_circuit_voltage, terminal_voltage


HOOP, RELAY = mj.problems.rotating_hoop(), mj.problems.relay_feedback()
BATTERY = mj.problems.battery()


def at_times(problem, count):
    return dfx.SaveAt(ts=jnp.linspace(0.0, problem.t1, count))


def solve(problem, args=None, **options):
    problem = problem if args is None else problem.with_args(args)
    return mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        0.0,
        problem.t1,
        None,
        problem.y0,
        problem.args,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        resets=problem.resets,
        max_resets=14,
        **options,
    )


def check_known_solution(problem, sol, atol):
    """Also that it is on the manifold."""
    assert sol.stats["num_nondifferentiable_resets"] == 0
    violation = jax.vmap(
        lambda t, y: mj.constraint_violation(problem.constraint, t, y, problem.args)
    )
    assert violation(sol.ts, sol.ys).max() < 1e-15
    exact = problem.reference(np.asarray(sol.ts))
    for ours, known in zip(jax.tree.leaves(sol.ys), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(ours, known, atol=atol)


def check_gradient(problem, end, further=lambda sol, args: jnp.zeros(0)):
    """That of a number at the end, by all parameters, in both modes, is that of differences of the known
    solution. Returns the derivatives of `further` numbers of a solve: rows as in `problem.args`."""
    point, unravel = jax.flatten_util.ravel_pytree(problem.args)

    def numbers(x):
        sol = solve(problem, unravel(x))
        return jnp.append(
            further(sol, unravel(x)), end(jax.tree.map(lambda leaf: leaf[-1], sol.ys))
        )

    forward, reverse = (jax.jit(mode(numbers))(point) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    exact = lambda x: end(problem.with_args(unravel(x)).reference(problem.t1))
    slopes = []
    for i, value in enumerate(point):
        at = lambda s, i=i, value=value: exact(point.at[i].add(s * 1e-4 * value))
        slopes.append((8 * (at(1) - at(-1)) - (at(2) - at(-2))) / 12e-4)
    # By parameters in units of themselves.
    np.testing.assert_allclose(reverse[-1] * point, slopes, rtol=1e-7, atol=1e-7)
    return reverse[:-1]


def speed_at_stop(args, number):
    """The rate of the angle before an impact, by the Jacobi integral, from rest at the angle 0.4."""
    potential = lambda a: (
        -0.5 * (args.rate * jnp.sin(a)) ** 2 - args.gravity / args.radius * jnp.cos(a)
    )
    first = jnp.sqrt(2 * (potential(0.4) - potential(args.stop)))
    return args.restitution**number * first


def rates_before(resets, args):
    """Along the hoop, which has turned by the time."""
    v = resets.before[1][:4]
    turned = args.rate * resets.times[:4]
    outwards = v[:, 0] * jnp.cos(turned) + v[:, 1] * jnp.sin(turned)
    return (outwards * jnp.cos(args.stop) + v[:, 2] * jnp.sin(args.stop)) / args.radius


def test_rotating_hoop():
    """The Jacobi integral is kept between impacts: of each the speed is known. They do not change the
    velocity that the hoop gives to the bead."""
    sol = solve(HOOP, saveat=at_times(HOOP, 9))
    check_known_solution(HOOP, sol, 2e-9)
    args, resets = HOOP.args, sol.resets
    assert resets.number == 5
    expected = [speed_at_stop(args, k) for k in range(4)]
    np.testing.assert_allclose(rates_before(resets, args), expected, rtol=1e-9)

    def jacobi_integral(y):
        q, v = y
        return 0.5 * v @ v + args.gravity * q[2] - args.rate * (q[0] * v[1] - q[1] * v[0])

    before, after = (jax.vmap(jacobi_integral)(x)[:5] for x in (resets.before, resets.after))
    np.testing.assert_allclose(before[0], jacobi_integral(HOOP.y0), rtol=1e-9)
    np.testing.assert_allclose(before[1:], after[:-1], rtol=1e-9)
    q, v, w = resets.before[0][:5], resets.before[1][:5], resets.after[1][:5]
    momentum = lambda v: q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]
    turning = args.rate * (args.radius * jnp.sin(args.stop)) ** 2
    np.testing.assert_allclose(momentum(v), turning, rtol=1e-12)
    np.testing.assert_allclose(momentum(w), turning, rtol=1e-12)


def test_equilibrium_in_the_hoop():
    angle = np.arccos(9.81 / (10.0**2 * 0.2))
    problem = mj.problems.rotating_hoop(angle=angle)
    acceleration = jax.jit(problem.system.accelerations)(0.0, problem.y0, problem.args)
    np.testing.assert_allclose(
        acceleration, [-(10.0**2) * 0.2 * np.sin(angle), 0.0, 0.0], atol=1e-13
    )


@pytest.mark.slow
def test_gradients_of_the_rotating_hoop():
    """Speeds after none to three impacts have those of the closed form."""
    speeds = lambda sol, args: rates_before(sol.resets, args)
    ours = check_gradient(HOOP, lambda y: y[0][0], speeds)
    exact = lambda args: jnp.stack([speed_at_stop(args, k) for k in range(4)])
    np.testing.assert_allclose(
        ours, jnp.stack(jax.jacfwd(exact)(HOOP.args), 1), rtol=1e-7, atol=1e-7
    )


def test_relay_feedback():
    """Half periods tend to that of the limit cycle, by the factor of its stability."""
    sol = solve(RELAY, saveat=at_times(RELAY, 9))
    check_known_solution(RELAY, sol, 2e-9)
    halves = np.diff(sol.resets.times[:11])
    distances = halves - 2 * 0.1 / (0.05 * 1.8)
    assert abs(distances[-1]) < 2e-5
    factor = -(0.05 * 1.8**2 - 0.1) / (0.05 * 1.8**2 + 0.1)
    np.testing.assert_allclose(distances[6:9] / distances[5:8], factor, rtol=2e-3)


def test_limit_cycle_of_the_relay():
    """Astrom's condition C (I + Phi)^-1 Gamma = h holds at half of the period 4 h / (k a), and his matrix
    (I - w C / (C w)) Phi has the factor in the docstring; on the cycle the solution is periodic."""
    a, k, h = 0.05, 1.8, 0.1
    half = 2 * h / (k * a)
    A, B, C = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([0.0, a]), np.array([1.0, k])
    augmented = scipy.linalg.expm(half * np.block([[A, B[:, None]], [np.zeros((1, 3))]]))
    Phi, Gamma = augmented[:2, :2], augmented[:2, 2]
    start = np.linalg.solve(np.eye(2) + Phi, Gamma)
    np.testing.assert_allclose(C @ start, h, rtol=1e-14)
    w = Phi @ (A @ start - B)
    multipliers = np.linalg.eigvals((np.eye(2) - np.outer(w, C) / (C @ w)) @ Phi)
    factor = -(a * k**2 - h) / (a * k**2 + h)
    np.testing.assert_allclose(np.sort(np.abs(multipliers)), [0.0, abs(factor)], atol=1e-12)
    cycle = mj.problems.relay_feedback(angle=start[0], rate=start[1])
    after = cycle.reference(np.array([2 * half + 0.7, 4 * half + 0.7, 0.7]))
    np.testing.assert_allclose(after[0], after[0][[2, 2, 2]], atol=1e-14)
    middle = cycle.reference(half / 2)[0]
    np.testing.assert_allclose(np.arctan2(middle[1], middle[0]), h**2 / (2 * a * k**2), rtol=1e-13)


@pytest.mark.slow
def test_gradients_of_relay_feedback():
    check_gradient(RELAY, lambda y: y[0][1] + y[1][1])


def voltage_under_load(args, t, charge):
    """From a rested start."""
    charge = charge - args.load * t / (3600 * args.capacity)
    decayed = 1.0 - jnp.exp(-t / (args.resistances * args.capacitances))
    drop = args.load * (args.series + jnp.sum(args.resistances * decayed))
    return open_circuit_voltage(jnp, charge) - drop


def test_battery():
    """The time until the cut-off solves one equation. Held voltages are those that are held."""
    sol = solve(BATTERY, saveat=at_times(BATTERY, 91))
    check_known_solution(BATTERY, sol, 1e-8)
    args, resets = BATTERY.args, sol.resets
    assert resets.indices[:5].tolist() == [0, 1, 2, 0, -1]
    np.testing.assert_allclose(
        voltage_under_load(args, resets.times[0], 1.0), args.lower, atol=1e-11
    )
    voltages = jax.vmap(lambda y: terminal_voltage(y, args))
    held = sol.ys.mode == 2.0
    assert np.sum(held) > 10
    np.testing.assert_allclose(voltages(sol.ys)[held], args.upper, rtol=1e-15)
    ends = voltages(jax.tree.map(lambda x: x[:3], resets.before))
    np.testing.assert_allclose(ends, [args.lower, args.upper, args.upper], rtol=1e-14)
    np.testing.assert_allclose(resets.before.current[:3], [-0.85, 0.85, 0.0425], rtol=1e-12)


@pytest.mark.slow
def test_gradients_of_the_battery():
    """At the end through all three kinds of switches; that of the time until the cut-off is that of the
    implicit function."""
    problem = mj.problems.battery(charge=0.35, final=0.4, t1=3300.0)
    assert problem.reference(problem.t1).mode == 0.0
    first = lambda sol, args: sol.resets.times[:1]
    (ours,) = check_gradient(problem, lambda y: y.charge + y.relaxation[1], first)
    args = problem.args
    voltage = lambda t: float(voltage_under_load(args, t, 0.35) - args.lower)
    t = scipy.optimize.brentq(voltage, 0.0, 1000.0, xtol=1e-10)
    rate = jax.grad(voltage_under_load, 1)(args, t, 0.35)
    moved = jax.grad(lambda args: voltage_under_load(args, t, 0.35) - args.lower)(args)
    known = -jax.flatten_util.ravel_pytree(moved)[0] / rate
    np.testing.assert_allclose(ours, known, rtol=1e-7, atol=1e-7)


def test_bad_input():
    with pytest.raises(
        ValueError, match=r"`resistances` must be a scalar or of shape \(2,\), one for"
    ):
        mj.problems.battery(resistances=[0.1, 0.2, 0.3])
    for problem in (HOOP, RELAY, BATTERY):
        with pytest.raises(ValueError, match="not known before the start"):
            problem.reference(-1.0)
