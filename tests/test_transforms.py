"""Batches equal single runs, lanes do not touch each other, and nothing is traced twice."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import outside
import pytest
from variants import variants

import manifold_jax as mj


def pendulum_field(t, y, gravity):
    q, v = y
    mu = (v @ v - gravity * q[1]) / (q @ q)
    return v, jnp.stack([-mu * q[0], -gravity - mu * q[1]])


@pytest.mark.parametrize(
    "solver", variants([dfx.Tsit5(), dfx.Bosh3(), dfx.Kvaerno5()], [dfx.Tsit5(), dfx.Kvaerno5()])
)
def test_vmap_equals_single_runs(solver):
    """Lanes take different numbers of steps; a rejected first step must not show elsewhere."""
    problem = mj.problems.pendulum()

    @jax.jit
    def solve(angle):
        y0 = (jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), jnp.zeros(2))
        return mj.diffeqsolve(
            problem.terms,
            mj.Projected(solver, problem.constraint),
            0.0,
            2.0,
            0.3,
            y0,
            problem.args,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 11)),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )

    angles = jnp.array([0.01, 0.4, 1.1, 1.5, 2.5, 3.0])
    batch = jax.jit(jax.vmap(solve))(angles)
    steps = np.asarray(batch.stats["num_accepted_steps"])
    assert len(set(steps.tolist())) >= 4
    for i, angle in enumerate(angles):
        single = solve(angle)
        assert int(single.stats["num_accepted_steps"]) == steps[i]
        for a, b in zip(jax.tree.leaves(single.ys), jax.tree.leaves(batch.ys)):
            np.testing.assert_allclose(a, b[i], rtol=0, atol=1e-12)


def test_vmap_equals_single_runs_outside_the_gallery():
    @jax.jit
    def solve(scale):
        return mj.diffeqsolve(
            outside.terms(),
            mj.Projected(dfx.Dopri5(), outside.constraint()),
            outside.T0,
            outside.T1,
            None,
            outside.y0(),
            outside.parameters(scale * outside.OMEGA),
            stepsize_controller=dfx.PIDController(rtol=1e-7, atol=1e-7),
        )

    scales = jnp.array([0.2, 1.0, 3.0])
    batch = jax.jit(jax.vmap(solve))(scales)
    for i, scale in enumerate(scales):
        single = solve(scale)
        assert int(single.stats["num_steps"]) == int(batch.stats["num_steps"][i])
        for a, b in zip(jax.tree.leaves(single.ys), jax.tree.leaves(batch.ys)):
            np.testing.assert_allclose(a, b[i], rtol=0, atol=1e-12)


def shrinking(t, y, radius2_at_end):
    """A circle whose squared radius goes linearly from 1 to `radius2_at_end` at t = 1."""
    return y @ y - (1 + t * (radius2_at_end - 1))


def shrinking_field(t, y, radius2_at_end):
    rate = 0.5 * (radius2_at_end - 1) / (y @ y)
    return rate * y + jnp.stack([-y[1], y[0]])


@pytest.mark.parametrize("controller", ["adaptive", "constant"])
def test_failing_lane_leaves_the_others_bit_identical(controller):
    """One compiled function; lane 2 is given a circle that ceases to exist, or one that does not."""
    stepsize = (
        dfx.PIDController(rtol=1e-6, atol=1e-6)
        if controller == "adaptive"
        else dfx.ConstantStepSize()
    )

    @jax.jit
    @jax.vmap
    def solve(radius2_at_end):
        return mj.diffeqsolve(
            dfx.ODETerm(shrinking_field),
            mj.Projected(dfx.Tsit5(), mj.Constraint(shrinking)),
            0.0,
            1.0,
            0.01,
            jnp.array([1.0, 0.0]),
            radius2_at_end,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 6)),
            stepsize_controller=stepsize,
            throw=False,
        )

    good = solve(jnp.array([4.0, 0.25, 0.5, 1.0]))
    bad = solve(jnp.array([4.0, 0.25, -1.0, 1.0]))
    ok = lambda sol: np.asarray(sol.result == dfx.RESULTS.successful)
    assert ok(good).tolist() == [True] * 4
    assert ok(bad).tolist() == [True, True, False, True]
    for lane in (0, 1, 3):
        assert np.array_equal(good.ys[lane], bad.ys[lane])
    # The failure is named, found quickly, and no value after it is returned.
    assert np.asarray(bad.result == dfx.RESULTS.nonlinear_divergence)[2]
    assert int(bad.stats["num_steps"][2]) < 300
    assert np.all(np.isinf(bad.ys[2, -2:]))


def test_vmap_of_grad_equals_loop():
    problem = mj.problems.rigid_body()

    def end(y0):
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Tsit5(), mj.Constraint(lambda t, y, args: y @ y - 1.0)),
            0.0,
            2.0,
            0.1,
            y0,
            problem.args,
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )
        return sol.ys[0] @ jnp.array([1.0, 2.0, 3.0])

    y0 = jnp.array([[0.6, 0.0, 0.8], [0.1, 0.7, 0.7], [1.0, 0.2, 0.1]])
    grad = jax.jit(jax.grad(end))
    batch = jax.jit(jax.vmap(jax.grad(end)))(y0)
    for i in range(3):
        np.testing.assert_allclose(batch[i], grad(y0[i]), rtol=1e-10, atol=1e-12)


def test_user_functions_are_traced_a_bounded_number_of_times():
    """Field: once per stage (7), the start, and the first step. Nothing on a second call."""
    field = eqx.debug.assert_max_traces(pendulum_field, max_traces=12)
    residual = eqx.debug.assert_max_traces(
        lambda t, y, args: (y[0] @ y[0] - 1, y[0] @ y[1]), max_traces=30
    )
    terms, constraint = dfx.ODETerm(field), mj.Constraint(residual)
    for gravity in (9.81, 1.62, 3.71):
        mj.diffeqsolve(
            terms,
            mj.Projected(dfx.Tsit5(), constraint),
            0.0,
            1.0,
            None,
            (jnp.array([1.0, 0.0]), jnp.zeros(2)),
            jnp.asarray(gravity),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )
    counts = eqx.debug.get_num_traces(field), eqx.debug.get_num_traces(residual)
    mj.diffeqsolve(
        terms,
        mj.Projected(dfx.Tsit5(), constraint),
        0.0,
        1.0,
        None,
        (jnp.array([0.0, 1.0]), jnp.zeros(2)),
        jnp.asarray(5.0),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    assert counts == (eqx.debug.get_num_traces(field), eqx.debug.get_num_traces(residual))
    print(counts)


def test_two_builds_of_a_problem_share_compiled_code():
    solve = eqx.debug.assert_max_traces(
        lambda problem: mj.project(problem.constraint, problem.t0, problem.y0, problem.args)[0],
        max_traces=1,
    )
    jitted = eqx.filter_jit(solve)
    for gravity in (9.81, 1.62):
        jitted(mj.problems.pendulum(gravity=gravity))


@pytest.mark.parametrize(
    "transform", variants([jax.jit, jax.vmap], [jax.vmap]), ids=["jit", "vmap"]
)
def test_dense_solutions_are_returned_from_transforms(transform):
    """As those of Diffrax; what the constraint closes over goes with them."""

    @transform
    def solve(radius):
        constraint = mj.Constraint(lambda t, y, args: y @ y - radius**2)
        return mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]])),
            mj.Projected(dfx.Tsit5(), constraint),
            0.0,
            1.0,
            0.2,
            radius * jnp.array([1.0, 0.0]),
            saveat=dfx.SaveAt(dense=True),
            max_steps=16,
        )

    radius = jnp.array([1.0, 2.0]) if transform is jax.vmap else jnp.asarray(2.0)
    evaluate = lambda sol, t: sol.evaluate(t)
    if transform is jax.vmap:
        evaluate = jax.vmap(evaluate, in_axes=(0, None))
    sol = solve(radius)
    y = jnp.reshape(jax.jit(evaluate)(sol, 0.33), (-1, 2))
    np.testing.assert_allclose(np.sum(y**2, axis=1), np.ravel(radius) ** 2, rtol=1e-15)
    np.testing.assert_allclose(y[:, 1] / y[:, 0], np.tan(0.33), rtol=1e-5)
