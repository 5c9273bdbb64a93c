"""Vector fields that leave the manifold by themselves, made tangent."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import outside
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1)
ALONG = jnp.array([1.0, 0.0])


def upwards(t, y, speed):
    """Exact solution with its part normal to the circle taken away: (sech vt, tanh vt)."""
    return jnp.stack([jnp.zeros_like(speed), speed])


def final_error(field, steps):
    solver = mj.Projected(dfx.Tsit5(), CIRCLE)
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        0.0,
        1.5,
        1.5 / steps,
        ALONG,
        jnp.asarray(1.0),
        stepsize_controller=dfx.ConstantStepSize(),
    )
    exact = jnp.array([1 / jnp.cosh(1.5), jnp.tanh(1.5)])
    return float(jnp.linalg.norm(sol.ys[0] - exact))


def test_order_of_the_solver_instead_of_the_first():
    steps = np.array([40, 80, 160])
    slope = lambda errors: np.log2(errors[:-1] / errors[1:])
    raw = np.array([final_error(upwards, n) for n in steps])
    tangent = np.array([final_error(mj.tangent_field(upwards, CIRCLE), n) for n in steps])
    np.testing.assert_allclose(slope(raw), 1, atol=0.2)
    np.testing.assert_allclose(slope(tangent), 5, atol=0.2)


def adaptive(speed, field=None):
    field = mj.tangent_field(upwards, CIRCLE) if field is None else field
    return mj.diffeqsolve(
        dfx.ODETerm(field),
        mj.Projected(dfx.Tsit5(), CIRCLE),
        0.0,
        1.5,
        None,
        ALONG,
        speed,
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9),
        throw=False,
    )


def test_adaptive_steps():
    """Otherwise the steps become tolerance / normal part, and there are too many of them."""
    speed = jnp.asarray(1.0)
    assert adaptive(speed, upwards).result == dfx.RESULTS.max_steps_reached
    sol = adaptive(speed)
    exact = np.array([1 / np.cosh(1.5), np.tanh(1.5)])
    np.testing.assert_allclose(sol.ys[0], exact, atol=1e-8)
    assert int(sol.stats["num_steps"]) < 60


def test_derivative():
    speed = jnp.asarray(0.8)
    exact = lambda v: jnp.stack([1 / jnp.cosh(1.5 * v), jnp.tanh(1.5 * v)])
    reverse = jax.jit(jax.jacrev(lambda v: adaptive(v).ys[0]))(speed)
    np.testing.assert_allclose(reverse, jax.jacrev(exact)(speed), atol=1e-7)


def test_weights_of_a_network_are_leaves():
    """The field may hold what is learned, as well as get it as `args`."""
    network = eqx.nn.MLP(2, 2, 8, 1, key=jax.random.PRNGKey(0))
    solver = mj.Projected(dfx.Tsit5(), CIRCLE)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(network, as_args):
        raw = (lambda t, y, net: net(y)) if as_args else (lambda t, y, args: network(y))
        sol = mj.diffeqsolve(
            dfx.ODETerm(mj.tangent_field(raw, CIRCLE)),
            solver,
            0.0,
            0.5,
            0.1,
            ALONG,
            network if as_args else None,
            stepsize_controller=dfx.ConstantStepSize(),
        )
        return sol.ys[0, 1]

    for a, b in zip(jax.tree.leaves(slope(network, True)), jax.tree.leaves(slope(network, False))):
        np.testing.assert_allclose(a, b, rtol=1e-12)
        assert np.abs(a).max() > 1e-6


def test_tangent_to_a_moving_manifold():
    """G F + dg/dt = 0, with a metric and a state of several leaves."""
    constraint, y, args = outside.constraint(), outside.y0(), outside.parameters()
    field = lambda t, y, args: jax.tree.map(lambda leaf: 1 + jnp.cos(3 * leaf), y)
    tangent = mj.tangent_field(field, constraint)
    t = jnp.asarray(outside.T0)
    moved = tangent(t, y, args)
    g = lambda t, y: constraint(t, y, args)
    _, rate = jax.jvp(g, (t, y), (jnp.ones_like(t), moved))
    _, without = jax.jvp(g, (t, y), (jnp.ones_like(t), field(t, y, args)))
    largest = lambda tree: max(np.abs(leaf).max() for leaf in jax.tree.leaves(tree))
    assert largest(rate) < 1e-13 < 1e-2 < largest(without)
    again = mj.tangent_field(tangent, constraint)(t, y, args)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(moved)):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)
    weights = jax.tree.map(lambda leaf: 2 + jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape), y)
    other = mj.tangent_field(field, constraint, projection=mj.NewtonProjection(metric=weights))
    _, rate = jax.jvp(g, (t, y), (jnp.ones_like(t), other(t, y, args)))
    assert largest(rate) < 1e-13
    assert largest(jax.tree.map(jnp.subtract, other(t, y, args), moved)) > 1e-3


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_wrong_arguments():
    with pytest.raises(TypeError, match="`function` must be a callable"):
        mj.tangent_field(dfx.ODETerm(upwards), CIRCLE)
    with pytest.raises(TypeError, match="`constraint` must be an `mj.Constraint`"):
        mj.tangent_field(upwards, lambda t, y, args: y @ y - 1)
