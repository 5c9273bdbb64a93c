"""Parameters from simulated measurements, and what users get wrong."""

import json
import os
import subprocess
import sys

import diffrax as dfx
import fit_cases
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from fit_cases import (
    CIRCLE,
    circle,
    fit_circle,
    noisy,
    positions,
    START,
    TRUTH,
    TS,
    Y0,
)
from optimized import MEDIUM_FLAGS

import manifold_jax as mj


def assert_close(parameters, truth, tolerance):
    np.testing.assert_allclose(
        fit_cases.flat(parameters), fit_cases.flat(truth), rtol=tolerance, atol=0
    )


def test_noise_free_pendulum_is_recovered():
    """The length is inside the constraint; the data are elliptic functions."""
    problem, ts = mj.problems.pendulum(), np.linspace(0, 2, 41)
    control = dfx.PIDController(rtol=1e-10, atol=1e-10)
    start = {"gravity": 9.81 * 1.3, "length": 0.7}
    result = mj.fit(problem, start, ts, problem.reference(ts), stepsize_controller=control)
    assert result.success
    assert_close(result.parameters, {"gravity": 9.81, "length": 1.0}, 1e-8)
    assert result.names == ("gravity", "length")
    assert result.history[-1] < 1e-12 * result.history[0]
    assert result.noise < 1e-7


def test_standard_errors_are_those_of_the_linear_theory():
    sigma = 0.02
    result = fit_circle(noisy(positions(TS), sigma), sigma=sigma)
    rate, radius = fit_cases.flat(result.parameters)[[1, 0]]
    c, s = positions(TS, rate, 1.0).T
    J = np.stack([np.concatenate([c, s]), radius * np.concatenate([-TS * s, TS * c])], axis=1)
    expected = sigma**2 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(result.covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        fit_cases.flat(result.standard_errors) ** 2, np.diag(expected), rtol=1e-6
    )
    # Unknown noise is estimated: the same estimates, errors by the size of the residuals.
    free = fit_circle(noisy(positions(TS), sigma))
    assert_close(free.parameters, result.parameters, 1e-7)
    assert_close(free.standard_errors, fit_cases.flat(result.standard_errors) * result.noise, 1e-4)
    np.testing.assert_allclose(free.noise, result.noise * sigma, rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.sum(free.residuals**2) / 60), free.noise, rtol=1e-6)
    np.testing.assert_allclose(free.prediction - free.residuals, noisy(positions(TS), sigma))


def test_no_steps_below_the_errors_of_the_solves():
    """Levenberg-Marquardt goes on until a step is accepted, and none is: until `patience` ends it."""
    data = noisy(positions(TS), 0.05)
    coarse = dfx.PIDController(rtol=1e-4, atol=1e-4)
    result = fit_circle(data, sigma=0.05, stepsize_controller=coarse, patience=50)
    exact = fit_circle(data, sigma=0.05)
    assert len(result.history) < 15
    for name, error in exact.standard_errors.items():
        assert abs(result.parameters[name] - exact.parameters[name]) < 0.05 * error


def test_missing_values_have_no_influence():
    data = noisy(positions(TS), 0.02)
    half = data.copy()
    half[3:9, 0] = half[20:, 1] = np.nan
    result = fit_circle(half, sigma=0.02, missing="nan")
    weights = np.where(np.isnan(half), 1e9, 0.02)
    same = fit_circle(data, sigma=weights)
    assert_close(result.parameters, same.parameters, 1e-7)
    assert np.array_equal(np.isnan(result.residuals), np.isnan(half))
    assert not np.any(np.isnan(result.prediction))


ANGLES = np.array([0.3, 2.0, -1.1])
GRID = np.stack([TS, TS + 0.5, 0.8 * TS])
MANY = np.stack([positions(t - t[0], angle=a) for t, a in zip(GRID, ANGLES)])


@pytest.mark.slow
def test_many_trajectories_with_unknown_initial_states():
    guess = positions(np.zeros(3), radius=2.4, angle=ANGLES[:, None] + 0.3)[:, 0]
    result = fit_circle(MANY, ts=GRID, y0=guess, fit_initial=True)
    assert_close(result.parameters, TRUTH, 1e-7)
    np.testing.assert_allclose(result.y0, MANY[:, 0], rtol=0, atol=1e-7)
    radius = float(result.parameters["radius"])
    np.testing.assert_allclose(np.hypot(*result.y0.T), radius, rtol=1e-14)


@pytest.mark.slow
def test_unknown_initial_values_of_invariants():
    """The values of conserved quantities belong to the unknown state."""
    problem, ts = mj.problems.rigid_body(), np.linspace(0, 8, 41)
    data = problem.reference(ts)
    result = mj.fit(
        _body, 1.3, ts, data, y0=jnp.array([0.6, 0.1, 0.7]), fit_initial=True, positive=True
    )
    np.testing.assert_allclose(float(result.parameters), 1.0, rtol=1e-6)
    np.testing.assert_allclose(result.y0, data[0], atol=1e-6)


def _body(middle):
    return mj.problems.rigid_body(inertia=jnp.stack([2.0 + 0 * middle, middle, 2 / 3 + 0 * middle]))


@pytest.mark.slow
def test_optax_with_mini_batches_and_early_stop():
    y0 = positions(np.zeros(1), angle=ANGLES[:, None])[:, 0]
    options = dict(y0=y0, ts=GRID, optimizer=optax.adam(1e-2), sigma=1.0, batch_size=2)
    start = {"rate": 1.3, "radius": 2.3}
    result = fit_circle(MANY, start, steps=1000, **options)
    assert_close(result.parameters, TRUTH, 5e-3)
    assert 30 < result.history.size < 1000
    assert "no more" in result.message
    assert result.standard_errors is not None
    again = fit_circle(MANY, start, steps=1000, **options)
    assert np.array_equal(fit_cases.flat(again.parameters), fit_cases.flat(result.parameters))


def test_many_parameters_are_differentiated_backwards():
    """One step down the gradient of the formula, next to a record that fails."""
    start = jnp.full(60, 1.3 / 60)
    y0 = np.array([[2.0, 0.0], [100.0, 0.0]])
    data = np.stack([positions(TS)] * 2)
    options = dict(ts=np.stack([TS] * 2), optimizer=optax.sgd(1e-3), steps=1, sigma=1.0)
    # the best of the points seen: that before the step, or after it if there are two steps
    result = fit_circle(data, start, y0=y0, model=_summed, **{**options, "steps": 2})
    assert list(result.failed) == [False, True]
    assert result.standard_errors is None
    c, s = positions(TS, 1.3).T
    slope = np.sum((c - GOOD[:, 0]) * -TS * s + (s - GOOD[:, 1]) * TS * c) * 1.3 / 60
    np.testing.assert_allclose(
        fit_cases.flat(result.parameters), 1.3 / 60 * (1 - 1e-3 * slope), rtol=1e-7
    )
    assert result.history[1] < result.history[0] < np.inf


def _summed(parts):
    """A rate that is a sum, on any circle; undefined far out."""
    far = lambda y: jnp.where(jnp.abs(y[0]) > 50, jnp.nan, 1.0)
    field = lambda t, y, args: jnp.sum(parts) * far(y) * jnp.stack([-y[1], y[0]])
    return dfx.ODETerm(field), mj.Invariants(lambda t, y, args: y @ y, y0=jnp.ones(2))


def test_own_loss_is_robust():
    data = noisy(positions(TS), 0.01)
    data[4] += 10.0
    huber = lambda prediction, data, weights: jnp.sum(
        optax.huber_loss(weights * prediction, weights * data)
    )
    optimizer = optx.BFGS(rtol=1e-8, atol=1e-8)
    result = fit_circle(data, sigma=0.01, loss=huber, optimizer=optimizer)
    assert_close(result.parameters, TRUTH, 3e-3)
    assert result.standard_errors is None
    assert abs(fit_circle(data, sigma=0.01).parameters["radius"] - 2) > 0.05


LONG = np.linspace(0, 40, 201)


@pytest.mark.slow
def test_multiple_shooting_finds_what_single_shooting_misses():
    """Thirty turns: with a wrong rate the phases have nothing to do with each other."""
    data = noisy(positions(LONG, 5.0), 0.02)
    start = {"rate": 3.8, "radius": 2.4}
    single = fit_circle(data, start, ts=LONG, sigma=0.02, throw=False)
    assert abs(single.parameters["rate"] - 5.0) > 0.5
    result = fit_circle(data, start, ts=LONG, sigma=0.02, segments=20)
    truth = {"rate": 5.0, "radius": 2.0}
    assert_close(result.parameters, truth, 1e-3)
    # From there single shooting takes no step that matters, and has the same errors.
    single = fit_circle(data, result.parameters, ts=LONG, sigma=0.02)
    assert np.all(
        np.abs(fit_cases.flat(single.parameters) - fit_cases.flat(result.parameters))
        < 0.01 * fit_cases.flat(single.standard_errors)
    )
    assert_close(result.standard_errors, single.standard_errors, 1e-3)
    np.testing.assert_allclose(result.prediction, single.prediction, atol=1e-4)


@pytest.mark.slow
def test_segments_are_started_from_given_states_or_a_solve():
    ts = LONG[:21]
    options = dict(ts=ts, observe=lambda t, y, parameters: y[0], segments=4)
    options["solver"] = lambda constraint: mj.LocalCoordinates(dfx.Tsit5(), constraint)
    options["bounds"] = ({"rate": 3.0, "radius": 1.0}, 8.0)
    data, start = positions(ts, 5.0)[:, 0], {"rate": 4.6, "radius": 2.2}
    truth = {"rate": 5.0, "radius": 2.0}
    assert_close(fit_circle(data, start, **options).parameters, truth, 1e-6)
    result = fit_circle(data, start, states=positions(ts, 5.0) + 0.1, **options)
    assert_close(result.parameters, truth, 1e-6)


def test_failing_trajectories_have_no_influence_and_are_reported():
    y0, both = np.array([[2.0, 0.0], [200.0, 0.0]]), noisy(np.stack([positions(TS)] * 2), 0.01)
    options = dict(ts=np.stack([TS] * 2), model=_summed)
    sigma = np.full(both.shape, 0.01)
    result = fit_circle(both, jnp.asarray(1.2), y0=y0, sigma=sigma, **options)
    assert list(result.failed) == [False, True]
    assert "records 1" in str(result)
    assert np.all(np.isnan(result.prediction[1]))
    assert np.all(np.isfinite(result.prediction[0]))
    sigma[1] = 1e9  # instead of failing
    alone = fit_circle(both, jnp.asarray(1.2), y0=y0[[0, 0]], sigma=sigma, **options)
    assert not np.any(alone.failed)
    assert_close(result.parameters, alone.parameters, 1e-6)
    assert_close(result.standard_errors, alone.standard_errors, 1e-4)


@pytest.mark.slow
def test_steps_into_parameters_that_cannot_be_solved_are_rejected():
    """On a logarithmic scale the first full step overshoots, to where there is no field."""
    tried = []

    def guarded(rate):
        jax.debug.callback(lambda r: tried.append(float(r)), rate)
        defined = jnp.where(rate > 1.6, jnp.nan, rate)
        field = lambda t, y, args: defined * jnp.stack([-y[1], y[0]])
        return dfx.ODETerm(field), mj.Constraint(lambda t, y, args: y @ y - 4.0)

    # Deviations are observed, so that the zeros of a failed solve would be a perfect fit.
    def observe(t, y, rate):
        return y - 2 * jnp.stack([jnp.cos(1.5 * t), jnp.sin(1.5 * t)])

    options = dict(ts=TS / 4, model=guarded, positive=True, observe=observe)
    result = fit_circle(np.zeros((31, 2)), jnp.asarray(0.5), **options)
    assert max(tried) > 1.6
    assert_close(result.parameters, 1.5, 1e-7)
    assert np.all(np.isfinite(result.history))
    assert not np.any(result.failed)


def test_what_the_data_do_not_determine_is_named():
    """Only the product of two numbers matters, and a third does not matter at all."""
    start = {"a": 1.0, "b": 1.1e-3, "radius": 2.5, "unused": 3.0}
    result = fit_circle(positions(TS), start, model=_product, sigma=0.01)
    # In the parameters' own units, and each line of as few as possible.
    ratio = -result.parameters["b"] / result.parameters["a"]
    assert sorted(result.unidentifiable) == [f"a (+1) with b ({ratio:+.3g})", "unused (+1)"]
    errors = result.standard_errors
    assert np.isinf(errors["a"])
    assert np.isinf(errors["b"])
    assert np.isinf(errors["unused"])
    assert 0 < errors["radius"] < 0.01
    assert "not determined by the data" in str(result)
    np.testing.assert_allclose(result.parameters["a"] * result.parameters["b"], 1.5e-3, rtol=1e-6)
    assert not np.any(np.isnan(result.covariance))


@pytest.mark.slow
def test_a_fit_that_diverged_is_returned_without_warnings():
    """A full step of Gauss and Newton where nothing is left of the motion: the rate overflows."""
    decay = dfx.ODETerm(lambda t, y, args: -args["rate"] * y)
    equal = mj.Constraint(lambda t, y, args: y[0] - y[1])
    ts = np.linspace(0, 1, 11)
    result = mj.fit(
        lambda parameters: (decay, equal),
        {"rate": 40.0},
        ts,
        np.exp(-ts)[:, None] * np.ones(2),
        y0=np.ones(2),
        sigma=0.01,
        positive=True,
        optimizer=optx.GaussNewton(rtol=1e-7, atol=1e-7),
        throw=False,
    )
    assert not result.success
    assert str(result).startswith("NOT FITTED")
    assert result.unidentifiable == ("rate",)
    assert np.isinf(result.standard_errors["rate"])


def _product(parameters):
    terms = dfx.ODETerm(lambda t, y, args: 1e3 * args["a"] * args["b"] * jnp.stack([-y[1], y[0]]))
    return terms, CIRCLE


def test_too_few_steps():
    with pytest.raises(RuntimeError, match="(?s)not converged after 2 steps.*`bounds`.*`steps`"):
        fit_circle(positions(TS), steps=2)
    result = fit_circle(positions(TS), steps=2, throw=False)
    assert not result.success
    assert str(result).startswith("NOT FITTED")


GOOD = positions(TS)
HOLED = np.where(np.arange(31)[:, None] == 7, np.nan, GOOD)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            dict(data=GOOD[:-1]),
            ValueError,
            r"`data` must be on the grid `ts`.*\(31, 2\).*`y0`.*\(30, 2\)",
        ),
        (dict(data=GOOD + 1j), ValueError, "`data` must be real numbers, got complex.*z.imag"),
        (dict(sigma=1j * GOOD), ValueError, "`sigma` must be a number, or have the structure"),
        (dict(t0=np.nan), ValueError, "`t0`, the time of the initial state, must be finite"),
        (dict(t0=np.zeros(2)), ValueError, r"`t0`, .*must be a real number.*shape \(2,\)"),
        (dict(data=(GOOD, GOOD)), ValueError, "`data` must have the structure.*`observe"),
        (
            dict(data=HOLED),
            ValueError,
            '`data` has 2 NaN values.*index 7.*`missing="nan"|missing="nan"',
        ),
        (dict(data=np.where(np.isnan(HOLED), np.inf, GOOD), missing="nan"), ValueError, "infinite"),
        (dict(data=GOOD * np.nan, missing="nan"), ValueError, "record 0 has no observed value"),
        (dict(missing="drop"), ValueError, "`missing` must be 'nan' or None"),
        (dict(ts=TS[::-1]), ValueError, "`ts` must be finite and increasing"),
        (dict(ts=TS[0]), ValueError, "`ts` must have shape"),
        (dict(ts=TS[None][:0]), ValueError, "`ts` must have shape"),
        (dict(t0=1.0), ValueError, "`t0`.*must not be after"),
        (dict(sigma=0.0), ValueError, "`sigma` must be positive.*missing"),
        (dict(sigma=(0.1, 0.1)), ValueError, "`sigma` must be a number, or have the structure"),
        (dict(sigma=np.ones(7)), ValueError, "`sigma` must be a number, or have the structure"),
        (dict(y0=None), ValueError, "`y0` is missing.*fit_initial"),
        (dict(parameters={}), ValueError, "`parameters` has no numbers"),
        (dict(parameters={"rate": "fast", "radius": 1.0}), TypeError, "`parameters`.*rate.*str"),
        (dict(parameters={"rate": np.nan, "radius": 1.0}), ValueError, "finite values.*rate"),
        (dict(bounds=(0.0, 2.0)), ValueError, "radius starts at 2.6.*not inside its bounds"),
        (dict(bounds=(3.0, 2.0)), ValueError, "`bounds` of radius are empty"),
        (dict(bounds=3.0), TypeError, "`bounds` must be a pair"),
        (dict(bounds=({"rate": 0.0}, 9.0)), ValueError, "`bounds` must be a number, or"),
        (
            dict(parameters={"rate": -1.0, "radius": 2.0}, positive=True),
            ValueError,
            "rate starts at -1.0.*`positive`",
        ),
        (dict(optimizer=3), TypeError, "`optimizer` must be an Optimistix"),
        (dict(loss=lambda p, d, w: 0.0), ValueError, "`loss` is no sum of squares.*BFGS"),
        (dict(segments=True), ValueError, "`segments` must be a whole number.*got True"),
        (dict(segments=31), ValueError, "`segments` must be a whole number from 1 to 30"),
        (dict(segments=2, optimizer=optax.adam(0.1)), ValueError, "`segments`.*least-squares"),
        (dict(batch_size=1), ValueError, "`batch_size` needs an Optax optimizer"),
        (
            dict(batch_size=0, optimizer=optax.adam(0.1)),
            ValueError,
            "`batch_size` must be a whole number from 1 to 1.*empty",
        ),
        (dict(steps=0), ValueError, "`steps` must be a positive"),
        (dict(model=3.0), TypeError, "`model` must be a problem of the gallery"),
        (dict(model=lambda p: CIRCLE), TypeError, "must return a problem of the gallery"),
        (dict(solver=mj.Projected(dfx.Tsit5(), CIRCLE)), TypeError, "`solver` must not hold"),
        (dict(solver=5), TypeError, "`solver` must be a Diffrax solver"),
        (dict(data=GOOD[:1], ts=TS[:1]), ValueError, "`ts` must have shape"),
        (
            dict(data=np.where(np.arange(62).reshape(31, 2) == 0, GOOD, np.nan), missing="nan"),
            ValueError,
            "`data` has 1 observed values for 2 unknowns",
        ),
    ],
)
def test_bad_input(changes, error, message, as_a_user_meets_it):
    given = dict(model=circle, parameters=START, ts=TS, data=GOOD, y0=Y0)
    given.update(changes)
    with pytest.raises(error, match=f"(?s){message}"):
        mj.fit(**given)


def test_bad_input_for_problems_and_many_records():
    problem, ts = mj.problems.pendulum(), TS
    data = problem.reference(TS)
    with pytest.raises(ValueError, match="(?s)`parameters` of `pendulum`.*'gravity', 'length'"):
        mj.fit(problem, {"weight": 1.0}, ts, data)
    with pytest.raises(ValueError, match="length must have shape"):
        mj.fit(problem, {"length": np.ones(2)}, ts, data)
    with pytest.raises(ValueError, match="`y0` must have a leading axis of 3 records"):
        fit_circle(MANY, ts=GRID)
    with pytest.raises(ValueError, match="`states` must be on the grid"):
        fit_circle(GOOD, segments=2, states=GOOD[:5])


def in_a_process(case):
    """Without type checks, and compiled for programs that run for as long as they compile."""
    environment = os.environ | {"XLA_FLAGS": MEDIUM_FLAGS}
    out = subprocess.run(
        [sys.executable, fit_cases.__file__, case],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("name", fit_cases.ALL)
def test_two_standard_errors_cover_the_truth(name):
    share, error_without_noise = in_a_process(name)
    assert min(share.values()) >= 0.85, share
    assert error_without_noise < 1e-7


@pytest.mark.slow
def test_masses_need_a_known_force():
    """The motion of a free double pendulum tells the ratio of its masses alone."""
    problem = mj.problems.double_pendulum()
    ts = np.linspace(0, 2, 41)
    start = {"masses": np.array([1.2, 0.8])}
    result = mj.fit(problem, start, ts, problem.reference(ts), sigma=0.01, positive=True)
    (line,) = result.unidentifiable
    assert line == "masses[0] (+1) with masses[1] (+1)"


@pytest.mark.slow
def test_chaotic_double_pendulum():
    single, several, standard_errors, noise, success = in_a_process("chaotic")
    assert np.max(np.abs(single)) > 0.2
    assert success
    assert 0.9 < noise < 1.1
    assert np.all(np.abs(several) < 3 * np.asarray(standard_errors))
    assert np.max(np.abs(several)) < 1e-3
