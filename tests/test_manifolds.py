"""Constraints that correct themselves by a formula, those of the package and those of anybody else."""

from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj


NEWTON = mj.NewtonProjection()
TIGHT = dfx.PIDController(rtol=1e-9, atol=1e-9)


def rotation(seed=0, n=3):
    A = np.random.default_rng(seed).normal(size=(n, n))
    return scipy.linalg.expm(A - A.T)


def nearby(seed, size, shape=(3, 3)):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rotation(seed, shape[0])[:, : shape[1]] + size * rng.normal(size=shape))


def polar(Y):
    U, _, Vt = np.linalg.svd(Y, full_matrices=False)
    return U @ Vt


@pytest.mark.parametrize("shape", [(3, 3), (5, 2), (10, 9)])
def test_the_nearest_matrix_is_the_polar_factor(shape):
    Y = nearby(1, 1e-2, shape)
    p, info = mj.Stiefel().correct(NEWTON, 0.0, Y)
    np.testing.assert_allclose(p, polar(Y), rtol=0, atol=2e-15)
    assert info.success
    assert info.iterations == 0
    far = 40 * jnp.asarray(np.random.default_rng(2).normal(size=shape))
    p, info = mj.project(mj.Stiefel(), 0.0, far)
    np.testing.assert_allclose(p, polar(far), rtol=0, atol=1e-13)
    assert info.success


def test_the_nearest_point_of_a_sphere():
    y = {"a": jnp.array([1.0, -2.0]), "b": jnp.array(0.5)}
    size = np.sqrt(1 + 4 + 0.25)
    p, info = mj.project(mj.Sphere(jnp.asarray(3.0)), 0.0, y)
    np.testing.assert_allclose(p["a"], 3 * np.array([1.0, -2.0]) / size, rtol=1e-15)
    np.testing.assert_allclose(p["b"], 1.5 / size, rtol=1e-15)
    assert info.success


CASES = {
    "sphere": (mj.Sphere(1.5), jnp.array([0.9, -1.1, 0.4])),
    "stiefel": (mj.Stiefel(), nearby(3, 5e-2)),
    "product": (
        mj.Product({"turn": mj.Stiefel(), "axis": mj.Sphere(), "speed": None}),
        {"turn": nearby(4, 5e-2, (3, 2)), "axis": jnp.array([0.3, 0.9]), "speed": jnp.ones(2)},
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("far", [False, True])
def test_derivatives(name, far):
    """Forward = reverse = differences, to second order; off the manifold and on it."""
    constraint, y = CASES[name]
    x, unravel = jax.flatten_util.ravel_pytree(y)
    v = jnp.asarray(np.random.default_rng(5).normal(size=x.shape))

    @jax.jit
    def f(x):
        p, _ = constraint.correct(NEWTON, 0.0, unravel(x), far=far)
        return jax.flatten_util.ravel_pytree(p)[0]

    forward, reverse = jax.jit(jax.jacfwd(f)), jax.jit(jax.jacrev(f))
    for at in (x, f(x)):
        np.testing.assert_allclose(forward(at), reverse(at), atol=1e-14)
        differences = (f(at + 1e-6 * v) - f(at - 1e-6 * v)) / 2e-6
        np.testing.assert_allclose(reverse(at) @ v, differences, atol=2e-9)
    second = jax.jvp(lambda x: forward(x) @ v, (x,), (v,))[1]
    differences = (forward(x + 1e-6 * v) - forward(x - 1e-6 * v)) @ v / 2e-6
    np.testing.assert_allclose(second, differences, atol=2e-8)


@pytest.mark.parametrize("name", CASES)
def test_a_point_on_the_manifold_stays_where_it_is(name):
    constraint, y = CASES[name]
    there, _ = mj.project(constraint, 0.0, y)
    again, info = constraint.correct(NEWTON, 0.0, there)
    jax.tree.map(np.testing.assert_array_equal, there, again)
    assert info.correction == 0


@pytest.mark.parametrize(
    ("constraint", "y", "fallback"),
    [
        (mj.Sphere(), jnp.zeros(3), jnp.array([1.0, 0.0, 0.0])),
        (mj.Sphere(), jnp.full(3, jnp.nan), jnp.array([1.0, 0.0, 0.0])),
        (mj.Stiefel(), 1e200 * jnp.eye(3), jnp.eye(3)),
        (mj.Stiefel(), jnp.full((3, 3), jnp.nan), jnp.eye(3)),
        (mj.Product((mj.Stiefel(),)), (1e200 * jnp.eye(3),), (jnp.eye(3),)),
    ],
)
def test_failure_leaves_the_point_and_a_zero_cotangent_zero(constraint, y, fallback):
    run = lambda y: constraint.correct(NEWTON, 0.0, y, fallback=fallback)
    (p, info), pullback = jax.vjp(run, y)
    assert not info.success
    jax.tree.map(np.testing.assert_array_equal, p, y)
    zeros = jax.tree.map(
        lambda x: (
            jnp.zeros_like(x)
            if jnp.issubdtype(x.dtype, jnp.floating)
            else np.zeros(x.shape, jax.dtypes.float0)
        ),
        info,
    )
    (bar,) = pullback((jax.tree.map(jnp.zeros_like, p), zeros))
    assert all(np.all(np.asarray(leaf) == 0) for leaf in jax.tree.leaves(bar))


def tumbling(t, y, rate):
    """A rotation matrix and a unit vector that turn, and how far in all."""
    R, u, _ = y
    w = rate * jnp.stack([jnp.sin(t), 0.4 * jnp.ones_like(t), jnp.cos(2 * t) * u[0]])
    hat = jnp.cross(w[:, None], jnp.eye(3), axisa=0, axisb=0, axisc=0)
    return R @ hat, jnp.cross(w, u), jnp.sum(w * w)


FREE = (mj.Stiefel(), mj.Sphere(), None)
START = (jnp.asarray(rotation(6)), jnp.array([0.6, 0.0, 0.8]), jnp.array(0.0))


def orthonormal(t, y, args):
    R, u, _ = y
    return (R.T @ R - jnp.eye(3))[jnp.triu_indices(3)], u @ u - 1


def tumbled(constraint, rate, **options):
    return mj.diffeqsolve(
        dfx.ODETerm(tumbling),
        mj.Projected(dfx.Tsit5(), constraint),
        0.0,
        4.0,
        None,
        START,
        rate,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 9)),
        stepsize_controller=TIGHT,
        max_steps=512,
        **options,
    )


def test_solves_like_newton_without_iterations():
    """Values on the manifold, the same trajectory and gradient, alone and in a batch."""

    def ends(constraint, rate):
        sol = tumbled(constraint, rate)
        return sol.ys[0][-1, 0] @ sol.ys[1][-1], sol

    exact, newton = mj.Product(FREE), mj.Constraint(orthonormal)
    both = [
        jax.jit(jax.value_and_grad(lambda r, c=c: ends(c, r), has_aux=True))
        for c in (exact, newton)
    ]
    ((end, sol), slope), ((expected, other), expected_slope) = (f(1.3) for f in both)
    assert sol.stats["num_projection_iterations"] == 0 < other.stats["num_projection_iterations"]
    assert mj.constraint_violation(newton, sol.ts, sol.ys) < 1e-15
    np.testing.assert_allclose(end, expected, atol=1e-8)
    np.testing.assert_allclose(slope, expected_slope, atol=1e-7)
    batch = jax.jit(jax.vmap(lambda r: tumbled(exact, r).ys[0]))(jnp.array([1.3, 0.2]))
    np.testing.assert_allclose(batch[0], sol.ys[0], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "hook",
    [
        lambda c: mj.LocalCoordinates(dfx.Bosh3(), c),
        lambda c: mj.Stabilized(dfx.Bosh3(), c, stabilization=mj.ExactStabilization(0)),
        lambda c: mj.Projected(dfx.Bosh3(), c, projection=mj.NewtonProjection("error")),
    ],
)
def test_other_approaches_and_metrics(hook):
    """Directions and metrics that the formula knows nothing of are Newton's business."""
    turn = lambda t, y, args: jnp.stack([-y[1], y[0]])
    sol = mj.diffeqsolve(
        dfx.ODETerm(turn),
        hook(mj.Sphere()),
        0.0,
        1.0,
        None,
        jnp.array([1.0, 0.0]),
        stepsize_controller=dfx.PIDController(rtol=1e-7, atol=1e-7),
    )
    np.testing.assert_allclose(sol.ys[0], [np.cos(1), np.sin(1)], atol=1e-6)
    np.testing.assert_allclose(sol.ys[0] @ sol.ys[0], 1, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", ["sphere", "stiefel"])
def test_weights(name):
    """Given as an array of NumPy, too: the same as for the residual alone."""
    constraint, y = CASES[name]
    y, _ = mj.project(constraint, 0.0, y)
    weights = np.random.default_rng(3).uniform(1.0, 3.0, y.shape)
    projection = mj.NewtonProjection(metric=weights)
    correct = lambda c: c.correct(projection, 0.0, 1.01 * y)[0]
    plain = mj.Constraint(lambda t, y, args: constraint(t, y, args))
    np.testing.assert_allclose(correct(constraint), correct(plain), rtol=0, atol=1e-14)
    nearest, _ = constraint.correct(NEWTON, 0.0, 1.01 * y)
    assert np.abs(correct(constraint) - nearest).max() > 1e-4


class Cylinder(mj.AbstractConstraint):
    """Of somebody else: `y_0^2 + y_1^2 = 1`, corrected by a division."""

    redundant: ClassVar[bool] = False

    def __call__(self, t, y, args=None):
        return y[0] ** 2 + y[1] ** 2 - 1

    def correct(self, projection, t, y, args=None, *, fallback=None, far=False, directions=None):
        p = y.at[:2].divide(jnp.sqrt(y[0] ** 2 + y[1] ** 2))
        residual = jnp.abs(self(t, p, args))
        return p, mj.ProjectionInfo.of_formula(y, p, residual, jnp.all(jnp.isfinite(p)))

    def faults(self, t, y, args=None):
        return ((y[0] ** 2 + y[1] ** 2 == 0, "`{y}` is on the axis of the cylinder."),)


def test_a_constraint_of_somebody_else():
    helix = lambda t, y, args: jnp.stack([-y[1], y[0], 0.1 * jnp.ones_like(t)])
    start = jnp.array([1.0, 0.0, 0.0])
    solve = lambda y0: mj.diffeqsolve(
        dfx.ODETerm(helix), mj.Projected(dfx.Tsit5(), Cylinder()), 0.0, 3.0, 0.1, y0
    )
    np.testing.assert_allclose(solve(start).ys[0], [np.cos(3), np.sin(3), 0.3], atol=1e-6)
    with pytest.raises(RuntimeError, match="`y0` is on the axis of the cylinder"):
        solve(jnp.zeros(3))


@pytest.mark.usefixtures("as_a_user_meets_it")
@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: mj.Sphere(-1.0), ValueError, "`radius` must be positive"),
        (lambda: mj.project(mj.Stiefel(), 0.0, jnp.ones((2, 3))), ValueError, "n >= k"),
        (lambda: mj.project(mj.Stiefel(), 0.0, (jnp.eye(2),)), ValueError, "`mj.Product`"),
        (lambda: mj.Product((lambda y: y,)), TypeError, "mj.Constraint"),
        (lambda: mj.Product((None, None)), ValueError, "no constraint"),
        (lambda: mj.project(mj.Product((mj.Sphere(),)), 0.0, jnp.ones(3)), ValueError, "parts"),
    ],
)
def test_bad_arguments(build, error, message):
    with pytest.raises(error, match=message):
        build()
