"""Problems of the gallery in lanes: three trajectories, each what it is alone."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from variants import variants

import manifold_jax as mj


SIZE = 3
# Too many operations to be written out number by number: they take the way of `diffeqsolve`.
MAPPED = {"four-bar"}
# One of each kind: invariants, equations on velocities, time in the constraint, matrices, mechanisms.
QUICK = ["lotka-volterra", "skate"]
PROBLEMS = [*QUICK, "pendulum", "car-axis", "rotation", "slider-crank", "four-bar", "heavy-top"]


def varied(problem):
    """Other parameters and the starts they lead to; other starts where there are none."""
    if problem.args is None:
        random = np.random.default_rng(0)
        near = lambda x: x[None] + 0.01 * random.normal(size=(SIZE, *x.shape))
        return jtu.tree_map(near, problem.y0), None
    scaled = lambda k: jtu.tree_map(lambda x: x * k, problem.args)
    each = [problem.with_args(scaled(k)) for k in (1.0, 1.03, 0.96)]
    stacked = lambda *leaves: jnp.stack(leaves)
    return (jtu.tree_map(stacked, *(getattr(p, n) for p in each)) for n in ("y0", "args"))


def of(i, tree):
    return jtu.tree_map(lambda x: x[i], tree)


@pytest.mark.parametrize("name", variants(PROBLEMS, QUICK))
def test_each_is_what_it_is_alone(name):
    problem = mj.problems.ALL[name]()
    y0s, args = varied(problem)
    t0, t1 = problem.t0, problem.t0 + (problem.t1 - problem.t0) / 4
    solver = mj.Projected(dfx.Tsit5(), problem.constraint)
    options = dict(
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
        throw=False,
    )
    sol = mj.solve_ensemble(
        problem.terms, solver, t0, t1, None, y0s, args, lanes=2, **options, args_axes=0
    )
    assert sol.execution.startswith("mapped over" if name in MAPPED else "in lanes")
    solve = jax.jit(
        lambda y0, args: mj.diffeqsolve(problem.terms, solver, t0, t1, None, y0, args, **options)
    )
    for i in range(SIZE):
        alone = solve(of(i, y0s), of(i, args))
        assert not sol.failed[i]
        assert sol.stats["num_accepted_steps"][i] == alone.stats["num_accepted_steps"]
        np.testing.assert_allclose(sol.ts[i], alone.ts, rtol=1e-14)
        for a, b in zip(jtu.tree_leaves(of(i, sol.ys)), jtu.tree_leaves(alone.ys), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())
        violation = mj.constraint_violation(
            problem.constraint, sol.ts[i], of(i, sol.ys), of(i, args)
        )
        assert violation <= 4e-16
