"""One correction: where it goes, what it reports, and its derivatives."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings, strategies as st

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)


def quadrics(args):
    """`m` random quadrics through the point `p`: `(y-p)' A_i (y-p) + b_i (y-p) - s t`."""

    def residual(t, y, args):
        A, b, p = args
        d = y - p
        return jnp.einsum("ijk,j,k->i", A, d, d) + b @ d - 0.1 * jnp.sin(t)

    del args
    return mj.Constraint(residual)


@st.composite
def manifolds(draw):
    """Random dimension, codimension 1 .. n - 1, coefficients, and distance from the manifold."""
    n = draw(st.integers(2, 12))
    m = draw(st.integers(1, n - 1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    b = basis[:m] * rng.uniform(0.3, 3, size=(m, 1))
    A = 0.05 * rng.normal(size=(m, n, n))
    p = rng.normal(size=n)
    distance = 10.0 ** draw(st.floats(-6, -2))
    y = p + distance * rng.normal(size=n) / np.sqrt(n)
    return tuple(map(jnp.asarray, (A, b, p))), jnp.asarray(y)


@settings(max_examples=15, deadline=None)
@given(manifolds())
def test_random_manifolds(manifold):
    args, y = manifold
    p, info = mj.project(quadrics(args), 0.0, y, args)
    A, b, centre = map(np.asarray, args)
    d = np.asarray(p) - centre
    residual = np.einsum("ijk,j,k->i", A, d, d) + b @ d
    assert bool(info.success)
    assert np.abs(residual).max() <= 2e-15
    # The multipliers say how it got there: (p - y) + G(y)^T lambda = 0.
    e = np.asarray(y) - centre
    G = np.einsum("ijk,k->ij", A + A.transpose(0, 2, 1), e) + b
    np.testing.assert_allclose(p - y + G.T @ info.multipliers, 0, atol=1e-15)


def test_nearest_point_on_the_circle_and_lipschitz_constant():
    """Federer: the nearest-point map onto the unit circle has Lipschitz constant 1/(1-d)."""
    for d in (0.05, 0.2, 0.49):
        x = jnp.array([1 - d, 0.0])
        jac = jax.jacfwd(lambda x: mj.project(CIRCLE, 0.0, x)[0])(x)
        np.testing.assert_allclose(np.linalg.norm(jac, 2), 1 / (1 - d), rtol=1e-12)


def test_consistent_point_is_returned_unchanged():
    y = jnp.array([0.6, 0.8])
    p, info = mj.project(CIRCLE, 0.0, y)
    assert np.array_equal(p, y)
    assert int(info.iterations) == 0
    assert float(info.correction) == 0.0


@pytest.mark.parametrize("scale", [0.01, 0.1, 0.5, 3.0, 1e3])
def test_far_points(scale):
    """From 0.01 the full Newton step overshoots by a factor of 50."""
    y = scale * jnp.array([0.6, -0.8])
    p, info = mj.project(CIRCLE, 0.0, y)
    assert bool(info.success)
    np.testing.assert_allclose(p, [0.6, -0.8], atol=1e-15)
    np.testing.assert_allclose(info.correction, np.max(np.abs(p - y) / (np.abs(y) + 1)))


def test_a_correction_of_a_step_takes_two_iterations():
    """From as far as steps end: the factorization at that point leaves the square of the distance."""
    point = jnp.array([0.6, 0.8]) + jnp.array([3e-5, -2e-5])
    info = CIRCLE.correct(mj.NewtonProjection(), 0.0, point)[1]
    assert info.iterations <= 3
    closer = CIRCLE.correct(mj.NewtonProjection(), 0.0, jnp.array([0.6, 0.8]) * (1 + 1e-8))[1]
    assert closer.iterations <= 2


def test_weights_move_the_light_components():
    constraint = mj.Constraint(lambda t, y, args: y[0] + y[1] - 1.0)
    projection = mj.NewtonProjection(metric=jnp.array([1e6, 1.0]))
    p, _ = mj.project(constraint, 0.0, jnp.array([1.0, 1.0]), projection=projection)
    # min 1e6 a^2 + b^2 subject to a + b = -1.
    np.testing.assert_allclose(p, [1 - 1 / (1 + 1e6), 1 - 1e6 / (1 + 1e6)], atol=1e-14)


def test_error_metric_needs_tolerances():
    with pytest.raises(ValueError, match="metric='error'.*rtol"):
        mj.project(CIRCLE, 0.0, jnp.ones(2), projection=mj.NewtonProjection(metric="error"))
    weights = mj.NewtonProjection(metric="error", rtol=1e-3, atol=0.0)
    p, _ = mj.project(CIRCLE, 0.0, jnp.array([1.0, 0.1]), projection=weights)
    # W^-1 = diag(y^2): the small component moves 100^2 times less, relative to its gradient.
    np.testing.assert_allclose(p @ p, 1, atol=1e-15)
    np.testing.assert_allclose((p[1] - 0.1) / (p[0] - 1.0), 1e-2 * 0.1, rtol=1e-9)


def two_surfaces(t, y, args):
    return jnp.stack([args * y[0] ** 2 + y[1] * y[2] - 1, jnp.sin(y[0]) * y[2] + y[3] - t])


def objective(theta):
    """Depends on the point, the time and a parameter of g; the start is 0.3 off."""
    p, info = mj.project(mj.Constraint(two_surfaces), theta[5], theta[:4], theta[4])
    weights = jnp.array([1.0, 2.0, 3.0, -1.0])
    return p @ weights + p @ p + jnp.sum(info.multipliers)


THETA = jnp.array([0.9, 0.7, 0.4, 0.3, 1.1, 0.6])


def central(f, x, step=1e-6):
    """Central differences along every component, the new axis last."""
    columns = [(f(x + step * e) - f(x - step * e)) / (2 * step) for e in jnp.eye(len(x))]
    return jnp.stack(columns, axis=-1)


def test_first_derivatives():
    f = jax.jit(objective)
    forward, reverse = jax.jit(jax.jacfwd(objective))(THETA), jax.jit(jax.grad(objective))(THETA)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(reverse, central(f, THETA), rtol=1e-8, atol=1e-9)


def test_second_derivatives_of_a_long_move():
    """One differentiable Newton step would be right to first order only."""
    forward = jax.jit(jax.jacfwd(jax.jacfwd(objective)))(THETA)
    mixed = jax.jit(jax.hessian(objective))(THETA)
    np.testing.assert_allclose(forward, mixed, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(
        mixed, central(jax.jit(jax.grad(objective)), THETA), rtol=1e-7, atol=1e-8
    )


@pytest.mark.parametrize("where", ["args", "leaf", "closure"])
def test_parameters_inside_the_constraint(where):
    class Circle(eqx.Module):
        radius: jax.Array

        def __call__(self, t, y, args):
            return y @ y - self.radius**2

    def projected(radius):
        if where == "args":
            constraint, args = mj.Constraint(lambda t, y, args: y @ y - args**2), radius
        elif where == "leaf":
            constraint, args = mj.Constraint(Circle(radius)), None
        else:
            constraint, args = mj.Constraint(lambda t, y, args: y @ y - radius**2), None
        return mj.project(constraint, 0.0, jnp.array([3.0, 4.0]), args)[0]

    # p = radius (0.6, 0.8)
    for jac in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jac(projected)(jnp.asarray(2.0)), [0.6, 0.8], rtol=1e-13)


def test_sensitivity_is_tangent():
    """G(p) dp + g_a da + g_t dt = 0."""
    constraint = mj.Constraint(two_surfaces)
    y, a, t = THETA[:4], THETA[4], THETA[5]
    p, _ = mj.project(constraint, t, y, a)
    dp_da = jax.jacfwd(lambda a: mj.project(constraint, t, y, a)[0])(a)
    dp_dt = jax.jacfwd(lambda t: mj.project(constraint, t, y, a)[0])(t)
    G = jax.jacfwd(two_surfaces, 1)(t, p, a)
    g_a, g_t = jax.jacfwd(two_surfaces, 2)(t, p, a), jax.jacfwd(two_surfaces, 0)(t, p, a)
    np.testing.assert_allclose(G @ dp_da + g_a, 0, atol=1e-14)
    np.testing.assert_allclose(G @ dp_dt + g_t, 0, atol=1e-14)


NOWHERE = mj.Constraint(lambda t, y, args: y @ y + 1.0)


def test_failure_is_reported_and_leaves_the_point():
    y = jnp.array([0.3, 0.4])
    p, info = mj.project(NOWHERE, 0.0, y, throw=False)
    assert not bool(info.success)
    assert np.array_equal(p, y)


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (NOWHERE.function, "`y` could not be made consistent"),
        (lambda t, y, args: jnp.log(y[0] - 1.0), "not finite"),
        (lambda t, y, args: jnp.stack([y[0], 2 * y[0]]), "full rank at `y`"),
        (
            lambda t, y, args: (y[0] - 0.3) ** 2 + (y[1] - 0.4) ** 2 - 1,
            "or `y` is a singular point",
        ),
    ],
)
def test_failure_raises(residual, message):
    with pytest.raises(RuntimeError, match=message):
        jax.jit(lambda y: mj.project(mj.Constraint(residual), 0.0, y))(jnp.array([0.3, 0.4]))


def test_an_equation_that_ignores_the_state_among_redundant_ones():
    """It cannot hold, and the rank of redundant equations is not asked for."""
    g = mj.Constraint(lambda t, y, args: jnp.stack([y[0] - 1, 0 * y[1] + 5]), redundant=True)
    with pytest.raises(RuntimeError, match="no nearby state satisfies"):
        mj.consistent_state(g, 0.0, jnp.array([1.0, 0.4]))


@pytest.mark.parametrize("dt0", [None, 0.1])
def test_redundant_equations_that_hold_identically(dt0):
    """The diagonal of `S^T J S = J` is `0 = 0` up to rounding: no direction, and no violation either."""
    J = np.kron(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(2))
    H = J @ np.array(
        [[1.0, 0.2, 0.1, 0.0], [0.2, 2.0, 0.0, 0.3], [0.1, 0.0, 0.5, 0.1], [0.0, 0.3, 0.1, 1.0]]
    )
    constraint = mj.Constraint(lambda t, S, args: S.T @ J @ S - J, redundant=True)
    adaptive = dfx.PIDController(rtol=1e-9, atol=1e-9)
    sol = mj.diffeqsolve(
        dfx.ODETerm(lambda t, S, args: H @ S),
        mj.Projected(dfx.Tsit5(), constraint),
        0.0,
        1.0,
        dt0,
        jnp.eye(4),
        stepsize_controller=adaptive if dt0 is None else dfx.ConstantStepSize(),
    )
    S = sol.ys[-1]
    assert jnp.abs(S.T @ J @ S - J).max() < 2e-15
    np.testing.assert_allclose(S, scipy.linalg.expm(H), atol=1e-7 if dt0 is None else 1e-4)


@pytest.mark.parametrize("distance", [1e-14, 1e-12])
def test_a_start_is_checked_to_rounding(distance):
    y0 = jnp.array([1 + distance, 0.0])
    hook = mj.Projected(dfx.Euler(), mj.Constraint(lambda t, y, args: y @ y - 1))
    turn = dfx.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
    options = dict(consistent="check", throw=False)
    sol = mj.diffeqsolve(turn, hook, 0.0, 0.1, 0.1, y0, **options)
    assert (sol.result == dfx.RESULTS.successful) == (distance < 1e-13)


def test_what_a_projection_did_is_printed():
    y = jnp.array([1.5, 2.0])
    _, info = mj.project(CIRCLE, 0.0, y)
    text = f"ProjectionInfo(success=True, full_rank=True, correction=0.4, residual={info.residual:.3g}, "
    assert repr(info) == f"{text}iterations={info.iterations}, multipliers=[0.3])"
    assert str(info) == repr(info)
    batch = jax.vmap(lambda a: mj.project(NOWHERE, 0.0, a * y, throw=False)[1])(
        jnp.arange(1.0, 3.0)
    )
    assert "success=[False, False]" in repr(batch)
    seen = []
    jax.jit(lambda y: seen.append(repr(mj.project(CIRCLE, 0.0, y)[1])))(y)
    assert "f64[1]" in seen[0]
    assert "shape=(1,)" in repr(jax.eval_shape(lambda y: mj.project(CIRCLE, 0.0, y)[1], y))


@pytest.mark.parametrize("radius", [1e-3, 1e-6])
def test_states_that_are_small_in_their_units(radius):
    """What the docstring promises: on the manifold to about eps / size of a state's own size."""
    circle = mj.Constraint(lambda t, y, args: y @ y - args**2)
    y = radius * jnp.array([0.9, 1.2])
    assert mj.constraint_violation(circle, 0.0, y, radius) > 0.1 * radius
    p, _ = mj.project(circle, 0.0, y, radius)
    assert abs(np.sqrt(p @ p) / radius - 1) <= 1e-16 / radius


def test_displacements_pass_through_zero():
    """Why the scale has a floor: of a length of order one rounding errors remain."""
    rod = mj.Constraint(lambda t, y, args: (y + args) @ (y + args) - 1.0)
    place = jnp.array([0.6, 0.8])
    for size in (1e-2, 1e-5, 1e-9, 0.0):
        _, info = mj.project(rod, 0.0, size * jnp.array([1.0, 0.3]), place)
        assert bool(info.success)


def test_failed_lane_leaves_the_others_alone():
    radius2 = jnp.array([1.0, -1.0, 4.0])
    constraint = mj.Constraint(lambda t, y, args: y @ y - args)
    y = jnp.array([0.6, 0.9])
    p, info = jax.vmap(lambda a: mj.project(constraint, 0.0, y, a, throw=False))(radius2)
    good, _ = jax.vmap(lambda a: mj.project(constraint, 0.0, y, a))(jnp.array([1.0, 1.0, 4.0]))
    assert info.success.tolist() == [True, False, True]
    assert np.array_equal(p[0], good[0])
    assert np.array_equal(p[2], good[2])


@pytest.mark.parametrize("m", [1, 3, 8, 9, 11])
def test_row_counts_around_the_unrolled_limit(m):
    """m = 1, m = n - 1, and both sides of the switch to library routines."""
    n = 12
    rng = np.random.default_rng(m)
    C = jnp.asarray(rng.normal(size=(m, n)))
    constraint = mj.Constraint(lambda t, y, args: C @ jnp.sin(y) + 0.1 * (y @ y) - 0.1)
    y = jnp.asarray(0.01 * rng.normal(size=n))
    p, info = mj.project(constraint, 0.0, y)
    residual = np.asarray(C) @ np.sin(p) + 0.1 * np.sum(np.square(p)) - 0.1
    assert bool(info.success)
    assert np.abs(residual).max() <= 1e-14
    jac = jax.jacfwd(lambda y: mj.project(constraint, 0.0, y)[0])(y)
    back = jax.jacrev(lambda y: mj.project(constraint, 0.0, y)[0])(y)
    np.testing.assert_allclose(jac, back, atol=1e-12)
    G = jax.jacfwd(lambda y: constraint(0.0, y))(p)
    np.testing.assert_allclose(G @ jac, 0, atol=1e-12)
