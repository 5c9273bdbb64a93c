"""Symmetric projection: order, reversal, quantities over long times, derivatives, and what it refuses."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


ECCENTRICITY = 0.6
ORBIT = jnp.array([1 - ECCENTRICITY, 0.0]), jnp.array([0.0, 2.0])  # (1 + e) / (1 - e) = 4


def gravity(t, y, args):
    q, v = y
    return v, -q / jnp.sum(q * q) ** 1.5


def energy(y):
    q, v = y
    return jnp.sum(v * v, axis=-1) / 2 - 1 / jnp.sqrt(jnp.sum(q * q, axis=-1))


def momentum(y):
    q, v = y
    return q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]


KEPLER = dfx.ODETerm(gravity)
ON_SHELL = mj.Invariants(lambda t, y, args: energy(y), y0=ORBIT)


def orbit(solver, t1, h, y0=ORBIT, **options):
    t0 = options.pop("t0", 0.0)
    options = {"max_steps": None} | options
    return mj.diffeqsolve(KEPLER, solver, t0, t1, h, y0, **options)


# A circle that breathes, `|y| = 1 + a sin(t)`, and a turn at a rate that varies: not autonomous, and known.
def radius(t, args):
    return 1 + args["amplitude"] * jnp.sin(t)


def breathing(t, y, args):
    rate = args["rate"] * (1 + t)
    stretch = args["amplitude"] * jnp.cos(t) / radius(t, args)
    return rate * jnp.stack([-y[1], y[0]]) + stretch * y


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - radius(t, args) ** 2)
ARGS = {"amplitude": jnp.asarray(0.4), "rate": jnp.asarray(0.8)}


def exact(t, args=ARGS):
    angle = args["rate"] * (t + t * t / 2)
    return radius(t, args) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def breathe(order, t0, t1, steps, args=ARGS, **options):
    parts = dfx.ODETerm(breathing), mj.SymmetricProjection(CIRCLE, order=order)
    y0 = options.pop("y0", exact(t0, args))
    options = {"max_steps": 64} | options
    return mj.diffeqsolve(*parts, t0, t1, (t1 - t0) / steps, y0, args, **options)


@pytest.mark.parametrize(
    "order", [2, pytest.param(4, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("times", [(0.0, 1.5), (1.5, 0.0)])
def test_order(order, times):
    """Forwards and backwards in time."""
    errors = []
    for steps in (16, 32):
        sol = breathe(order, *times, steps)
        errors.append(np.max(np.abs(sol.ys[-1] - exact(times[1]))))
        violation = mj.constraint_violation(CIRCLE, times[1], sol.ys[-1], ARGS)
        assert violation < 1e-15
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.3


def test_it_is_reversible():
    """Ten thousand steps forth and back lead to the start; without what is carried from step to step they miss
    it by 7e-14."""
    solver = mj.SymmetricProjection(ON_SHELL)
    last = lambda sol: jax.tree.map(lambda leaf: leaf[-1], sol.ys)
    forth = orbit(solver, 100.0, 0.01)
    back = orbit(solver, 0.0, -0.01, last(forth), t0=100.0)
    assert forth.stats["num_steps"] == back.stats["num_steps"] == 10_000
    for ours, start in zip(last(back), ORBIT, strict=True):
        np.testing.assert_allclose(ours, start, rtol=0, atol=1e-14)


def test_what_is_not_constrained_has_no_trend():
    """Eighty orbits on the shell of their energy: the angular momentum returns, while with projected steps
    it drifts."""
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 500.0, 2001))
    solvers = mj.SymmetricProjection(ON_SHELL), mj.Projected(dfx.Dopri5(), ON_SHELL)
    drifts = []
    for solver, h in zip(solvers, (0.02, 0.1), strict=True):
        sol = orbit(solver, 500.0, h, saveat=saveat)
        np.testing.assert_allclose(energy(sol.ys), energy(ORBIT), atol=3e-15)
        errors = np.asarray(momentum(sol.ys) - momentum(ORBIT))
        first, last = (np.mean(part) for part in np.split(errors[1:], 2))
        drifts.append(abs(last - first) / np.max(np.abs(errors)))
    assert drifts[0] < 5e-3
    assert drifts[1] > 0.3


@pytest.mark.slow
def test_gradients():
    """In both modes, and against differences, also of a parameter of the constraint."""
    end = lambda args: breathe(2, 0.0, 1.0, 10, args, max_steps=16).ys[-1] @ jnp.array([1.0, 2.0])
    reverse, forward = jax.jit(jax.grad(end))(ARGS), jax.jit(jax.jacfwd(end))(ARGS)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), reverse, forward)
    value = jax.jit(end)
    for name in ARGS:
        at = lambda s, name=name: value({**ARGS, name: ARGS[name] + s})
        slope = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
        np.testing.assert_allclose(reverse[name], slope, rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives():
    end = lambda rate: breathe(2, 0.0, 1.0, 10, {**ARGS, "rate": rate}, max_steps=16).ys[-1][0]
    slope = jax.jit(jax.grad(end))
    difference = (slope(0.8 + 1e-4) - slope(0.8 - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.grad(end)))(0.8), difference, rtol=1e-6)


@pytest.mark.slow
def test_a_batch_is_one_by_one():
    rates = jnp.array([0.3, 0.8, 1.5])
    one = lambda rate: breathe(4, 0.0, 1.0, 10, {**ARGS, "rate": rate}).ys[-1]
    together = jax.jit(jax.vmap(one))(rates)
    for rate, row in zip(rates, together, strict=True):
        np.testing.assert_allclose(row, one(rate), atol=1e-14)
    parts = dfx.ODETerm(breathing), mj.SymmetricProjection(CIRCLE), 0.0, 1.0, 0.1
    starts, args = jnp.stack([exact(0.0)] * 3), ARGS | {"rate": rates}
    axes = {"amplitude": None, "rate": 0}
    ensemble = mj.solve_ensemble(*parts, starts, args, args_axes=axes, max_steps=16)
    assert ensemble.execution == "in lanes"
    for rate, row in zip(rates, ensemble.ys[:, -1], strict=True):
        alone = breathe(2, 0.0, 1.0, 10, {**ARGS, "rate": rate}).ys[-1]
        np.testing.assert_allclose(row, alone, atol=1e-14)


@pytest.mark.slow
def test_saved_values_are_on_the_manifold():
    ts = jnp.linspace(0.0, 1.5, 23)
    sol = breathe(2, 0.0, 1.5, 16, saveat=dfx.SaveAt(ts=ts))
    assert mj.constraint_violation(CIRCLE, ts, sol.ys, ARGS) < 1e-15


@pytest.mark.slow
def test_single_precision():
    """Twenty thousand steps; without what is carried from step to step they end 2e-6 beside the solution."""
    with jax.enable_x64(False):
        args = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float32)), ARGS)
        sol = breathe(2, 0.0, 2.0, 20_000, args, y0=jnp.array([1.0, 0.0]), max_steps=None)
        assert sol.ys.dtype == jnp.float32
        assert mj.constraint_violation(CIRCLE, 2.0, sol.ys[-1], args) < 5e-7
    np.testing.assert_allclose(sol.ys[-1], exact(2.0), rtol=0, atol=6e-7)


def test_bad_input(as_a_user_meets_it):
    with pytest.raises(TypeError, match="`constraint`"):
        mj.SymmetricProjection(dfx.Tsit5())
    with pytest.raises(ValueError, match="`order` must be 2, 4 or 6, got 3"):
        mj.SymmetricProjection(CIRCLE, order=3)
    with pytest.raises(ValueError, match="their multipliers are not determined"):
        mj.SymmetricProjection(mj.Constraint(lambda t, y, args: y @ y - 1, redundant=True))
    terms = dfx.MultiTerm(dfx.ODETerm(breathing), dfx.ODETerm(breathing))
    with pytest.raises(ValueError, match="must be one ordinary differential equation"):
        mj.diffeqsolve(
            terms, mj.SymmetricProjection(CIRCLE), 0.0, 1.0, 0.1, jnp.array([1.0, 0.0]), ARGS
        )
