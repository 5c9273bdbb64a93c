"""Reverse mode as users run it, adaptive steps and no `adjoint`: that of forward mode, alone and in a
batch, whatever approach, solver, tolerance and `SaveAt`."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optimized import medium_jit, optimized_jit

import manifold_jax as mj


PENDULUM = mj.problems.pendulum()
HOOKS = {
    "plain": lambda solver, g: solver,
    "projected": mj.Projected,
    "one-step": lambda solver, g: mj.Projected(
        solver, g, projection=mj.NewtonProjection(max_steps=1)
    ),
    "invariant": lambda solver, g: mj.Stabilized(
        solver, g, stabilization=mj.InvariantStabilization(3.0)
    ),
    "exact": lambda solver, g: mj.Stabilized(solver, g, stabilization=mj.ExactStabilization(3.0)),
    "tangent": mj.LocalCoordinates,
    "partition": lambda solver, g: mj.LocalCoordinates(
        solver, g, chart=mj.CoordinatePartitionChart()
    ),
}
SOLVERS = {"Tsit5": dfx.Tsit5(), "Kvaerno5": dfx.Kvaerno5(), "KenCarp4": dfx.KenCarp4()}
TIMES = dfx.SubSaveAt(ts=jnp.array([0.1, 0.7, 1.3]))
FUNCTION = dfx.SubSaveAt(ts=jnp.array([0.4, 1.1]), t1=True, fn=lambda t, y, args: t * y[0] * y[1])
EVERYTHING = dfx.SaveAt(subs=[TIMES, FUNCTION])


def terms_for(solver):
    f = PENDULUM.terms.vector_field
    if not isinstance(solver, dfx.KenCarp4):
        return PENDULUM.terms
    part = lambda share: dfx.ODETerm(
        lambda t, y, args: jax.tree.map(lambda x: share * x, f(t, y, args))
    )
    return dfx.MultiTerm(part(0.3), part(0.7))


def objective(gravity, tolerance, hook, solver, saveat, t1, dense=False, **options):
    sol = mj.diffeqsolve(
        terms_for(solver),
        hook(solver, PENDULUM.constraint),
        0.0,
        t1,
        0.01,
        PENDULUM.y0,
        PENDULUM.args._replace(gravity=gravity),
        saveat=saveat,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        throw=False,
        **options,
    )
    values = jax.tree.leaves(sol.evaluate(0.77) if dense else sol.ys)
    used = [jnp.where(jnp.isfinite(x), jnp.where(jnp.isfinite(x), x, 0), 0) for x in values]
    weights = [jnp.cos(i + jnp.arange(x.size)).reshape(x.shape) for i, x in enumerate(used)]
    return sum(jnp.sum(w * x) for w, x in zip(weights, used)), sol.result == dfx.RESULTS.successful


# Whose reverse mode is compiled as users compile; the rest with the flags in between.
AS_USERS = {("projected", "Tsit5"), ("plain", "Kvaerno5")}


def check(hook, solver, saveat, t1, tolerances, rtol=1e-12, alone=True, **options):
    jit = optimized_jit if (hook, solver) in AS_USERS else medium_jit
    f = lambda *of, **more: objective(
        *of, HOOKS[hook], SOLVERS[solver], saveat, t1, **options, **more
    )
    gravities = jnp.array([9.81, 11.0])
    reverse = jit(jax.grad(f, has_aux=True))
    batch = medium_jit(jax.vmap(jax.grad(f, has_aux=True), in_axes=(0, None)))
    by_forward = medium_jit(jax.jacfwd(lambda *of: f(*of, adjoint=dfx.ForwardMode()), has_aux=True))
    for tolerance in tolerances:
        expected, success = by_forward(gravities[0], tolerance)
        assert success
        if alone:
            np.testing.assert_allclose(reverse(gravities[0], tolerance)[0], expected, rtol)
        np.testing.assert_allclose(batch(gravities, tolerance)[0][0], expected, rtol)


def test_one_gradient():
    """Diffrax's default adjoint is 4e-7 off: it repeats steps with other sizes."""
    check("projected", "Tsit5", EVERYTHING, 1.5, (1e-6, 1e-10))


@pytest.mark.slow
def test_one_gradient_of_all_steps():
    """The ends of the steps depend on rounding, with 1e-16 / 1e-6 of the tolerance, and so do the
    values that are saved there."""
    check("projected", "Tsit5", dfx.SaveAt(t0=True, steps=True), 1.5, (1e-6,), rtol=1e-9)


@pytest.mark.slow
def test_one_gradient_of_the_dense_solution():
    check("projected", "Tsit5", dfx.SaveAt(dense=True), 1.5, (1e-10,), dense=True)


@pytest.mark.slow
@pytest.mark.parametrize("hook", HOOKS)
def test_one_gradient_at_all_tolerances(hook):
    """In a batch, as it is the same rule alone."""
    tolerances = (1e-6, 1e-8, 1e-10, 1e-12)
    check(hook, "Tsit5", dfx.SaveAt(t1=True), 10.0, tolerances, alone=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hook", "solver", "alone"),
    [("plain", "Kvaerno5", True), ("projected", "KenCarp4", False), ("tangent", "Kvaerno5", False)],
)
def test_one_gradient_of_implicit_solvers(hook, solver, alone):
    """With additive methods the gradients of Diffrax's default adjoint are plainly wrong."""
    check(hook, solver, dfx.SaveAt(t1=True), 2.0, (1e-6, 1e-10), alone=alone)


def test_an_ensemble_with_empty_arrays():
    """In the state and in `args`; as one by one, with gradients."""
    angles = jnp.array([0.1, 0.7, 1.3])
    starts = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1), jnp.zeros((3, 0))
    circle = mj.Projected(dfx.Tsit5(), mj.Constraint(lambda t, y, args: y[0] @ y[0] - 1))
    turn = lambda t, y, args: (args[0] * jnp.stack([-y[0][1], y[0][0]]), y[1])
    rates = jnp.array([1.0, 1.5, 2.0])

    def ends(rates):
        parts = dfx.ODETerm(turn), circle, 0.0, 1.0, 0.25, starts, (rates, jnp.zeros((3, 0)))
        return mj.solve_ensemble(*parts, args_axes=0).ys

    def loss(ends):
        def total(rates):
            x, empty = ends(rates)
            return jnp.sum(x[..., 0]), (x, empty)

        return jax.jit(jax.grad(total, has_aux=True))

    slope, (x, empty) = loss(ends)(rates)
    assert empty.shape[0] == 3
    assert empty.size == 0
    one = lambda y, rate: (
        mj.diffeqsolve(dfx.ODETerm(turn), circle, 0.0, 1.0, 0.25, y, (rate, jnp.zeros(0))).ys
    )
    expected_slope, (expected, _) = loss(lambda rates: jax.vmap(one)(starts, rates))(rates)
    np.testing.assert_allclose(x, expected, rtol=1e-14)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-12)
