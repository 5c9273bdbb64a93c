"""Single precision: nothing hangs, nothing is NaN, and the manifold is met to its rounding."""

import functools
import warnings

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import outside
import pytest
from variants import variants

import manifold_jax as mj


def single(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def build(name):
    if name == "outside":
        return (
            outside.terms(),
            outside.constraint(),
            single((outside.T0, outside.T1, outside.y0(), outside.parameters())),
        )
    problem = mj.problems.ALL[name]()
    with jax.numpy_dtype_promotion("standard"):  # the start is still in double precision here
        problem = problem.with_args(single(problem.args))
    problem = problem.with_initial(single(problem.y0))
    return (
        problem.terms,
        problem.constraint,
        single((problem.t0, problem.t1, problem.y0, problem.args)),
    )


@pytest.mark.parametrize(
    "name",
    variants(
        ["pendulum", "kepler", "skate", "outside", "rotation", "parallelogram", "heavy-top"],
        ["pendulum", "kepler", "skate", "outside"],
    ),
)
def test_gallery_in_single_precision(name):
    terms, constraint, (t0, t1, y0, args) = build(name)

    ts = jnp.linspace(t0, t1, 50, dtype=jnp.float32)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def solve(y0):
        sol = mj.diffeqsolve(
            terms,
            mj.Projected(dfx.Tsit5(), constraint),
            t0,
            t1,
            None,
            y0,
            args,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
            adjoint=dfx.RecursiveCheckpointAdjoint(),
        )
        end = jax.tree.map(lambda leaf: leaf[-1], sol.ys)
        return jnp.sum(jfu.ravel_pytree(end)[0]), sol.ys

    (_, ys), gradient = solve(y0)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(ys))
    ulp = float(jnp.finfo(jnp.float32).eps)
    assert float(mj.constraint_violation(constraint, ts, ys, args)) <= 20 * ulp
    gradient, _ = jfu.ravel_pytree(gradient)
    assert gradient.dtype == jnp.float32
    assert np.all(np.isfinite(gradient))


def test_projection_tolerance_follows_the_type():
    projection = mj.NewtonProjection()
    assert projection.tolerance_for(jnp.float32) > 1e8 * projection.tolerance_for(jnp.float64)
    p, info = mj.project(
        mj.Constraint(lambda t, y, args: y @ y - 1.0), 0.0, jnp.array([0.7, 0.9], jnp.float32)
    )
    assert p.dtype == jnp.float32
    assert bool(info.success)
    np.testing.assert_allclose(np.sum(np.square(p)), 1, atol=3e-7)


def test_default_tolerances_of_applications():
    """A curve has a fold and a flow a minimum, without a warning of tolerances that nobody gave."""
    fold = lambda x, args: x[:1] - x[:1] ** 3 / 3 - x[1:]
    bowl = lambda x, args: x @ (jnp.array([1.0, 3.0, 7.0], x.dtype) * x) + 0.3 * x[0]
    sphere = mj.Constraint(lambda t, x, args: x @ x - 1)
    start, up = single((jnp.array([-2.0, 2 / 3]), jnp.array([-0.48, 0.6, 0.64])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trace = mj.trace_curve(fold, start, length=3.0, direction=-1)
        least = mj.gradient_flow(bowl, sphere, up)
    np.testing.assert_allclose(trace.turning_points[0], [-1.0, -2 / 3], atol=1e-6)
    np.testing.assert_allclose(least.x, [-1.0, 0.0, 0.0], atol=1e-6)
    assert least.stats["num_steps"] < 60


def test_tolerances_below_rounding():
    """They made steps of rounding size until `max_steps`, or an error that was none."""
    still = dfx.ODETerm(lambda t, y, args: -y)
    y0 = jnp.ones(2, jnp.float32)

    def solve(y0, rtol, atol, function=mj.diffeqsolve):
        controller = dfx.PIDController(rtol, atol)
        options = dict(stepsize_controller=controller, throw=False, max_steps=8)
        times = single((0.0, 0.1))  # those of 64 bits make such a state
        return function(still, dfx.Heun(), *times, None, y0, **options)

    for rtol, atol in ((1e-8, 1e-8), (1e-7, 0.0)):
        with pytest.warns(UserWarning, match="below the rounding of float32.*1e-06.*64"):
            solve(y0, rtol, atol)
    with pytest.warns(UserWarning, match="below the rounding of float32"):
        solve(y0[None], 1e-9, 1e-9, mj.solve_ensemble)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solve(y0, 1e-6, 1e-8)
        solve(y0, jnp.asarray(1e-8), 1e-8)  # unknown while tracing
        solve(jnp.ones(2), 1e-8, 1e-8)
