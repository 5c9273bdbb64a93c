"""Every reference against its constraint, its vector field, SciPy, and published numbers."""

import decimal

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
import scipy.integrate
from variants import variants

from manifold_jax import problems
from manifold_jax.problems.lotka_volterra import COST_BY_RATES, COST_BY_START, END, PUBLISHED_END
from manifold_jax.problems.pendulum import A01_X, A01_Y


jax.config.update("jax_enable_x64", True)


def scaled_args(problem, factor=1.1):
    return problem.with_args(jtu.tree_map(lambda leaf: factor * leaf, problem.args))


# Other parameters and other initial states than the standard ones.
VARIANTS = {
    "oscillator-start": lambda: problems.harmonic_oscillator(radius=2.0).with_initial(
        jnp.array([1.2, 1.6])
    ),
    "pendulum-a01": lambda: problems.pendulum(q0=(-1.0, 0.0)),
    "pendulum-test-set": lambda: problems.pendulum(gravity=1.0, v0=(0.0, 1.0), t1=1.0),
    "pendulum-long-heavy": lambda: problems.pendulum(length=2.5, mass=7.0),
    "pendulum-small": lambda: problems.pendulum(q0=(0.6, -0.8), v0=(0.4, 0.3), t1=3.0),
    "pendulum-clockwise": lambda: problems.pendulum(
        length=0.5, q0=(0.3, 0.4), v0=(4.0, -3.0), t1=1.5
    ),
    "pendulum-over-the-top": lambda: problems.pendulum(v0=(0.0, 5.0), t1=3.0),
    "pendulum-over-the-top-clockwise": lambda: problems.pendulum(
        length=2.0, q0=(0.0, -2.0), v0=(-9.5, 0.0), t1=3.0
    ),
    "rigid-body-largest": lambda: problems.rigid_body(y0=(-1.0, 0.3, 0.2), t1=10.0),
    "rigid-body-smallest": lambda: problems.rigid_body(y0=(0.2, -0.3, -1.0), t1=10.0),
    "rigid-body-ascending": lambda: problems.rigid_body(
        inertia=(0.5, 1.0, 3.0), y0=(0.3, 0.5, -0.8), t1=10.0
    ),
    "rigid-body-odd-order": lambda: problems.rigid_body(
        inertia=(1.0, 3.0, 0.5), y0=(0.1, 0.9, 0.4), t1=10.0
    ),
    "rigid-body-cyclic-order": lambda: problems.rigid_body(
        inertia=(0.7, 2.0, 1.0), y0=(0.8, 0.2, 0.4), t1=10.0
    ),
    "rigid-body-oblate": lambda: problems.rigid_body(
        inertia=(2.0, 1.0, 1.0), y0=(0.3, 0.5, -0.8), t1=10.0
    ),
    "rigid-body-prolate": lambda: problems.rigid_body(
        inertia=(2.0, 2.0, 1.0), y0=(0.3, 0.5, -0.8), t1=10.0
    ),
    "rigid-body-sphere": lambda: problems.rigid_body(inertia=(2.0, 2.0, 2.0), t1=10.0),
    "rigid-body-steady": lambda: problems.rigid_body(y0=(0.0, 0.0, -1.0), t1=10.0),
    "rigid-body-steady-oblate": lambda: problems.rigid_body(
        inertia=(2.0, 1.0, 1.0), y0=(0.0, 0.6, 0.8), t1=10.0
    ),
    "rigid-body-steady-prolate": lambda: problems.rigid_body(
        inertia=(2.0, 2.0, 1.0), y0=(0.6, 0.8, 0.0), t1=10.0
    ),
    "kepler-circle": lambda: problems.kepler(eccentricity=0.0, mu=2.0),
    "kepler-long": lambda: problems.kepler(eccentricity=0.9, t1=5.0),
    "kepler-start": lambda: problems.kepler(mu=1.5).with_initial(
        (jnp.array([0.3, -0.7]), jnp.array([0.9, 0.8]))
    ),
    "kepler-retrograde": lambda: problems.kepler().with_initial(
        (jnp.array([0.3, -0.7]), jnp.array([-0.9, -0.3]))
    ),
    "jay2-start": lambda: problems.jay2().with_initial(jnp.array([2.0, 0.25])),
    "arevalo-start": lambda: problems.arevalo().with_initial(
        (jnp.array([-0.6, 0.8]), jnp.array([-2.4, -1.8]))
    ),
    "skate-start": lambda: problems.skate(slope=0.3).with_initial(
        (jnp.array([1.0, -2.0]), jnp.array([0.7, 0.0]))
    ),
    "sphere-flow-small": lambda: problems.sphere_flow(n=3, t1=5.0),
    "rotation-none": lambda: problems.rotation(omega=(0.0, 0.0, 0.0)),
    "rotation-start": lambda: problems.rotation(omega=(0.3, 0.1, -2.0)).with_initial(
        jnp.array([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8], [0.8, 0.0, -0.6]])
    ),
}

# Whose lengths are parameters that the initial state depends on.
MOVING_MECHANISMS = {
    "double-pendulum",
    "chain",
    "slider-crank",
    "four-bar",
    "parallelogram",
    "spherical-pendulum",
    "rolling-disc",
}


@eqx.filter_jit
def vector_field(problem, t, y):
    return problem.terms.vf(t, y, problem.args)


@eqx.filter_jit
def residual(problem, t, y):
    return problem.constraint(t, y, problem.args)


@eqx.filter_jit
def drift(problem, t, y):
    """The rate at which the residual changes along the vector field."""
    rate = problem.terms.vf(t, y, problem.args)
    return jax.jvp(lambda t, y: problem.constraint(t, y, problem.args), (t, y), (1.0, rate))[1]


def flatten(y):
    return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(y)])


def states_of(trajectory):
    """The states of a trajectory, one by one."""
    leaves, structure = jtu.tree_flatten(jtu.tree_map(jnp.asarray, trajectory))
    return [structure.unflatten(state) for state in zip(*leaves)]


def known_times(problem, count=7):
    """The ends of the span, and times between them if the reference knows those."""
    if problem.reference_at_end_only:
        return np.array([problem.t1])
    inner = np.random.default_rng(0).uniform(problem.t0, problem.t1, count)
    return np.concatenate([[problem.t0], inner, [problem.t1]])


def known_states(problem):
    """Pairs (t, y) on the exact solution, the initial state included."""
    times = known_times(problem)
    states = zip(jnp.asarray(times), states_of(problem.reference(times)))
    return [(jnp.asarray(problem.t0), problem.y0), *states]


def violation(problem, t, y):
    return np.max(np.abs(flatten(residual(problem, jnp.asarray(t), y))))


def integrate(problem, tolerance=3e-14):
    """End state by SciPy, an independent integrator, on the same vector field."""
    y0, unravel = jfu.ravel_pytree(problem.y0)
    field = jax.jit(lambda t, x: jfu.ravel_pytree(vector_field(problem, t, unravel(x)))[0])
    solution = scipy.integrate.solve_ivp(
        lambda t, x: np.asarray(field(t, x)),
        (problem.t0, problem.t1),
        np.asarray(y0),
        method="DOP853",
        rtol=tolerance,
        atol=tolerance,
    )
    assert solution.success
    return solution.y[:, -1]


def test_names():
    for name, build in (problems.ALL | problems.FURTHER).items():
        assert build.__name__ == name.replace("-", "_")
        assert getattr(problems, build.__name__) is build
        assert build().name == name


def check_reference_is_on_the_manifold(problem):
    # The published state is consistent to round-off although its own error is 5e-12; a
    # first integral sees the error of a computed one.
    tolerance = 1e-11 if problem.reference_at_end_only else 1e-12
    assert violation(problem, problem.t0, problem.y0) < 1e-14
    for t, y in known_states(problem):
        assert violation(problem, t, y) < tolerance


def check_field_is_tangent(problem):
    for t, y in known_states(problem):
        assert np.max(np.abs(flatten(drift(problem, t, y)))) < 1e-10


def check_reference_solves_the_equation(problem):
    # Error of the five-point formula h^4 y^(5) / 30, below 1e-9 here, and round-off 1e-11.
    h = 3e-4
    times = np.random.default_rng(1).uniform(problem.t0 + 2 * h, problem.t1 - 2 * h, 5)
    stencils = np.add.outer(times, h * np.arange(-2, 3))
    states = states_of(problem.reference(stencils.ravel()))
    for i, t in enumerate(times):
        far, near, _, nearer, farther = map(flatten, states[5 * i : 5 * i + 5])
        slope = (far - 8 * near + 8 * nearer - farther) / (12 * h)
        rate = flatten(vector_field(problem, jnp.asarray(t), states[5 * i + 2]))
        np.testing.assert_allclose(slope, rate, rtol=1e-8, atol=1e-8)


def is_redundant(problem):
    """Off the manifold redundant equations contradict each other: rounding errors grow by 1e10
    on the parallelogram, unless they are projected away."""
    return problem.system is not None and problem.system.redundant


def check_scipy_meets_the_reference(problem):
    end = flatten(problem.reference(problem.t1))
    tolerance = 1e-10 if problem.reference_at_end_only else 1e-9
    np.testing.assert_allclose(integrate(problem), end, rtol=0, atol=tolerance)


def check_reference_starts_at_the_initial_state_and_has_its_layout(problem):
    if not problem.reference_at_end_only:
        start = flatten(problem.reference(problem.t0))
        np.testing.assert_allclose(start, flatten(problem.y0), rtol=0, atol=1e-14)
    one = problem.reference(problem.t1)
    many = problem.reference(np.array([problem.t1, problem.t1]))
    assert jtu.tree_structure(one) == jtu.tree_structure(problem.y0)
    assert jtu.tree_structure(many) == jtu.tree_structure(problem.y0)
    for y, a, b in zip(*map(jtu.tree_leaves, (problem.y0, one, many)), strict=True):
        assert a.dtype == b.dtype == np.float64
        assert a.shape == y.shape
        assert b.shape == (2, *y.shape)
        np.testing.assert_allclose(a, b[1], rtol=0, atol=1e-15)


def check_reference(problem):
    """Against the constraint, the vector field, and SciPy."""
    check_reference_is_on_the_manifold(problem)
    check_field_is_tangent(problem)
    check_reference_starts_at_the_initial_state_and_has_its_layout(problem)
    if not problem.reference_at_end_only:
        check_reference_solves_the_equation(problem)
    if not is_redundant(problem):
        check_scipy_meets_the_reference(problem)


def check_with_args_rebuilds_consistently(problem):
    if problem.args is None:
        assert eqx.tree_equal(problem.with_args(None), problem)
        return
    assert eqx.tree_equal(problem.with_args(problem.args), problem)
    other = scaled_args(problem, 1.3)
    assert violation(other, other.t0, other.y0) < 1e-14
    moves = {"harmonic-oscillator", "pendulum", "kepler", "car-axis", *MOVING_MECHANISMS}
    assert (problem.name in moves) == np.any(flatten(problem.y0) != flatten(other.y0))


def check_gradient_with_respect_to_args(problem):
    point, unravel = jfu.ravel_pytree(problem.args)
    direction = np.cos(np.arange(point.size) + 0.3)

    def probe(x):
        # everything that depends on the parameters: start, constraint, vector field
        new = problem.with_args(unravel(x))
        y = jtu.tree_map(lambda leaf: leaf + 0.1, problem.y0)
        t = problem.t0 + 0.2
        parts = new.y0, new.constraint(t, y, new.args), new.terms.vf(t, y, new.args)
        values, _ = jfu.ravel_pytree(parts)
        return values @ np.cos(np.arange(values.size))

    value_and_gradient = jax.jit(jax.value_and_grad(probe))
    _, gradient = value_and_gradient(point)
    assert np.all(np.isfinite(gradient))
    h = 1e-6
    ends = [value_and_gradient(point + s * h * direction)[0] for s in (1, -1)]
    difference = (ends[0] - ends[1]) / (2 * h)
    np.testing.assert_allclose(gradient @ direction, difference, rtol=1e-6, atol=1e-8)


def check_published_only_at_the_end(problem):
    with pytest.raises(ValueError, match="end of its time span only"):
        problem.reference(problem.t1 / 2)
    with pytest.raises(ValueError, match="end of its time span only"):
        problem.reference([problem.t0, problem.t1])
    with pytest.raises(ValueError, match="standard parameters"):
        scaled_args(problem).reference(problem.t1)
    start = jtu.tree_map(lambda leaf: leaf + 0.1, problem.y0)
    with pytest.raises(ValueError, match="standard parameters"):
        problem.with_initial(start).reference(problem.t1)


@pytest.mark.parametrize("name", problems.ALL)
def test_standard_problem(name):
    problem = problems.ALL[name]()
    check_reference(problem)
    check_with_args_rebuilds_consistently(problem)
    if problem.args is not None:
        check_gradient_with_respect_to_args(problem)
    if problem.reference_at_end_only:
        check_published_only_at_the_end(problem)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_other_parameters_and_starts(name):
    check_reference(VARIANTS[name]())


@pytest.mark.slow
@pytest.mark.parametrize("name", problems.ALL)
def test_scaled_parameters(name):
    problem = problems.ALL[name]()
    if problem.args is None or problem.reference_at_end_only:
        pytest.skip("has no parameters, or no reference for others")
    check_reference(scaled_args(problem))


def test_sensitivity_includes_the_initial_state():
    def start(length):
        problem = problems.pendulum(q0=(-1.0, 0.0))
        return problem.with_args(problem.args._replace(length=length)).y0[0]

    np.testing.assert_allclose(jax.jacobian(start)(1.0), [-1.0, 0.0])
    np.testing.assert_allclose(
        jax.jacobian(lambda L: problems.pendulum(length=L).y0[0])(2.0), [1, 0]
    )


def test_invariants_are_frozen_at_the_new_start():
    problem = problems.rigid_body().with_initial(jnp.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(problem.constraint.values, [14.0, 0.5 * (0.5 + 4 + 13.5)])

    def norm_squared(y0):
        return problem.with_initial(y0).constraint.values[0]

    np.testing.assert_allclose(jax.grad(norm_squared)(problem.y0), [2.0, 4.0, 6.0])
    # a start of the user's survives other parameters
    other = scaled_args(problem)
    np.testing.assert_array_equal(other.y0, problem.y0)
    np.testing.assert_allclose(other.constraint.values[1], problem.constraint.values[1] / 1.1)


def test_equal_problems_share_compiled_code():
    traces = []

    @eqx.filter_jit
    def run(problem):
        traces.append(problem.name)
        rate = problem.terms.vf(problem.t0, problem.y0, problem.args)
        return rate, problem.constraint(problem.t0, problem.y0, problem.args)

    for build in problems.ALL.values():
        run(build())
        run(build())
    run(problems.pendulum(gravity=3.0, length=2.0))
    run(problems.pendulum(q0=(-1.0, 0.0)))
    run(scaled_args(problems.car_axis()))
    assert len(traces) == len(problems.ALL)


@pytest.mark.parametrize("name", variants(problems.ALL, ("pendulum", "kepler", "four-bar")))
def test_single_precision(name):
    build = problems.ALL[name]
    with jax.enable_x64(False):
        problem = build()
        assert all(leaf.dtype == jnp.float32 for leaf in jtu.tree_leaves(problem.y0))
        rate = vector_field(problem, jnp.asarray(problem.t0), problem.y0)
        assert all(leaf.dtype == jnp.float32 for leaf in jtu.tree_leaves(rate))
        assert violation(problem, problem.t0, problem.y0) < 1e-6
        reference = flatten(problem.reference(problem.t1))
    np.testing.assert_allclose(reference, flatten(build().reference(problem.t1)), atol=1e-3)


def test_unknown_references_are_refused():
    escaping = problems.kepler().with_initial((jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0])))
    with pytest.raises(ValueError, match="bound orbits"):
        escaping.reference(1.0)
    lopsided = problems.sphere_flow(n=3)
    lopsided = lopsided.with_args(type(lopsided.args)(jnp.triu(jnp.ones((3, 3)))))
    with pytest.raises(ValueError, match="symmetric"):
        lopsided.reference(1.0)
    with pytest.raises(ValueError, match="scalar or of shape"):
        problems.jay2().reference(np.zeros((2, 2)))


def test_unstable_equilibria_stay():
    pendulum = problems.pendulum(q0=(0.0, 1.0))
    np.testing.assert_allclose(flatten(pendulum.reference(3.0)), [0, 1, 0, 0], atol=1e-14)
    body = problems.rigid_body(y0=(0.0, 1.0, 0.0))
    np.testing.assert_allclose(body.reference(3.0), [0, 1, 0], atol=1e-14)


def test_pendulum_refuses_starts_off_the_manifold():
    with pytest.raises(ValueError, match="length"):
        problems.pendulum(length=2.0, q0=(1.0, 0.0))
    with pytest.raises(ValueError, match="perpendicular"):
        problems.pendulum(v0=(1.0, 0.0))
    with pytest.raises(ValueError, match="shape"):
        problems.pendulum(q0=(1.0, 0.0, 0.0))


# Published and independently computed numbers


def test_a01_curve():
    # Library of Computational Benchmark Problems, A01: 6 significant digits
    t = 0.5 * np.arange(21)
    q, _ = problems.pendulum(q0=(-1.0, 0.0)).reference(t)
    np.testing.assert_allclose(q[:, 0], A01_X, rtol=0, atol=6e-7)
    np.testing.assert_allclose(q[:, 1], A01_Y, rtol=0, atol=6e-7)
    # the default starts on the other side: its mirror image
    mirrored, _ = problems.pendulum().reference(t)
    np.testing.assert_allclose(mirrored, q * np.array([-1.0, 1.0]), rtol=0, atol=1e-13)


def test_a01_after_1250_swings():
    # computed with 20 digits (mpmath) from the elliptic functions
    expected = [0.81460306858903215, -0.58001882783693546, -1.9566477078826579, -2.7479991174303923]
    actual = flatten(problems.pendulum(q0=(-1.0, 0.0)).reference(2000.0))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-10)


def test_pendulum_of_the_test_set():
    actual = flatten(problems.pendulum(gravity=1.0, v0=(0.0, 1.0), t1=1.0).reference(1.0))
    # computed with 20 digits (mpmath) from the elliptic functions
    exact = [0.86734864060043932, 0.49770105047967293, -0.033748018060954520, 0.058813011465250008]
    np.testing.assert_allclose(actual, exact, rtol=0, atol=1e-15)
    # as printed in the drivers of the test set; 11 digits are right
    printed = [
        0.867348640604551746,
        0.497701050476373918,
        -0.0337480180329866458,
        0.0588130114660715686,
    ]
    np.testing.assert_allclose(actual, printed, rtol=0, atol=5e-11)


def test_pendulum_period():
    # 4 K(1/2)^2 = 13.750371636040745...: back at the start after 2 s
    q, v = problems.pendulum(gravity=13.750371636040745).reference(2.0)
    np.testing.assert_allclose(q, [1.0, 0.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(v, [0.0, 0.0], rtol=0, atol=1e-13)
    # the scales: time sqrt(L / g), whatever the mass
    q, _ = problems.pendulum(length=4.0, mass=3.0).reference(2.0)
    unit, _ = problems.pendulum().reference(1.0)
    np.testing.assert_allclose(q, 4.0 * unit, rtol=0, atol=1e-14)


def test_pendulum_gravity_sensitivity():
    # d x(10) / d g from the closed form, 9 digits
    def end(gravity):
        return problems.pendulum(gravity=gravity).reference(10.0)[0][0]

    h = 1e-3
    slope = (end(9.81 - 2 * h) - 8 * end(9.81 - h) + 8 * end(9.81 + h) - end(9.81 + 2 * h)) / (
        12 * h
    )
    np.testing.assert_allclose(slope, -2.12823553, rtol=0, atol=2e-8)


def test_kepler_standard_orbit():
    # semi-major axis 1: apocentre at distance 1 + e after half of the period 2 pi / sqrt(mu)
    q, v = problems.kepler(mu=2.0, eccentricity=0.3).reference(np.pi / np.sqrt(2.0))
    np.testing.assert_allclose(q, [-1.3, 0.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(v, [0.0, -np.sqrt(2.0 * 0.7 / 1.3)], rtol=0, atol=1e-14)


def lotka_volterra_by_taylor_series(
    start=("1", "1"), rates=("1.5", "1", "3", "1"), order=30, steps=100
):
    """(x, y) at t = 10: an independent method in the precision of the context."""
    p0, p1, p2, p3 = map(decimal.Decimal, rates)
    x, y = map(decimal.Decimal, start)
    h = decimal.Decimal(10) / steps
    for _ in range(steps):
        xs, ys = [x], [y]
        for k in range(order):
            product = sum(a * b for a, b in zip(xs, reversed(ys), strict=True))
            xs.append((p0 * xs[k] - p1 * product) / (k + 1))
            ys.append((p3 * product - p2 * ys[k]) / (k + 1))
        x = sum(a * h**k for k, a in enumerate(xs))
        y = sum(b * h**k for k, b in enumerate(ys))
    return x, y


def test_lotka_volterra_end():
    with decimal.localcontext(prec=40):
        end = [float(value) for value in lotka_volterra_by_taylor_series()]
    np.testing.assert_allclose(END, end, rtol=2e-16, atol=0)
    # SUNDIALS prints 16 digits of which 11 are right
    np.testing.assert_allclose(END, PUBLISHED_END, rtol=0, atol=5e-12)


def test_lotka_volterra_cost_gradient():
    """Differences in 40 digits: their errors are of the size 1e-24."""

    def cost(data):
        end = lotka_volterra_by_taylor_series(data[:2], data[2:])
        return sum((1 - value) ** 2 for value in end) / 2

    with decimal.localcontext(prec=40):
        h = decimal.Decimal("1e-12")
        standard = [decimal.Decimal(value) for value in ("1", "1", "1.5", "1", "3", "1")]
        moved = lambda i, h: [value + h * (i == k) for k, value in enumerate(standard)]
        slopes = [(cost(moved(i, h)) - cost(moved(i, -h))) / (2 * h) for i in range(6)]
    np.testing.assert_allclose(
        [*COST_BY_START, *COST_BY_RATES], [float(s) for s in slopes], rtol=3e-16, atol=0
    )
