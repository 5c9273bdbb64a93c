"""Rosenbrock methods: orders, published solutions, derivatives, masses, and what is refused."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import RESULTS
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import manifold_jax as mj
from benchmarks.tools.stiff_problems import (
    MECHANISM_START,
    PROBLEMS,
    stiff_mechanism,
    stiff_mechanism_reference,
)
from manifold_jax._rosenbrock import stages


METHODS = {"Rodas5P": mj.Rodas5P(), "Rodas3P": mj.Rodas3P()}
each_method = pytest.mark.parametrize("name", METHODS)


def terms_of(problem):
    field = problem.field(jnp)
    if problem.mass is None:
        return dfx.ODETerm(field)
    return mj.MassMatrixTerm(field, problem.mass)


# --- orders ---------------------------------------------------------------------------------------


@each_method
def test_coefficients_belong_together(name):
    """The table has `a = alpha Gamma^-1` and `C = diag(1/gamma) - Gamma^-1`; `c` and `d` are the sums of
    the rows of alpha and Gamma (Hairer & Wanner, Solving ODEs II, IV.7.25)."""
    tableau = METHODS[name].tableau
    stages_ = len(tableau.c)
    a, C = np.zeros((stages_, stages_)), np.zeros((stages_, stages_))
    for i in range(1, stages_):
        a[i, :i], C[i, :i] = tableau.a_lower[i - 1], tableau.c_lower[i - 1]
    Gamma = np.linalg.inv(np.eye(stages_) / tableau.gamma - C)
    np.testing.assert_allclose((a @ Gamma).sum(axis=1), tableau.c, rtol=0, atol=1e-13)
    np.testing.assert_allclose(Gamma.sum(axis=1), tableau.d, rtol=0, atol=1e-13)


@pytest.mark.parametrize("written_out", [4, 0], ids=["written out", "library"])
def test_rows_are_exchanged(written_out):
    """The equations of the algebraic unknowns are in the other order: zeros on the diagonal."""
    term = mj.MassMatrixTerm(
        lambda t, y, args: jnp.stack([y[1] - y[2], y[0] - 2 * y[2], -y[2]]),
        jnp.diag(jnp.array([0.0, 0.0, 1.0])),
    )
    solver = mj.Rodas3P(largest_written_out=written_out)
    y0 = jnp.array([2.0, 1.0, 1.0])
    y = mj.diffeqsolve(term, solver, 0.0, 1.0, 0.01, y0).ys[-1]
    np.testing.assert_allclose(y, np.exp(-1) * np.array([2, 1, 1]), rtol=1e-7)


def forced(t, y, args):
    a, b = y
    return jnp.stack([-b * a + jnp.cos(t) * b + t**2, a**2 - jnp.sin(t) * b])


FORCED_START = np.array([1.0, 0.5])


def path(field, y0, t1):
    """The exact solution, by SciPy."""
    numbers = jax.jit(lambda t, y: field(t, y, None))
    f = lambda t, y: np.asarray(numbers(t, y))
    sol = solve_ivp(f, (0, t1), y0, method="DOP853", rtol=2.3e-14, atol=1e-15, dense_output=True)
    return sol.sol


@each_method
def test_orders_of_one_step(name):
    """The state, the embedded solution and the dense output, each from the exact state."""
    solver, terms = METHODS[name], dfx.ODETerm(forced)
    exact = path(forced, FORCED_START, 1.0)
    starts = np.linspace(0, 0.8, 7)

    @jax.jit
    @jax.vmap
    def step(t0, y0, h):
        state = solver.init(terms, t0, t0 + h, y0, None)
        y1, error, info, _, _ = solver.step(terms, t0, t0 + h, y0, None, state, False)
        interpolation = solver.interpolation_cls(t0=t0, t1=t0 + h, **info)
        return jnp.stack([y1, y1 - error, interpolation.evaluate(t0 + 0.4 * h)])

    def errors(h):
        values = step(starts, exact(starts).T, np.full(7, h))
        ends = np.stack([exact(starts + c * h).T for c in (1, 1, 0.4)], axis=1)
        return np.linalg.norm(values - ends, axis=(0, 2))

    orders = np.log2(errors(0.05) / errors(0.025))
    expected = [6, 5, 5] if name == "Rodas5P" else [4, 3, 4]
    np.testing.assert_allclose(orders, expected, rtol=0, atol=0.2)


# An equation of index 1: x' + a(t, x, w) w' = f and 0 = g.


def balance(t, x, w):
    return w + 0.2 * w**3 - x + 0.1 * jnp.sin(t)


def index_one(t, y, args):
    x, w = y
    return jnp.stack([-x * w + jnp.cos(t), balance(t, x, w)])


def weight(t, y, args):
    x, w = y
    a = 1 + 0.5 * jnp.sin(x) * w + 0.3 * t
    return jnp.stack([jnp.stack([jnp.ones_like(a), a]), jnp.zeros(2)])


def reduced(a, t1):
    """The start and the end of that equation, with `w(t, x)` put in, by SciPy."""
    root = lambda t, x: brentq(
        lambda w: w + 0.2 * w**3 - x + 0.1 * np.sin(t), -9, 9, xtol=1e-15, rtol=1e-15
    )

    def slope(t, x):
        w = root(t, x[0])
        A = [[1, a(t, x[0], w)], [-1, 1 + 0.6 * w * w]]
        return np.linalg.solve(A, [-x[0] * w + np.cos(t), -0.1 * np.cos(t)])[:1]

    x = solve_ivp(slope, (0, t1), [1.0], method="DOP853", rtol=2.3e-14, atol=1e-15).y[0, -1]
    return np.array([1.0, root(0.0, 1.0)]), np.array([x, root(t1, x)])


MIXED = np.array([[1.0, 0.7], [-0.3, 1.4]])


def constant_singular(t1):
    field = lambda t, y, args: MIXED @ index_one(t, y, args)
    term = mj.MassMatrixTerm(field, MIXED @ np.array([[1, 0.8], [0, 0]]))
    return term, *reduced(lambda t, x, w: 0.8, t1)


def varying_singular(t1):
    a = lambda t, x, w: 1 + 0.5 * np.sin(x) * w + 0.3 * t
    return mj.MassMatrixTerm(index_one, weight), *reduced(a, t1)


def varying_regular(t1):
    def mass(t, y, args):
        first, second = jnp.stack([2 + jnp.sin(y[0]), y[1] * t]), jnp.stack([y[0], 3 + y[1] ** 2])
        return jnp.stack([first, second])

    solved = lambda t, y, args: jnp.linalg.solve(mass(t, y, args), forced(t, y, args))
    end = path(solved, FORCED_START, t1)(t1)
    return mj.MassMatrixTerm(forced, mass), FORCED_START, end


def plain(t1):
    return dfx.ODETerm(forced), FORCED_START, path(forced, FORCED_START, t1)(t1)


@pytest.mark.parametrize(
    ("name", "case", "order", "steps"),
    [
        ("Rodas5P", plain, 5, (16, 32)),
        ("Rodas5P", constant_singular, 5, (8, 16)),
        ("Rodas5P", varying_regular, 5, (32, 64)),
        ("Rodas5P", varying_singular, 3, (16, 32)),
        ("Rodas3P", constant_singular, 3, (32, 64)),
        ("Rodas3P", varying_singular, 2, (512, 1024)),
    ],
)
def test_orders(name, case, order, steps):
    t1 = 0.9
    terms, y0, end = case(t1)

    @jax.jit
    def solve(dt):
        sol = dfx.diffeqsolve(terms, METHODS[name], 0.0, t1, dt, jnp.asarray(y0), throw=False)
        return sol.ys[0], sol.result == RESULTS.successful

    errors = []
    for n in steps:
        y1, success = solve(t1 / n)
        assert success
        errors.append(np.linalg.norm(y1 - end))
    assert errors[-1] > 1e-13
    assert abs(np.log2(errors[0] / errors[1]) - order) <= 0.2, errors


@pytest.mark.parametrize(
    ("name", "case"),
    [
        ("Rodas5P", constant_singular),
        ("Rodas5P", varying_singular),
        pytest.param("Rodas3P", plain, marks=pytest.mark.slow),
        pytest.param("Rodas3P", varying_regular, marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("traced_anew")
def test_stages_in_a_loop(name, case, monkeypatch):
    """Of long vector fields, with derivatives: as those that are written out."""
    terms, y0, _ = case(0.9)
    y0 = jnp.asarray(y0)

    def step(y0, h):
        solver = METHODS[name]
        state = solver.init(terms, 0.2, 0.2 + h, y0, None)
        y1, error, info, _, _ = solver.step(terms, 0.2, 0.2 + h, y0, None, state, False)
        return jnp.concatenate([y1, error, *info["k"]])

    results = []
    for limit in (0, 10**9):
        monkeypatch.setattr(stages, "LARGEST_UNROLLED", limit)
        jax.clear_caches()
        both = lambda y0, h: (step(y0, h), jax.jacrev(step, (0, 1))(y0, h))
        traced = jax.jit(both).trace(y0, jnp.asarray(0.1))
        assert ("scan" in str(traced.jaxpr)) == (limit == 0)
        results.append(traced.lower().compile()(y0, jnp.asarray(0.1)))
    for in_a_loop, written_out in zip(*map(jax.tree.leaves, results)):
        np.testing.assert_allclose(in_a_loop, written_out, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("name", "order"), [("Rodas5P", 3), ("Rodas3P", 2)])
def test_order_of_fast_components(name, order):
    """The reduction that the docstrings state, and that it is divided by the stiffness."""
    follow = lambda t, y, rate: -rate * (y - jnp.sin(t)) + jnp.cos(t)

    @jax.jit
    def error(n, rate):
        y0, saveat = jnp.sin(jnp.zeros(1)), dfx.SaveAt(steps=True)
        terms, solver = dfx.ODETerm(follow), METHODS[name]
        options = dict(args=rate, saveat=saveat, max_steps=64, throw=False)
        sol = dfx.diffeqsolve(terms, solver, 0.0, 2.0, 2 / n, y0, **options)
        error = jnp.abs(sol.ys[:, 0] - jnp.sin(sol.ts))
        return jnp.max(jnp.where(jnp.isfinite(sol.ts), error, 0))

    assert abs(np.log2(error(8.0, 1e6) / error(16.0, 1e6)) - order) <= 0.2
    assert abs(error(8.0, 1e5) / error(8.0, 1e6) - 10) <= 1


# --- published solutions --------------------------------------------------------------------------


def digits(problem, name, tolerance=1.0, **options):
    """Of the worst component, and the solution."""
    controller = dfx.PIDController(rtol=problem.rtol * tolerance, atol=problem.atol * tolerance)
    options = dict(stepsize_controller=controller, throw=False, **options)
    solve = lambda y0: mj.diffeqsolve(
        terms_of(problem), METHODS[name], 0.0, problem.t1, None, y0, problem.args, **options
    )
    sol = jax.jit(solve)(jnp.asarray(problem.y0))
    assert sol.result == RESULTS.successful
    return -np.log10(np.max(np.abs(sol.ys[0] / problem.end - 1))), sol


@pytest.mark.parametrize(
    ("problem", "name", "least", "most_steps"),
    [
        # 7.2 as users compile it. Rounding, with other flags of the compiler and the newest JAX, leaves 6.8.
        ("Robertson", "Rodas5P", 6.5, 720),
        ("Robertson, DAE", "Rodas5P", 6.5, 720),
        ("chemical Akzo Nobel", "Rodas5P", 8.0, 180),
        ("chemical Akzo Nobel", "Rodas3P", 7.5, 930),
    ],
)
def test_published_solutions(problem, name, least, most_steps):
    found, sol = digits(PROBLEMS[problem], name)
    assert found > least
    assert sol.stats["num_steps"] < most_steps


@pytest.mark.slow
def test_transistor_amplifier():
    """A singular mass matrix that is not diagonal. 6.8 digits with rtol = atol = 1e-5."""
    found, sol = digits(PROBLEMS["transistor amplifier"], "Rodas5P", 1e3)
    assert found > 6.5
    assert sol.stats["num_steps"] < 2300


@pytest.mark.slow
def test_transistor_amplifier_at_a_tight_tolerance():
    assert digits(PROBLEMS["transistor amplifier"], "Rodas5P", max_steps=10000)[0] > 9


# --- derivatives ----------------------------------------------------------------------------------


def curved(t, y, args):
    """Index 1, with parameters in the field, in the mass and in the start."""
    x, w = y["x"], y["w"]
    first = -args[0] * x * w + jnp.cos(t)
    return {"w": w + 0.2 * w**3 - x[0] * args[1], "x": first}


def constant_mass(args):
    """Of (w, x): `ravel_pytree` sorts by key."""
    return jnp.stack([jnp.zeros(2), jnp.stack([0.3 * args[2], args[2]])])


def varying_mass(args):
    return lambda t, y, args: constant_mass(args) * (1 + 0.1 * jnp.sin(y["x"][0]))


PARAMETERS = jnp.array([1.0, 0.9, 1.3, 0.8])  # the last is the start


def end_of_curved(parameters, adjoint, mass=varying_mass, name="Rodas5P"):
    *args, x0 = parameters
    y0 = {"x": x0[None], "w": jnp.zeros(())}  # w is made consistent
    term = mj.MassMatrixTerm(curved, mass(args))
    solver = METHODS[name]
    sol = mj.diffeqsolve(term, solver, 0.0, 1.0, 0.1, y0, args, adjoint=adjoint)
    return sol.ys["x"][0, 0] + 2 * sol.ys["w"][0]


def check_gradients(mass, name):
    end = lambda adjoint: lambda p: end_of_curved(p, adjoint, mass, name)
    both = jax.jit(jax.value_and_grad(end(mj.StepReplayAdjoint())))
    reverse = both(PARAMETERS)[1]
    forward = jax.jit(jax.jacfwd(end(dfx.ForwardMode())))(PARAMETERS)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    differences = []
    for step in 1e-5 * jnp.eye(4):
        differences.append((both(PARAMETERS + step)[0] - both(PARAMETERS - step)[0]) / 2e-5)
    np.testing.assert_allclose(reverse, jnp.stack(differences), rtol=1e-8)


def test_gradients_agree():
    check_gradients(constant_mass, "Rodas3P")


@pytest.mark.slow
def test_gradients_agree_where_the_mass_depends_on_the_state():
    check_gradients(varying_mass, "Rodas5P")


@pytest.mark.slow
def test_gradients_of_a_batch():
    """Lanes that end early make steps of no length, with a singular matrix."""

    def end(start, t1):
        y0 = {"x": start[None], "w": jnp.zeros(())}
        sol = mj.diffeqsolve(
            mj.MassMatrixTerm(curved, constant_mass(PARAMETERS)),
            mj.Rodas3P(),
            0.0,
            t1,
            None,
            y0,
            PARAMETERS,
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )
        return sol.ys["x"][0, 0]

    starts, times = jnp.array([0.8, 0.5, 1.2]), jnp.array([0.1, 3.0, 1.0])
    gradient = jax.jit(jax.grad(end))
    batch = jax.jit(jax.vmap(gradient))(starts, times)
    alone = [gradient(start, t1) for start, t1 in zip(starts, times)]
    np.testing.assert_allclose(batch, jnp.stack(alone), rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dfx.RecursiveCheckpointAdjoint(), dfx.DirectAdjoint()])
def test_gradients_of_diffrax_agree(adjoint):
    gradient = lambda adjoint: jax.grad(end_of_curved)(PARAMETERS, adjoint)
    np.testing.assert_allclose(gradient(adjoint), gradient(mj.StepReplayAdjoint()), rtol=1e-12)


@pytest.mark.slow
def test_gradient_of_a_stiff_adaptive_solve():
    """Of Robertson's y1(1e3) by the logarithms of the rates: their sum is t dy1/dt, as only rates
    have a unit of time."""
    problem = PROBLEMS["Robertson"]

    def end(log_rates):
        sol = mj.diffeqsolve(
            terms_of(problem),
            mj.Rodas3P(),
            0.0,
            1e3,
            None,
            jnp.asarray(problem.y0),
            jnp.exp(log_rates),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-10),
        )
        return sol.ys[0][0], sol.ys[0]

    gradient, y1 = jax.jit(jax.grad(end, has_aux=True))(jnp.log(problem.args))
    rate = 1e3 * problem.field(jnp)(0.0, y1, problem.args)[0]
    np.testing.assert_allclose(jnp.sum(gradient), rate, rtol=1e-5)


# --- batches, types, directions -------------------------------------------------------------------


def decay(t, y, k):
    """Stiff, with a field that is not a number for negative `k` from t = 1/2 on."""
    a, b = y["a"], y["b"]
    fast = -1e3 * (b - jnp.cos(a)) + jnp.sqrt(jnp.where(t > 0.5, k, jnp.abs(k)))[None]
    return {"a": b - 0.3 * a, "b": fast}


def decayed(k, t0=0.0, t1=1.0, dtype=jnp.float64, y0=None, dt0=1e-3):
    if y0 is None:
        y0 = {"a": jnp.array([0.3], dtype), "b": jnp.array([1.0], dtype)}
    tolerance = 1e-7 if dtype == jnp.float64 else 1e-4
    return dfx.diffeqsolve(
        dfx.ODETerm(decay),
        mj.Rodas5P(),
        jnp.asarray(t0, dtype),
        jnp.asarray(t1, dtype),
        jnp.asarray(dt0, dtype),
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
    np.testing.assert_array_equal(batch.result == RESULTS.nonfinite, [False, True, False])
    assert batch.stats["num_steps"][1] < 200  # not until `max_steps`
    for i in (0, 2):
        alone = single(k[i])
        np.testing.assert_allclose(batch.ys["a"][i], alone.ys["a"], rtol=1e-13)
        assert batch.stats["num_steps"][i] == alone.stats["num_steps"]


def test_single_precision():
    single = jax.jit(lambda k: decayed(k, dtype=jnp.float32))(jnp.asarray(0.5, jnp.float32))
    double = jax.jit(decayed)(jnp.asarray(0.5))
    assert single.ys["a"].dtype == jnp.float32
    assert single.result == RESULTS.successful
    np.testing.assert_allclose(single.ys["a"], double.ys["a"], rtol=2e-4)


@pytest.mark.parametrize("case", [constant_singular, varying_singular])
def test_backwards_in_time(case):
    """To where it came from; the mass matrix of the second depends on the true time."""
    terms, y0, end = case(0.9)
    back = jax.jit(
        lambda y: dfx.diffeqsolve(terms, mj.Rodas5P(), 0.9, 0.0, -0.01, y, throw=False).ys[0]
    )
    np.testing.assert_allclose(back(jnp.asarray(end)), y0, rtol=0, atol=1e-8)


def test_jumps_of_the_field():
    """What is carried of the derivative is that behind a jump: a solve across it is as good as two
    that end and begin there."""
    force = lambda t: jnp.where(t < 0.5, 1.0, 3.0)
    term = mj.MassMatrixTerm(
        lambda t, y, args: force(t) - y, lambda t, y, args: jnp.diag(2 + jnp.sin(3 * y))
    )
    y0 = jnp.array([0.1, 0.4])
    jumping = dfx.ClipStepSizeController(
        dfx.PIDController(rtol=1e-9, atol=1e-9), jump_ts=jnp.array([0.5])
    )
    tight = dfx.PIDController(rtol=1e-9, atol=1e-9)
    whole = dfx.diffeqsolve(term, mj.Rodas5P(), 0.0, 1.0, 0.01, y0, stepsize_controller=jumping)

    @jax.jit
    def piece(push, t0, y0):
        pushed = mj.MassMatrixTerm(lambda t, y, args: push - y, term.mass)
        return dfx.diffeqsolve(
            pushed, mj.Rodas5P(), t0, t0 + 0.5, 0.01, y0, stepsize_controller=tight
        )

    first = piece(1.0, 0.0, y0)
    second = piece(3.0, 0.5, first.ys[0])
    np.testing.assert_allclose(whole.ys[0], second.ys[0], rtol=1e-8)
    steps = first.stats["num_steps"] + second.stats["num_steps"]
    assert whole.stats["num_steps"] < steps + 4


# --- on manifolds ---------------------------------------------------------------------------------


def pendulum(t, y, args):
    """With the multiplier as an unknown: positions and velocities have hidden constraints."""
    q, v, multiplier = y
    acceleration = -multiplier * q - jnp.array([0.0, 9.81])
    return v, acceleration, q @ acceleration + v @ v


PENDULUM_MASS = (jnp.ones(2), jnp.ones(2), jnp.zeros(()))
ROD = mj.Constraint(lambda t, y, args: (y[0] @ y[0] - 1, y[0] @ y[1]))


def test_projected_dae_keeps_hidden_constraints():
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.zeros(())
    problem = mj.problems.pendulum()

    @jax.jit
    def solve(y0):
        sol = mj.diffeqsolve(
            mj.MassMatrixTerm(pendulum, PENDULUM_MASS),
            mj.Projected(mj.Rodas5P(), ROD),
            0.0,
            5.0,
            None,
            y0,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 5.0, 23), dense=True),
            stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
        )
        return sol.ys, sol.evaluate(jnp.asarray(2.345))

    (q, v, multiplier), between = solve(y0)
    assert np.abs(np.sum(q * q, axis=1) - 1).max() < 2e-15
    assert np.abs(np.sum(q * v, axis=1)).max() < 4e-15
    assert abs(between[0] @ between[0] - 1) < 2e-15
    exact, _ = problem.reference(np.linspace(0.0, 5.0, 23))
    np.testing.assert_allclose(q, exact, rtol=0, atol=3e-6)
    # Tension: v^2 / r and the weight along the rod.
    np.testing.assert_allclose(multiplier, np.sum(v * v, 1) - 9.81 * q[:, 1], atol=1e-5)


def test_steps_in_diffrax_end_where_the_interpolant_does():
    """Robertson with its balance as a manifold."""
    problem = PROBLEMS["Robertson"]
    constraint = mj.Constraint(lambda t, y, args: jnp.sum(y) - 1)
    solver = mj.Projected(mj.Rodas5P(), constraint)
    terms, y0 = terms_of(problem), jnp.asarray(problem.y0)
    state = solver.init(terms, 0.0, 1e-4, y0, problem.args)
    y1, _, info, _, result = solver.step(terms, 0.0, 1e-4, y0, problem.args, state, False)
    inside = solver.interpolation_cls(t0=0.0, t1=1e-4, **info)
    assert result == RESULTS.successful
    np.testing.assert_array_equal(inside.evaluate(1e-4), y1)
    np.testing.assert_array_equal(inside.evaluate(0.0), y0)
    assert abs(jnp.sum(y1) - 1) < 3e-16


@pytest.mark.slow
def test_stiff_mechanism():
    """A hard spring: Tsit5 takes 2e4 steps."""
    system = stiff_mechanism()
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(mj.Rodas5P(), system.constraint),
        0.0,
        0.5,
        1e-6,
        (jnp.asarray(MECHANISM_START), jnp.zeros((2, 2))),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    )
    q, _ = sol.ys
    np.testing.assert_allclose(q[0], stiff_mechanism_reference(0.5), rtol=0, atol=1e-7)
    assert sol.stats["num_steps"] < 1000
    assert abs(q[0, 0] @ q[0, 0] - 1) < 1e-15


@pytest.mark.parametrize(
    "hook",
    [
        mj.LocalCoordinates,
        lambda solver, constraint: mj.Stabilized(
            solver, constraint, stabilization=mj.InvariantStabilization(5.0)
        ),
    ],
    ids=["local coordinates", "stabilized"],
)
def test_other_hooks(hook):
    problem = mj.problems.pendulum()
    solve = lambda y0: mj.diffeqsolve(
        problem.terms, hook(mj.Rodas3P(), problem.constraint), 0.0, 1.0, 0.005, y0, problem.args
    )
    sol = jax.jit(solve)(problem.y0)
    exact = problem.reference(1.0)
    np.testing.assert_allclose(sol.ys[0][0], exact[0], rtol=0, atol=1e-5)


# --- what is refused ------------------------------------------------------------------------------


def solve_dae(y0, field=index_one, mass=((1.0, 0.8), (0.0, 0.0)), solver=None, **options):
    if not isinstance(field, dfx.AbstractTerm):
        mass = mass if callable(mass) else jnp.asarray(mass)
        field = mj.MassMatrixTerm(field, mass)
    solver = mj.Rodas3P() if solver is None else solver
    return mj.diffeqsolve(field, solver, 0.0, 0.1, 0.05, y0, **options)


START = jnp.array([1.0, 0.8])  # beside the algebraic equation


def test_inconsistent_starts():
    corrected = solve_dae(START, saveat=dfx.SaveAt(t0=True))
    x, w = corrected.ys[0]
    assert abs(balance(0.0, x, w)) < 1e-15
    np.testing.assert_allclose(x + 0.8 * w, 1.64, rtol=1e-15)  # M y is kept
    assert corrected.stats["initial_correction"] > 1e-3
    with pytest.raises(RuntimeError, match=r'consistent="project"'):
        solve_dae(START, consistent="check")
    refused = solve_dae(START, consistent="check", throw=False)
    assert refused.result == RESULTS.nonlinear_divergence
    plain = dfx.diffeqsolve(
        mj.MassMatrixTerm(index_one, jnp.array([[1.0, 0.8], [0.0, 0.0]])),
        mj.Rodas5P(),
        0.0,
        0.1,
        0.05,
        START,
        throw=False,
    )
    assert plain.result == RESULTS.nonlinear_divergence
    trusted = solve_dae(START, consistent="assume", throw=False)
    assert trusted.result == RESULTS.successful
    solve_dae(corrected.ys[0], consistent="check")


def test_badly_conditioned_algebraic_equations():
    """Half of them nearly the same as others: Newton's steps end at 1e-11, far above rounding, with nothing
    better to be represented. That is a consistent state; one beside it is not."""
    A = np.random.default_rng(0).normal(size=(20, 21))
    A[10:] = A[:10] + 1e-4 * A[10:]
    field = lambda t, y, args: jnp.concatenate([-y[:1], A @ (y + 0.1 * y**3)])
    term = mj.MassMatrixTerm(field, jnp.eye(21)[0])
    y, info = term.consistent_state(0.0, jnp.full(21, 1e-3).at[0].set(0.2))
    assert info.residual > 1e-12
    np.testing.assert_allclose(field(0.0, y, None)[1:], 0, atol=1e-14)
    assert term.consistent_state(0.0, y.at[3].add(1e-6))[1].correction > 1e-7


def test_a_mass_that_is_switched_on():
    """An algebraic equation that becomes a differential one: refused, unless the time is known."""

    def mass(t, y, args):
        return jnp.where(jnp.arange(2) == 0, 1.0, jnp.where(t < 1.0, 0.0, 1.0))

    decay = lambda t, y, args: jnp.stack([-y[0], jnp.cos(3 * t) - y[1]])
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8)
    solve = lambda controller: mj.diffeqsolve(
        mj.MassMatrixTerm(decay, mass),
        mj.Rodas5P(),
        0.0,
        2.0,
        None,
        jnp.ones(2),
        stepsize_controller=controller,
    )
    with pytest.raises(RuntimeError, match="a mass that was zero is not any more"):
        solve(controller)
    sol = solve(dfx.ClipStepSizeController(controller, jump_ts=jnp.array([1.0])))
    after = solve_ivp(lambda t, y: np.cos(3 * t) - y, (1, 2), [np.cos(3)], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(sol.ys[0, 1], after.y[0, -1], rtol=1e-7)


def test_index_two():
    """A multiplier that no equation contains, and a mass matrix of which nothing is left."""
    field = lambda t, y, args: jnp.stack([y[1], y[0] - jnp.sin(t)])
    mass = jnp.array([1.0, 0.0])
    with pytest.raises(RuntimeError, match="mj.reduce_dae"):
        solve_dae(jnp.array([0.0, 1.0]), field, mass)
    failed = solve_dae(jnp.array([0.0, 1.0]), field, mass, throw=False)
    assert failed.result == RESULTS.nonlinear_divergence
    assert not np.isfinite(failed.ys).any()
    assert failed.stats["num_steps"] == 1  # no smaller step helps
    with pytest.raises(RuntimeError, match="consistent"):
        solve_dae(START, lambda t, y, args: y[:1] ** 2 + jnp.ones(2), 0.0)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Kvaerno3(), mj.Projected(dfx.Tsit5(), ROD)])
def test_a_mass_matrix_is_never_ignored(solver):
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.zeros(())
    term = mj.MassMatrixTerm(pendulum, PENDULUM_MASS)
    controller = dfx.PIDController(rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="would ignore"):
        mj.diffeqsolve(term, solver, 0.0, 0.1, 0.05, y0, stepsize_controller=controller)


@pytest.mark.parametrize("hook", ["LocalCoordinates", "Stabilized"])
def test_hooks_that_need_the_derivative(hook):
    options = {"stabilization": mj.InvariantStabilization(1.0)} if hook == "Stabilized" else {}
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.zeros(())
    solver = getattr(mj, hook)(mj.Rodas5P(), ROD, **options)
    with pytest.raises(ValueError, match=hook):
        mj.diffeqsolve(mj.MassMatrixTerm(pendulum, PENDULUM_MASS), solver, 0.0, 0.1, 0.05, y0)


def controlled(counts):
    terms = mj.MassMatrixTerm(index_one, jnp.array([1.0, 0.0]), controlled=counts)
    return mj.diffeqsolve(terms, mj.Rodas5P(), 0.0, 1.0, 0.1, START)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: solve_dae(START, mass=jnp.ones(3)), ValueError, r"`mass` must be a scalar"),
        (lambda: solve_dae(START, mass=lambda t, y, a: jnp.ones((2, 3))), ValueError, "`mass`"),
        (lambda: mj.MassMatrixTerm(index_one, 1j), TypeError, "real numbers"),
        (lambda: mj.MassMatrixTerm(index_one, "M"), TypeError, "`mass`"),
        (lambda: mj.MassMatrixTerm(index_one, lambda y: y), TypeError, r"M\(t, y, args\)"),
        (lambda: mj.MassMatrixTerm(1.0, 1.0), TypeError, "`vector_field`"),
        (lambda: controlled(np.ones(2)), ValueError, "`controlled` must be a vector of booleans"),
        (lambda: controlled(np.zeros(2, bool)), ValueError, "some of them true"),
        (lambda: controlled(jnp.ones(3, bool)), ValueError, r"`controlled` must have shape \(2,\)"),
        (lambda: jax.jit(controlled)(jnp.ones(2, bool)), TypeError, "use NumPy"),
        (lambda: solve_dae(START, lambda t, y, a: y[:1]), ValueError, "`vector_field`"),
        (lambda: solve_dae(jnp.array([1j, 0])), TypeError, "complex"),
        (lambda: solve_dae(jnp.array([1, 0])), TypeError, "int"),
        (
            lambda: mj.Projected(dfx.HalfSolver(mj.Rodas5P()), ROD),
            ValueError,
            "HalfSolver",
        ),
    ],
)
@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_input(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_controls_are_refused():
    path = dfx.LinearInterpolation(jnp.linspace(0, 1, 3), jnp.linspace(0, 1, 3))
    terms = dfx.ControlTerm(lambda t, y, args: -y, path)
    with pytest.raises(ValueError, match="to_ode"):
        dfx.diffeqsolve(terms, mj.Rodas5P(), 0.0, 1.0, 0.1, jnp.array(1.0))
