"""Riccati equations of `regulate` over long intervals, in which the free motion would grow without bound."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj
from manifold_jax._applications.riccati import solve_riccati


def _field(rates, t, y, inputs):
    return rates[0] @ y + rates[1] @ inputs


def at_rest(A, B, times, **weights):
    """The regulator of `y' = A y + B u` at the origin."""
    A, B = jnp.asarray(A), jnp.asarray(B)
    term = dfx.ODETerm(jtu.Partial(_field, (A, B)))
    ys, inputs = jnp.zeros((len(times), A.shape[0])), jnp.zeros((len(times), B.shape[1]))
    return mj.regulate(term, None, jnp.asarray(times), ys, inputs, **weights)


def algebraic(A, B, q, r):
    """The solution of the algebraic Riccati equation, and its gains."""
    S = scipy.linalg.solve_continuous_are(A, B, q * np.eye(len(A)), r * np.eye(B.shape[1]))
    return S, B.T @ S / r


UPRIGHT = np.array([[0.0, 1.0], [9.81, 0.0]])
PUSHED = np.array([[0.0], [1.0]])


def test_a_pendulum_upright_for_long():
    """The free motion grows by up to `exp(313)`, the slow and the fast controlled ones are as 1 to 3000."""
    for lever, r, length in (
        (1.0, 0.1, 1.0),
        (1.0, 0.006, 1.0),
        (5.0, 0.1, 1.0),
        (1.0, 0.1, 4.0),
        (1.0, 0.1, 100.0),
        (1.0, 1e-6, 1.0),
    ):
        B = lever * PUSHED
        S, gains = algebraic(UPRIGHT, B, 10.0, r)
        weights = dict(state_weights=10.0, input_weights=r, final_weights=S)
        found = at_rest(UPRIGHT, B, [0.0, length], **weights)
        np.testing.assert_allclose(found.gains[0], gains, rtol=1e-8)
        np.testing.assert_array_equal(found.riccati, jnp.swapaxes(found.riccati, 1, 2))


def test_seven_joints():
    """An arm upside down, whatever the weights at the end: its fastest motion grows by `exp(29)`."""
    rng = np.random.default_rng(0)
    inertia, weight, input_matrix = (rng.normal(size=(7, 7)) for _ in range(3))
    mass = inertia @ inertia.T + 0.5 * np.eye(7)
    falling = np.linalg.solve(mass, weight @ weight.T)
    A = np.block([[np.zeros((7, 7)), np.eye(7)], [falling, -np.linalg.inv(mass) / 2]])
    B = np.concatenate([np.zeros((7, 7)), np.linalg.solve(mass, input_matrix)])
    assert np.linalg.eigvals(A).real.max() > 2.9
    gains = algebraic(A, B, 10.0, 0.1)[1]
    found = at_rest(A, B, [0.0, 4.0, 10.0], state_weights=10.0, input_weights=0.1)
    np.testing.assert_allclose(found.gains[0], gains, rtol=1e-7, atol=1e-7 * np.abs(gains).max())


def test_derivatives_over_a_long_interval():
    """The gain of the angle by the length of the pendulum, in both modes against differences."""

    def gain(rate):
        A = jnp.array([[0.0, 1.0], [0.0, 0.0]]).at[1, 0].set(rate)
        return at_rest(A, PUSHED, [0.0, 20.0], state_weights=10.0, input_weights=0.1).gains[0, 0, 0]

    closed = lambda rate: rate + np.sqrt(rate**2 + 100)  # of the algebraic equation
    gain = jax.jit(gain)
    assert gain(9.81) == pytest.approx(closed(9.81), rel=1e-12)
    slope = 1 + 9.81 / np.sqrt(9.81**2 + 100)
    assert jax.grad(gain)(9.81) == pytest.approx(slope, rel=1e-10)
    assert jax.jvp(gain, (9.81,), (1.0,))[1] == pytest.approx(slope, rel=1e-10)


def test_intervals_of_different_lengths_in_single_precision():
    """A short interval is not divided as a long one needs it; where rounding would be felt nothing is returned."""

    def first(length):
        one = jnp.ones((3, 1, 1), jnp.float32)
        ts = jnp.array([0.0, 1.0, 1.0 + length], jnp.float32)
        return solve_riccati(ts, one, one, one, jnp.zeros((1, 1), jnp.float32))[0, 0, 0]

    assert first(1e4) == pytest.approx(1 + np.sqrt(2), rel=1e-5)
    assert np.isnan(first(1e6))


def test_growth_that_costs_nothing():
    """The least effort that holds a pendulum upright reflects its growing motion. In one interval rounding
    would remove what decays; the message says from which time on, and more times help."""
    weights = dict(state_weights=0.0, input_weights=0.1, final_weights=1.0)
    with pytest.raises(ValueError, match="cannot be solved from t = 1 on backwards"):
        at_rest(UPRIGHT, PUSHED, [0.0, 1.0, 9.0, 10.0], **weights)
    found = at_rest(UPRIGHT, PUSHED, np.linspace(0.0, 10.0, 4), **weights)
    np.testing.assert_allclose(found.gains[0, 0], [2 * 9.81, 2 * np.sqrt(9.81)], rtol=1e-9)
