"""What a correction costs in evaluations, counted while the solve runs."""

import collections

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optimized import optimized_jit

import manifold_jax as mj
from manifold_jax._solver.step import explicit


RIGID_BODY = mj.problems.rigid_body()


def counted_solve(hook, solver):
    """Evaluations of the field, of the residual and of its Jacobian in an adaptive solve."""
    counts = collections.Counter()

    def tick(name):
        jax.debug.callback(lambda: counts.update([name]))

    def field(t, y, args):
        tick("field")
        return RIGID_BODY.terms.vf(t, y, args)

    @jax.custom_jvp
    def residual(t, y, args):
        tick("residual")
        return y @ y - 1.0

    @residual.defjvp
    def jacobian(primals, tangents):
        (_, y, _), (_, dy, _) = primals, tangents
        tick("jacobian")
        return y @ y - 1.0, 2 * y @ dy

    sol = dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver if hook is None else hook(solver, mj.Constraint(residual)),
        0.0,
        5.0,
        4.0,  # too large: rejected
        RIGID_BODY.y0,
        RIGID_BODY.args,
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
    )
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    return counts, sol.stats


@pytest.mark.parametrize(("solver", "stages"), [(dfx.Dopri5(), 6), (dfx.Heun(), 2)], ids=str)
def test_projection_costs_no_field_and_one_jacobian_per_step(solver, stages):
    plain, stats = counted_solve(None, solver)
    projected, projected_stats = counted_solve(mj.Projected, solver)
    attempted = projected_stats["num_steps"]
    assert projected_stats["num_rejected_steps"] > 0
    first = 1 if stages == 6 else 0  # of a method whose last stage is the first of the next step
    assert plain["field"] in (stages * stats["num_steps"] + np.arange(first, 2 * first + 1))
    assert projected["field"] == stages * attempted + first
    assert projected["jacobian"] == attempted
    # at least twice: before, and after an iteration; twenty iterations are the limit
    assert 2 * attempted <= projected["residual"] <= 21 * attempted


@pytest.mark.usefixtures("traced_anew")
def test_the_derivative_of_a_stage_is_computed_once(monkeypatch):
    """XLA copies products into every kernel that needs them, but no division (`derivative_once`). If this
    fails as the counts are equal, the division is not needed any more."""
    problem = mj.problems.pendulum()
    solver = mj.Projected(dfx.Tsit5(), problem.constraint)

    def end(scale):
        y0 = jax.tree.map(lambda leaf: scale * leaf, problem.y0)
        state = solver.init(problem.terms, 0.0, 0.1, y0, problem.args)
        step = solver.step(problem.terms, 0.0, 0.1, y0, problem.args, state, made_jump=False)
        return step[0][0][0]

    def operations():
        jax.clear_caches()
        gradients = optimized_jit(jax.vmap(jax.grad(lambda scale: end(scale))))
        analysis = gradients.lower(jnp.linspace(0.9, 1.1, 8)).compile().cost_analysis()
        return (analysis[0] if isinstance(analysis, list) else analysis)["flops"]

    kept = operations()
    monkeypatch.setattr(explicit, "derivative_once", lambda y, like: y)
    assert kept < 0.85 * operations()
