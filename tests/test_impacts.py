"""Impacts of mechanical systems, whose joints transmit the impulse."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


MASSES = jnp.array([1.0, 2.0, 0.5])


def linkage(t, q, args):
    """A crank of half a metre, a rod of one metre and a slider: `q` is (crank, slider, rod)."""
    crank, x, rod = q
    return jnp.stack(
        [x - jnp.cos(rod) - 0.5 * jnp.cos(crank), -jnp.sin(rod) - 0.5 * jnp.sin(crank)]
    )


SYSTEM = mj.MechanicalSystem(
    MASSES, linkage, lambda t, q, v, args: jnp.stack([args[0], 0 * args[0], -0.1 * v[2]])
)
STOP = mj.impact(SYSTEM, lambda t, q, args: args[1] - q[1], lambda args: args[2])
# torque, place of the stop, restitution
ARGS = jnp.array([0.7, 1.3, 0.6])


def hit(args, stop=STOP, **options):
    rod = -np.arcsin(0.5)
    q0 = jnp.array([np.pi / 2, np.cos(rod), rod])
    return mj.diffeqsolve(
        SYSTEM.terms,
        mj.Projected(dfx.Tsit5(), SYSTEM.constraint),
        0.0,
        2.5,
        None,
        (q0, jnp.array([-1.5, 0.0, 0.0])),
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        resets=(stop,),
        max_resets=8,
        **options,
    )


def test_a_slider_crank_against_a_stop():
    """On both sides of each impact the joints hold to round-off; the impulse is one of the joints and of
    the contact, which does all the work."""
    sol = hit(ARGS)
    count = int(sol.resets.number)
    assert count >= 1
    for i in range(count):
        t = sol.resets.times[i]
        (q, v), (q1, v1) = (
            jax.tree.map(lambda x, i=i: x[i], s) for s in (sol.resets.before, sol.resets.after)
        )
        for y in ((q, v), (q1, v1)):
            assert mj.constraint_violation(SYSTEM.constraint, t, y, ARGS) < 1e-15
        np.testing.assert_array_equal(q, q1)
        np.testing.assert_allclose(q[1], ARGS[1], atol=1e-14)
        assert v[1] > 0
        np.testing.assert_allclose(v1[1], -0.6 * v[1], rtol=1e-13)
        rows = jnp.concatenate(
            [jax.jacfwd(lambda q, t=t: linkage(t, q, ARGS))(q), jnp.array([[0.0, -1.0, 0.0]])]
        )
        impulse = MASSES * (v1 - v)
        forces = np.linalg.lstsq(rows.T, impulse, rcond=None)[0]
        np.testing.assert_allclose(rows.T @ forces, impulse, atol=1e-13)
        energy = 0.5 * jnp.sum(MASSES * (v1**2 - v**2))
        np.testing.assert_allclose(energy, -forces[2] * (v1[1] + v[1]) / 2, atol=1e-13)


def test_gradient_through_impacts():
    """By torque, place of the stop and restitution, against differences."""
    end = lambda args: hit(args).ys[0][0, 0]
    reverse, forward = jax.jit(jax.grad(end))(ARGS), jax.jit(jax.jacfwd(end))(ARGS)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    h = 1e-4
    for i in range(3):
        at = [end(ARGS.at[i].add(k * h)) for k in (-2, -1, 1, 2)]
        quotient = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
        np.testing.assert_allclose(reverse[i], quotient, rtol=1e-7, atol=1e-7)


def test_impacts_without_end():
    """A pendulum whose bob comes to rest on a floor: the impacts become slower than rounding, and end with
    the code for too many of them."""
    system = mj.MechanicalSystem(
        jnp.ones(2),
        lambda t, q, args: jnp.stack([jnp.sum(q**2) - 1]),
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
    )
    floor = mj.impact(system, lambda t, q, args: q[1] + 0.6 + 0.3 * q[0], 0.4)
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Tsit5(), system.constraint),
        0.0,
        2.0,
        None,
        (jnp.array([1.0, 0.0]), jnp.zeros(2)),
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        resets=(floor,),
        max_resets=60,
        throw=False,
    )
    assert sol.result == dfx.RESULTS.max_steps_reached
    assert sol.resets.number == 60


def test_bad_input(as_a_user_meets_it):
    gap = lambda t, q, args: q[0]
    with pytest.raises(ValueError, match="`restitution` must be between 0 and 1"):
        mj.impact(SYSTEM, gap, 1.5)
    with pytest.raises(TypeError, match="`gap` must be a callable"):
        mj.impact(SYSTEM, 0.0, 0.5)
    with pytest.raises(TypeError, match="`system` must be an `mj.MechanicalSystem`"):
        mj.impact(SYSTEM.constraint, gap, 0.5)
    # An impact that the joints would have to give way to, and a restitution that is none.
    within = mj.impact(SYSTEM, lambda t, q, args: linkage(t, q, args)[0] + 0.1 - 0.1 * t, 0.5)
    for stop, args in ((within, ARGS), (STOP, ARGS.at[2].set(1.5))):
        assert hit(args, stop, throw=False).result == dfx.RESULTS.nonlinear_divergence
