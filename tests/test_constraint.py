"""Constraints, invariants, the violation, and consistent states."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


def test_violation_is_scaled_by_rows():
    """max_i |g_i| / max_j |G_ij| (|y_j| + 1), by hand."""
    constraint = mj.Constraint(lambda t, y, args: jnp.stack([1e6 * (y[0] - 1), y[1] - t]))
    y = jnp.array([1.001, 3.0])
    # Rows: 1e3 / (1e6 * 2.001) and (3 - 2.5) / 4.
    assert np.isclose(mj.constraint_violation(constraint, 2.5, y), 0.125)
    assert np.isclose(mj.constraint_violation(constraint, 3.0, y), 1e3 / (1e6 * 2.001), rtol=1e-12)


def test_violation_of_a_trajectory_skips_unused_entries():
    circle = mj.Constraint(lambda t, y, args: y @ y - args)
    ts = jnp.array([0.0, 1.0, jnp.inf])
    ys = jnp.array([[1.0, 0.0], [0.0, 1.1], [jnp.inf, jnp.inf]])
    expected = (1.21 - 1.0) / (2 * 1.1 * 2.1)
    assert np.isclose(mj.constraint_violation(circle, ts, ys, 1.0), expected)
    # A NaN at a time that was reached is not hidden.
    broken = ys.at[0, 0].set(jnp.nan)
    assert np.isnan(mj.constraint_violation(circle, ts, broken, 1.0))


def test_invariants_freeze_at_their_start():
    energy = lambda t, y, args: {"energy": args * (y @ y), "first": y[0] * t}
    constraint = mj.Invariants(energy, y0=jnp.array([3.0, 4.0]), t0=2.0, args=0.5)
    residual = constraint(2.0, jnp.array([4.0, 3.0]), 0.5)
    assert float(residual["energy"]) == 0.0
    assert float(residual["first"]) == 2.0


def test_invariants_built_inside_are_differentiated():
    """Built from y0 inside the function, the level moves with y0; outside, it does not."""
    rotation = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
    norm2 = lambda t, y, args: y @ y

    def end_norm(y0, constraint):
        sol = mj.diffeqsolve(rotation, mj.Projected(dfx.Tsit5(), constraint), 0.0, 1.0, 0.1, y0)
        return jnp.linalg.norm(sol.ys[0])

    y0 = jnp.array([3.0, 4.0])
    inside = jax.grad(lambda y0: end_norm(y0, mj.Invariants(norm2, y0=y0)))(y0)
    np.testing.assert_allclose(inside, [0.6, 0.8], rtol=1e-12)
    frozen = mj.Invariants(norm2, y0=y0)
    np.testing.assert_allclose(jax.grad(lambda y0: end_norm(y0, frozen))(y0), 0, atol=1e-14)


def test_consistent_state_of_a_far_start():
    problem = mj.problems.car_axis()
    off = jax.tree.map(lambda leaf: leaf + 0.05, problem.y0)
    y, info = mj.consistent_state(problem.constraint, problem.t0, off, problem.args)
    assert bool(info.success)
    residual = problem.constraint(problem.t0, y, problem.args)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(residual)) <= 1e-15
    again, info = mj.consistent_state(problem.constraint, problem.t0, y, problem.args)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(y)))
    assert float(info.correction) == 0.0


def test_consistent_state_is_differentiable():
    circle = mj.Constraint(lambda t, y, args: y @ y - args)
    y = jnp.array([0.9, 0.8])
    jac = jax.jacrev(lambda y: mj.consistent_state(circle, 0.0, y, 1.0)[0])(y)
    r = np.sqrt(0.81 + 0.64)
    u = np.asarray(y) / r
    np.testing.assert_allclose(jac, (np.eye(2) - np.outer(u, u)) / r, rtol=1e-12)


def test_whole_numbers_as_times():
    """A time that is differentiated (rheonomic constraints of mechanics) has to be floating."""
    system = mj.MechanicalSystem(
        1.0, lambda t, q, args: q @ q - t**2, lambda t, q, v, args: jnp.zeros(2)
    )
    y = jnp.array([1.2, 1.6]), jnp.array([0.3, 0.5])
    correct = lambda constraint, t, y: constraint.correct(mj.NewtonProjection(), t, y)
    for function in (mj.project, mj.consistent_state, correct):
        whole, floating = (function(system.constraint, t, y)[0] for t in (2, 2.0))
        assert all(map(np.array_equal, whole, floating))
        np.testing.assert_allclose(whole[0], [1.2, 1.6], atol=1e-15)
    moved, _ = mj.project(mj.Constraint(lambda t, y, args: y @ y - t), 4, jnp.array([3.0, 4.0]))
    np.testing.assert_allclose(moved, [1.2, 1.6], atol=1e-15)
