"""The Radau IIA method: orders, published solutions, derivatives, masses, and failed stages."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from diffrax import RESULTS
from test_rosenbrock import (
    constant_mass,
    constant_singular,
    curved,
    forced,
    FORCED_START,
    path,
    pendulum,
    PENDULUM_MASS,
    ROD,
    terms_of,
    varying_mass,
    varying_singular,
)

import manifold_jax as mj
from benchmarks.tools.stiff_problems import PROBLEMS


RADAU = mj.RadauIIA5()
TOLERANCES = dfx.VeryChord(rtol=1e-8, atol=1e-8, norm=optx.rms_norm)


# --- orders ---------------------------------------------------------------------------------------


def test_orders_of_one_step():
    """The state, the embedded solution and the dense output, each from the exact state."""
    solver = mj.RadauIIA5(root_finder=TOLERANCES)
    terms, exact, starts = (
        dfx.ODETerm(forced),
        path(forced, FORCED_START, 1.0),
        np.linspace(0, 0.7, 7),
    )

    @jax.jit
    @jax.vmap
    def step(t0, y0, h):
        state = solver.init(terms, t0, t0 + h, y0, None)
        y1, error, info, _, _ = solver.step(terms, t0, t0 + h, y0, None, state, False)
        interpolation = solver.interpolation_cls(t0=t0, t1=t0 + h, **info)
        return jnp.stack([y1, y1 - error, interpolation.evaluate(t0 + 0.2 * h)])

    def errors(h):
        values = step(starts, exact(starts).T, np.full(7, h))
        ends = np.stack([exact(starts + c * h).T for c in (1, 1, 0.2)], axis=1)
        return np.linalg.norm(values - ends, axis=(0, 2))

    orders = np.log2(errors(0.1) / errors(0.05))
    np.testing.assert_allclose(orders, [6, 4, 4], rtol=0, atol=0.2)


@pytest.mark.parametrize(
    "case", [varying_singular, pytest.param(constant_singular, marks=pytest.mark.slow)]
)
def test_orders_and_direction(case):
    """Of DAEs of index 1, also with a mass matrix that depends on the state and on the true time; and back to
    where it came from."""
    terms, y0, end = case(0.9)

    @jax.jit
    def solve(t0, t1, dt, y):
        sol = mj.diffeqsolve(terms, RADAU, t0, t1, dt, y, throw=False)
        return sol.ys[0], sol.result == RESULTS.successful

    errors = []
    for n in (8, 16):
        y1, success = solve(0.0, 0.9, 0.9 / n, jnp.asarray(y0))
        assert success
        errors.append(np.linalg.norm(y1 - end))
    assert errors[-1] > 1e-13
    assert abs(np.log2(errors[0] / errors[1]) - 5) <= 0.2, errors
    back, success = solve(0.9, 0.0, -0.9 / 16, jnp.asarray(end))
    assert success
    np.testing.assert_allclose(back, y0, rtol=0, atol=1e-9)


def test_order_of_fast_components():
    """The reduction that the docstring states, and that it is divided by the stiffness."""
    follow = lambda t, y, rate: -rate * (y - jnp.sin(t)) + jnp.cos(t)

    @jax.jit
    def error(n, rate):
        y0, saveat = jnp.sin(jnp.zeros(1)), dfx.SaveAt(steps=True)
        options = dict(args=rate, saveat=saveat, max_steps=64, throw=False)
        sol = mj.diffeqsolve(dfx.ODETerm(follow), RADAU, 0.0, 2.0, 2 / n, y0, **options)
        error = jnp.abs(sol.ys[:, 0] - jnp.sin(sol.ts))
        return jnp.max(jnp.where(jnp.isfinite(sol.ts), error, 0))

    assert abs(np.log2(error(8.0, 1e6) / error(16.0, 1e6)) - 3) <= 0.2
    assert abs(error(8.0, 1e5) / error(8.0, 1e6) - 10) <= 1


# --- published solutions --------------------------------------------------------------------------


def digits(problem, tolerance=1.0, **options):
    """Of the worst component, and the number of steps."""
    controller = dfx.PIDController(rtol=problem.rtol * tolerance, atol=problem.atol * tolerance)
    options = dict(stepsize_controller=controller, throw=False, **options)
    solve = lambda y0: mj.diffeqsolve(
        terms_of(problem), RADAU, 0.0, problem.t1, None, y0, problem.args, **options
    )
    sol = jax.jit(solve)(jnp.asarray(problem.y0))
    assert sol.result == RESULTS.successful
    found = -np.log10(np.max(np.abs(sol.ys[0] / problem.end - 1)))
    return found, sol.stats["num_steps"]


@pytest.mark.parametrize(
    ("problem", "tolerance", "least", "most_steps"),
    [
        ("Robertson, DAE", 1.0, 7.0, 1350),
        pytest.param("chemical Akzo Nobel", 1.0, 9.0, 200, marks=pytest.mark.slow),
        pytest.param("transistor amplifier", 1e3, 5.5, 1100, marks=pytest.mark.slow),
    ],
)
def test_published_solutions(problem, tolerance, least, most_steps):
    found, steps = digits(PROBLEMS[problem], tolerance)
    assert found > least
    assert steps < most_steps


# --- derivatives ----------------------------------------------------------------------------------


PARAMETERS = jnp.array([1.0, 0.9, 1.3, 0.8])  # the last is the start


def problem_of(parameters, mass):
    *args, x0 = parameters
    return mj.MassMatrixTerm(curved, mass(args)), {"x": x0[None], "w": jnp.array(0.6)}, args


def test_derivatives_of_a_step():
    """First and second ones, with differences. The start need not be consistent here."""
    solver = mj.RadauIIA5(checks_start=False, root_finder=TOLERANCES)

    def after(parameters):
        term, y, args = problem_of(parameters, varying_mass)
        state = solver.init(term, 0.0, 0.2, y, args)
        y, _, info, _, _ = solver.step(term, 0.0, 0.2, y, args, state, False)
        return y["x"][0] + 2 * y["w"] + info["k"][1]["w"]

    def derivatives(p):
        forward = jax.jvp(after, (p,), (jnp.cos(p),))[1]
        return after(p), jax.grad(after)(p), jax.jacrev(jax.grad(after))(p), forward

    at = jax.jit(derivatives)
    _, first, second, forward = at(PARAMETERS)
    np.testing.assert_allclose(forward, first @ jnp.cos(PARAMETERS), rtol=1e-12)
    sides = [[at(PARAMETERS + s * step) for s in (1, -1)] for step in 1e-5 * jnp.eye(4)]
    differences = [
        jnp.stack([(plus[k] - minus[k]) / 2e-5 for plus, minus in sides]) for k in (0, 1)
    ]
    np.testing.assert_allclose(first, differences[0], rtol=1e-8)
    np.testing.assert_allclose(second, differences[1], rtol=1e-7, atol=1e-9)


def end_of_curved(parameters, adjoint, mass):
    term, y0, args = problem_of(parameters, mass)  # w is made consistent
    sol = mj.diffeqsolve(term, RADAU, 0.0, 1.0, 0.25, y0, args, adjoint=adjoint)
    return sol.ys["x"][0, 0] + 2 * sol.ys["w"][0]


def test_gradients_agree():
    """Of a whole solve."""
    both = jax.jit(jax.value_and_grad(end_of_curved), static_argnums=(1, 2))
    value = lambda p: both(p, mj.StepReplayAdjoint(), constant_mass)
    differences = [
        (value(PARAMETERS + step)[0] - value(PARAMETERS - step)[0]) / 2e-5
        for step in 1e-5 * jnp.eye(4)
    ]
    np.testing.assert_allclose(value(PARAMETERS)[1], jnp.stack(differences), rtol=1e-8)


@pytest.mark.slow
def test_other_modes_agree():
    """Forward mode and the adjoints of Diffrax, and second derivatives of both modes."""
    end = lambda adjoint: lambda p: end_of_curved(p, adjoint, varying_mass)
    reverse, along = jax.grad(end(mj.StepReplayAdjoint())), jnp.ones(4)
    first, second = jax.jit(lambda p: jax.jvp(reverse, (p,), (along,)))(PARAMETERS)
    forward = jax.jit(jax.jacfwd(end(dfx.ForwardMode())))
    np.testing.assert_allclose(first, forward(PARAMETERS), rtol=1e-11)
    sides = forward(PARAMETERS + 1e-5 * along), forward(PARAMETERS - 1e-5 * along)
    np.testing.assert_allclose(second, (sides[0] - sides[1]) / 2e-5, rtol=1e-7)
    for adjoint in (dfx.RecursiveCheckpointAdjoint(), dfx.DirectAdjoint()):
        other = jax.jit(jax.grad(end(adjoint)))(PARAMETERS)
        np.testing.assert_allclose(other, first, rtol=1e-11)


# --- batches, types, directions -------------------------------------------------------------------


def decay(t, y, k):
    """Stiff, with a field that is not a number for negative `k` from t = 1/2 on."""
    a, b = y["a"], y["b"]
    fast = -1e3 * (b - jnp.cos(a)) + jnp.sqrt(jnp.where(t > 0.5, k, jnp.abs(k)))[None]
    return {"a": b - 0.3 * a, "b": fast}


def decayed(k, dtype=jnp.float64):
    y0 = {"a": jnp.array([0.3], dtype), "b": jnp.array([1.0], dtype)}
    tolerance = 1e-7 if dtype == jnp.float64 else 1e-4
    time = lambda t: jnp.asarray(t, dtype)
    return dfx.diffeqsolve(
        dfx.ODETerm(decay),
        RADAU,
        *(time(0.0), time(1.0), time(1e-3)),
        y0,
        k,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        throw=False,
    )


def test_batches():
    """As alone, and a lane whose field stops being a number hurts no other."""
    k = jnp.array([0.5, -1.0, 2.0])
    batch = jax.jit(jax.vmap(decayed))(k)
    single = jax.jit(decayed)
    np.testing.assert_array_equal(batch.result == RESULTS.successful, [True, False, True])
    assert batch.stats["num_steps"][1] < 200  # not until `max_steps`
    for i in (0, 2):
        alone = single(k[i])
        np.testing.assert_allclose(batch.ys["a"][i], alone.ys["a"], rtol=1e-13)
        assert batch.stats["num_steps"][i] == alone.stats["num_steps"]


@pytest.mark.slow
def test_single_precision():
    single = jax.jit(lambda k: decayed(k, dtype=jnp.float32))(jnp.asarray(0.5, jnp.float32))
    double = jax.jit(decayed)(jnp.asarray(0.5))
    assert single.ys["a"].dtype == jnp.float32
    assert single.result == RESULTS.successful
    np.testing.assert_allclose(single.ys["a"], double.ys["a"], rtol=2e-4)


def test_jumps_of_the_field():
    """A solve across a jump is as good as two that end and begin there."""
    mass = lambda t, y, args: jnp.diag(2 + jnp.sin(3 * y))
    tight = dfx.PIDController(rtol=1e-9, atol=1e-9)
    jumping = dfx.ClipStepSizeController(tight, jump_ts=jnp.array([0.5]))
    term = mj.MassMatrixTerm(lambda t, y, push: push[jnp.where(t < 0.5, 0, 1)] - y, mass)

    @jax.jit
    def solve(push, t0, t1, y0):
        return dfx.diffeqsolve(term, RADAU, t0, t1, 0.01, y0, push, stepsize_controller=jumping)

    y0, push = jnp.array([0.1, 0.4]), jnp.array([1.0, 3.0])
    whole, first = solve(push, 0.0, 1.0, y0), solve(push[:1].repeat(2), 0.0, 0.5, y0)
    second = solve(push[1:].repeat(2), 0.5, 1.0, first.ys[0])
    np.testing.assert_allclose(whole.ys[0], second.ys[0], rtol=1e-8)
    steps = first.stats["num_steps"] + second.stats["num_steps"]
    assert whole.stats["num_steps"] < steps + 4


# --- on manifolds, and failures -------------------------------------------------------------------


@pytest.mark.slow
def test_projected_dae_keeps_hidden_constraints():
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.zeros(())

    @jax.jit
    def solve(y0):
        sol = mj.diffeqsolve(
            mj.MassMatrixTerm(pendulum, PENDULUM_MASS),
            mj.Projected(RADAU, ROD),
            0.0,
            2.0,
            None,
            y0,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 9)),
            stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
        )
        return sol.ys

    q, v, multiplier = solve(y0)
    assert np.abs(np.sum(q * q, axis=1) - 1).max() < 2e-15
    assert np.abs(np.sum(q * v, axis=1)).max() < 4e-15
    exact, _ = mj.problems.pendulum().reference(np.linspace(0.0, 2.0, 9))
    np.testing.assert_allclose(q, exact, rtol=0, atol=1e-7)
    # Tension: v^2 / r and the weight along the rod.
    np.testing.assert_allclose(multiplier, np.sum(v * v, 1) - 9.81 * q[:, 1], atol=1e-6)


def test_stages_that_do_not_converge():
    """Van der Pol's oscillator with a first step that is far too long: rejected, or with constant steps the
    end of the solve."""
    field = lambda t, y, args: jnp.stack([y[1], 1e4 * ((1 - y[0] ** 2) * y[1] - y[0])])
    start, terms = jnp.array([2.0, -0.66]), dfx.ODETerm(field)
    controller = dfx.PIDController(rtol=1e-5, atol=1e-5)
    options = dict(stepsize_controller=controller, throw=False)
    solve = jax.jit(lambda dt0: dfx.diffeqsolve(terms, RADAU, 0.0, 0.5, dt0, start, **options))
    sol, short = solve(1e3), solve(1e-6)
    assert sol.result == RESULTS.successful
    assert sol.stats["num_rejected_steps"] > 0
    np.testing.assert_allclose(sol.ys, short.ys, rtol=1e-4)
    solver = mj.RadauIIA5(root_finder=TOLERANCES)
    state = solver.init(terms, 0.0, 1.0, start, None)
    y1, error, _, _, result = solver.step(terms, 0.0, 1.0, start, None, state, False)
    assert result == RESULTS.nonlinear_divergence
    assert np.isinf(error).all()
    np.testing.assert_array_equal(y1, start)


@pytest.mark.parametrize("solver", [RADAU, mj.Rodas5P(), dfx.Kvaerno5()])
def test_zeros_without_an_absolute_tolerance(solver):
    """One component leaves zero, another one stays there, where the error is zero of a tolerance of zero."""
    field = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[0], y[0] - y[1], -y[2]]))
    controller = dfx.PIDController(rtol=1e-6, atol=0)
    options = dict(stepsize_controller=controller, max_steps=32, throw=False)
    sol = mj.diffeqsolve(field, solver, 0.0, 1.0, None, jnp.array([1.0, 0.0, 0.0]), **options)
    np.testing.assert_allclose(sol.ys[0], np.exp(-1) * np.array([1, 1, 0]), rtol=1e-5)
    assert sol.stats["num_rejected_steps"] < 3


def test_controls_are_refused():
    control = dfx.LinearInterpolation(jnp.linspace(0, 1, 3), jnp.linspace(0, 1, 3))
    terms = dfx.ControlTerm(lambda t, y, args: -y, control)
    with pytest.raises(ValueError, match="to_ode"):
        mj.diffeqsolve(terms, RADAU, 0.0, 1.0, 0.1, jnp.array(1.0))
