"""Every approach with its gradient in a batch, compiled as users compile: most other tests run without
XLA's optimizations."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optimized import optimized_jit
from variants import variants

import manifold_jax as mj


HOOKS = {
    "projected": mj.Projected,
    "invariant": lambda solver, g: mj.Stabilized(
        solver, g, stabilization=mj.InvariantStabilization(3.0)
    ),
    "exact": lambda solver, g: mj.Stabilized(solver, g, stabilization=mj.ExactStabilization(3.0)),
    "tangent": mj.LocalCoordinates,
    "partition": lambda solver, g: mj.LocalCoordinates(
        solver, g, chart=mj.CoordinatePartitionChart()
    ),
}
ON_THE_MANIFOLD = ("projected", "tangent", "partition")


@pytest.mark.parametrize("hook", variants(HOOKS, ["projected"]))
def test_every_approach_and_its_gradient_in_a_batch(hook):
    """The gradient is that of differences between lanes; equal lanes are equal to the last bit."""
    problem = mj.problems.pendulum()
    solver = HOOKS[hook](dfx.Bosh3(), problem.constraint)

    def end(gravity):
        sol = mj.diffeqsolve(
            problem.terms,
            solver,
            0.0,
            1.0,
            0.05,
            problem.y0,
            problem.args._replace(gravity=gravity),
            max_steps=32,
            throw=False,
        )
        q, v = (leaf[0] for leaf in sol.ys)
        success = sol.result == dfx.RESULTS.successful
        return q[0] + 0.3 * v[1], (jnp.stack([q @ q - 1, q @ v]), success)

    h = 1e-3
    gravities = 9.81 + h * jnp.array([0.0, 1.0, -1.0, 2.0, -2.0, 0.0])
    batch = optimized_jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))
    (values, (violations, success)), gradients = batch(gravities)
    assert np.all(success)
    assert values[0] == values[-1]
    assert gradients[0] == gradients[-1]
    _, right, left, right2, left2, _ = np.asarray(values)
    difference = (8 * (right - left) - (right2 - left2)) / (12 * h)
    np.testing.assert_allclose(gradients[0], difference, rtol=1e-8)
    if hook in ON_THE_MANIFOLD:
        assert np.abs(violations).max() <= 2e-15
