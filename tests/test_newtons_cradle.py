"""Newton's cradle: impacts one after the other between balls on rods."""

import diffrax as dfx
import jax
import numpy as np
import pytest

import manifold_jax as mj


PROBLEM = mj.problems.newtons_cradle()


def swing(args, problem=PROBLEM, **options):
    problem = problem.with_args(args)
    return mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        0.0,
        problem.t1,
        None,
        problem.y0,
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        resets=problem.resets,
        max_resets=8,
        **options,
    )


def check_known_solution(problem, least):
    ts = np.linspace(0.0, problem.t1, 9)
    sol = swing(problem.args, problem, saveat=dfx.SaveAt(ts=ts))
    assert sol.resets.number >= least
    assert sol.stats["num_nondifferentiable_resets"] == 0
    for ours, exact in zip(sol.ys, problem.reference(ts), strict=True):
        np.testing.assert_allclose(ours, exact, atol=2e-8)


def test_the_known_solution():
    """Of the standard problem, and of unequal balls."""
    check_known_solution(PROBLEM, 4)
    unequal = mj.problems.newtons_cradle(masses=[1.0, 0.5, 2.0], angles=[-0.5, 0.0, 0.3])
    check_known_solution(unequal, 3)


@pytest.mark.slow
def test_four_balls_without_loss():
    check_known_solution(mj.problems.newtons_cradle(4, restitution=1.0, t1=1.2), 3)


def test_balances_of_each_impact():
    """The rods hold on both sides. They and the contact, whose law is Newton's, account for the change of
    momenta, and the contact alone for that of the energy."""
    sol = swing(PROBLEM.args)
    masses, e = np.asarray(PROBLEM.args.masses), float(PROBLEM.args.restitution)
    assert sol.resets.indices[:4].tolist() == [0, 1, 1, 0]
    for k in range(4):
        before, after = (
            jax.tree.map(lambda x, k=k: np.asarray(x[k]), y)
            for y in (sol.resets.before, sol.resets.after)
        )
        for y in (before, after):
            assert mj.constraint_violation(PROBLEM.constraint, 0.0, y, PROBLEM.args) < 1e-15
        (q, v), (q1, v1), i = before, after, int(sol.resets.indices[k])
        np.testing.assert_array_equal(q, q1)
        rods = np.zeros((3, 3, 2))
        rods[[0, 1, 2], [0, 1, 2]] = q - [[0.0, 0.0], [0.102, 0.0], [0.204, 0.0]]
        normal = np.zeros((3, 2))
        normal[i + 1] = (q[i + 1] - q[i]) / np.linalg.norm(q[i + 1] - q[i])
        normal[i] = -normal[i + 1]
        np.testing.assert_allclose(np.linalg.norm(q[i + 1] - q[i]), 0.1, atol=1e-14)
        closing, opening = np.sum(normal * v), np.sum(normal * v1)
        assert closing < 0
        np.testing.assert_allclose(opening, -e * closing, rtol=1e-12)
        rows = np.concatenate([rods, normal[None]]).reshape(4, 6)
        change = (masses[:, None] * (v1 - v)).reshape(6)
        impulses = np.linalg.lstsq(rows.T, change, rcond=None)[0]
        np.testing.assert_allclose(rows.T @ impulses, change, atol=1e-12)
        energy = 0.5 * np.sum(masses[:, None] * (v1**2 - v**2))
        np.testing.assert_allclose(energy, impulses[3] * (closing + opening) / 2, atol=1e-12)


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    """Through four impacts, by all parameters, in both modes."""
    end = lambda args: swing(args).ys[0][0, 0, 0]
    reverse, forward = jax.jit(jax.grad(end))(PROBLEM.args), jax.jit(jax.jacfwd(end))(PROBLEM.args)
    exact = lambda args: PROBLEM.with_args(args).reference(PROBLEM.t1)[0][0, 0]
    for name in PROBLEM.args._fields:
        ours, value = np.asarray(getattr(reverse, name)), np.asarray(getattr(PROBLEM.args, name))
        np.testing.assert_allclose(ours, getattr(forward, name), rtol=1e-11, atol=1e-11)
        slopes = []
        for unit in np.eye(value.size).reshape(-1, *value.shape):
            moved = lambda s, value=value, unit=unit: value + s * unit
            at = lambda s, moved=moved, name=name: exact(PROBLEM.args._replace(**{name: moved(s)}))
            h = 1e-4 * np.max(value)
            slopes.append((8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h))
        np.testing.assert_allclose(ours.reshape(-1), slopes, rtol=1e-7, atol=1e-7, err_msg=name)


def test_bad_input():
    with pytest.raises(ValueError, match="`balls` must be at least 2"):
        mj.problems.newtons_cradle(1)
    with pytest.raises(ValueError, match=r"`angles` must be a scalar or of shape \(3,\)"):
        mj.problems.newtons_cradle(angles=[0.1, 0.2])
