"""Equations that depend on each other, of any constraint: `redundant=True`."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from variants import variants

import manifold_jax as mj


def gravity(t, y, args):
    q, v = y
    return v, -q / jnp.sum(q * q) ** 1.5


def conserved(t, y, args):
    """Energy, angular momentum, and the Laplace vector: three of the four are independent, two on
    a circle."""
    q, v = y
    r = jnp.sqrt(q @ q)
    L = q[0] * v[1] - q[1] * v[0]
    return v @ v / 2 - 1 / r, L, jnp.stack([v[1] * L, -v[0] * L]) - q / r


def orbit(e, tolerance=1e-8, t1=2.0, **options):
    y0 = jnp.stack([1 - e, 0 * e]), jnp.stack([0 * e, jnp.sqrt((1 + e) / (1 - e))])
    constraint = mj.Invariants(conserved, y0=y0, redundant=True)
    sol = mj.diffeqsolve(
        dfx.ODETerm(gravity),
        mj.Projected(dfx.Tsit5(), constraint),
        0.0,
        t1,
        None,
        y0,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, t1, 9)),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        **options,
    )
    return sol, mj.constraint_violation(constraint, sol.ts, sol.ys)


@pytest.mark.parametrize("tolerance", variants([1e-4, 1e-8, 1e-11], [1e-8]))
def test_all_invariants_of_a_planet(tolerance):
    """To round-off, on nearly circular and on very long orbits; exact by Kepler's equation."""
    t1 = 12.0
    run = jax.jit(lambda e: orbit(e, tolerance, t1))
    for e in (0.1, 0.6, 0.9, 0.99):
        sol, violation = run(jnp.asarray(e))
        assert violation < 2e-15, e
        M, E = np.asarray(sol.ts), np.asarray(sol.ts).copy()
        E = M + np.sign(np.sin(M)) * 0.85 * e
        for _ in range(50):
            E = E - (E - e * np.sin(E) - M) / (1 - e * np.cos(E))
        exact = np.stack([np.cos(E) - e, np.sqrt(1 - e * e) * np.sin(E)], axis=1)
        np.testing.assert_allclose(sol.ys[0], exact, atol=2e3 * tolerance)


def test_gradient():
    """Forward = reverse = differences, through the corrections."""
    value = lambda e, adjoint: orbit(e, adjoint=adjoint)[0].ys[0][-1, 0]
    run = jax.jit(jax.value_and_grad(lambda e: value(e, mj.StepReplayAdjoint())))
    e = jnp.asarray(0.6)
    reverse = run(e)[1]
    forward = jax.jit(lambda e: jax.jvp(lambda e: value(e, dfx.ForwardMode()), (e,), (1.0,))[1])(e)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, (run(e + 1e-5)[0] - run(e - 1e-5)[0]) / 2e-5, rtol=1e-6)


def twice(t, y, args):
    """The same circle in two units, and a plane that both circles lie in."""
    return jnp.stack([y @ y - 1, 1e6 * (y @ y) - 1e6, y[2] - 0.6, 2 * y[2] - 1.2])


def test_equations_in_several_units():
    constraint = mj.Constraint(twice, redundant=True)
    p, info = mj.project(constraint, 0.0, jnp.array([0.9, 0.2, 0.5]))
    assert info.success
    np.testing.assert_allclose(p[2], 0.6, atol=1e-15)
    np.testing.assert_allclose(p @ p, 1.0, atol=1e-15)
    slope = jax.jacfwd(lambda y: mj.project(constraint, 0.0, y)[0])(p)
    circle = np.array([-p[1], p[0], 0]) / 0.8  # the only direction that is left
    np.testing.assert_allclose(slope, np.outer(circle, circle), atol=1e-12)


@pytest.mark.parametrize("max_steps", [1, 20])
def test_more_equations_than_components(max_steps):
    """With one Newton step for each step of the solver, too."""
    constraint = mj.Constraint(
        lambda t, y, args: jnp.stack([y @ y - 1, (y @ y) ** 2 - 1, (y @ y) ** 3 - 1]),
        redundant=True,
    )
    sol = mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]])),
        mj.Projected(dfx.Tsit5(), constraint, projection=mj.NewtonProjection(max_steps=max_steps)),
        0.0,
        1.0,
        0.05,
        jnp.array([1.0, 0.0]),
    )
    np.testing.assert_allclose(sol.ys[0], [np.cos(1), np.sin(1)], atol=1e-8)
    np.testing.assert_allclose(sol.ys[0] @ sol.ys[0], 1, atol=1e-14)


def test_accelerations_in_an_equilibrium():
    """A weight at rest at the lower end of a rod given twice, in many directions: what is left of the forces is
    rounding, and no sign of independent equations taken for dependent ones."""
    rod = lambda t, q, args: jnp.outer(jnp.array([1.0, 0.3]), jnp.array([q @ q - 1])).reshape(-1)
    weight = lambda t, q, v, args: 9.81 * args
    system = mj.MechanicalSystem(2.0, rod, weight, redundant=True)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions = jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    still = jnp.zeros(3)
    found = jax.jit(jax.vmap(lambda u: system.accelerations(0.0, (u, still), u)))(directions)
    assert jnp.max(jnp.abs(found)) < 1e-13


def test_contradictions_and_unannounced_redundancy_are_reported():
    contradicting = lambda t, y, args: jnp.stack([y @ y - 1, y @ y - 2])
    with pytest.raises(RuntimeError, match="could not be made consistent"):
        mj.project(mj.Constraint(contradicting, redundant=True), 0.0, jnp.array([1.0, 0.5]))
    doubled = lambda t, y, args: twice(t, y, args)[:2]
    with pytest.raises(RuntimeError, match="redundant"):
        mj.project(mj.Constraint(doubled), 0.0, jnp.array([0.9, 0.2, 0.5]))
    with pytest.raises(ValueError, match="`redundant=True`"):
        mj.project(mj.Constraint(twice), 0.0, jnp.array([0.9, 0.2, 0.5]))
    with pytest.raises(ValueError, match="`constraint` is redundant"):
        mj.LocalCoordinates(dfx.Tsit5(), mj.Constraint(twice, redundant=True))


@pytest.mark.parametrize("mass", [np.array([2.0, 1.0]), np.array([[2.0, 0.3], [0.3, 1.0]])])
def test_equations_that_hold_identically(mass):
    """Two masses that move as one, by -2 N over all the mass, at rest and in motion; the second equation has a
    gradient of rounding."""
    phi = lambda t, q, args: jnp.array([q[0] - q[1], 0.1 * q[0] + 0.7 * q[0] - 0.8 * q[0]])
    force = lambda t, q, v, args: jnp.array([1.0, -3.0])
    system = mj.MechanicalSystem(mass, phi, force, redundant=True)
    both = lambda x: jnp.full(2, x)
    states = jnp.array([(x, v) for x in (0.3, 0.7, 2.2) for v in (0.0, 1.0, -20.0)])
    found = jax.vmap(lambda y: system.accelerations(0.0, (both(y[0]), both(y[1]))))(states)
    np.testing.assert_allclose(found, np.full((9, 2), -2 / mass.sum()), rtol=1e-11)


def test_a_contradiction_without_a_gradient_is_no_rounding():
    """The second equation asks for an acceleration of one, of no coordinate."""
    phi = lambda t, q, args: jnp.array([q[0] - q[1], t**2 / 2])
    force = lambda t, q, v, args: jnp.array([1.0, -3.0])
    system = mj.MechanicalSystem(np.diag([2.0, 1.0]), phi, force, redundant=True)
    assert np.all(np.isnan(system.accelerations(0.0, (jnp.zeros(2), jnp.ones(2)))))
