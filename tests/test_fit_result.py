"""What `mj.fit` says about its result: whether the model fits, bounds, several starts, progress."""

import re
import tracemalloc

import diffrax as dfx
import fit_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from fit_cases import fit_circle, noisy, positions, START, TRUTH, TS, TURN, Y0

import manifold_jax as mj
from manifold_jax._fit import convergence, optimize
from manifold_jax._fit.parameters import make_transform
from manifold_jax._fit.progress import FitMeter
from manifold_jax._fit.quality import gauss_newton
from manifold_jax._fit.starts import draw_points


SIGMA = 0.02
DATA = noisy(positions(TS), SIGMA)
FAR = {"rate": 4.0, "radius": 2.6}  # more than a turn off at the end of the record


def test_a_local_optimum_is_said_not_to_fit():
    result = fit_circle(DATA, FAR, sigma=SIGMA)
    assert result.success
    assert result.fits is False
    assert result.probability < 1e-300
    assert result.reduced_chi_squared > 100
    first, *rest = str(result).splitlines()
    assert re.match(r"DOES NOT FIT: residuals are 71\.5 times `sigma`; converged", first)
    assert "`starts=8`" in rest[0]
    assert "`segments`" in rest[0]
    # Without `sigma` the residuals are taken for noise, and nothing is claimed.
    unknown = fit_circle(DATA, FAR)
    assert unknown.fits is unknown.probability is unknown.chi_squared is None
    assert str(unknown).startswith("fitted: converged")
    assert "chi" not in str(unknown)


def test_a_right_model_fits():
    result = fit_circle(DATA, sigma=SIGMA)
    expected = np.sum((result.residuals / SIGMA) ** 2)
    np.testing.assert_allclose(result.chi_squared, expected, rtol=1e-12)
    assert result.degrees_of_freedom == DATA.size - 2
    np.testing.assert_allclose(result.probability, scipy.stats.chi2.sf(expected, 60), rtol=1e-10)
    assert 0.01 < result.probability < 0.99
    assert result.fits is True
    text = str(result)
    assert text.startswith("fitted: converged")
    assert f"reduced chi squared {expected / 60:.3g}, probability" in text
    # Failing to converge comes first, then that the residuals are large.
    text = str(fit_circle(DATA, sigma=SIGMA, steps=1, throw=False))
    assert re.match(r"NOT FITTED: residuals are 74\.6 times `sigma`; not converged", text)


def test_several_starts_find_what_one_misses():
    built = []
    for starts in (1, 1, 8):
        before = len(fit_cases.BUILT)
        result = fit_circle(DATA, FAR, sigma=SIGMA, starts=starts)
        built.append(len(fit_cases.BUILT) - before)
    assert built[0] >= built[1] == built[2]  # nothing is compiled for other starts
    assert result.fits
    best, *others = result.starts
    assert len(others) == 7
    assert best.loss == result.history[-1] <= min(row.loss for row in others)
    assert best.parameters == result.parameters
    assert sum(row.start == FAR for row in result.starts) == 1
    np.testing.assert_allclose(best.loss, result.chi_squared / 2, rtol=1e-12)
    text = str(result)
    assert text.count("converged") == 9
    for row in result.starts:
        assert f"{row.loss:.6g}" in text
        assert f"{row.parameters['rate']:.6g}" in text
    same = fit_circle(DATA, FAR, sigma=SIGMA, starts=8)
    assert same.starts == result.starts


def test_starts_are_spread_evenly_and_within_bounds():
    parameters = {"a": 2.0, "b": -4.0, "c": 1.0, "d": 0.0, "e": 3.0}
    lower = {"a": -np.inf, "b": -np.inf, "c": 0.5, "d": -np.inf, "e": 1.0}
    upper = {"a": np.inf, "b": np.inf, "c": np.inf, "d": 2.0, "e": 11.0}
    transform = make_transform(parameters, (lower, upper), False)
    theta = np.asarray(jax.vmap(transform.values)(jnp.asarray(draw_points(transform, 6, 0))))
    np.testing.assert_allclose(theta[0], transform.start, rtol=1e-15)
    a, b, c, d, e = theta[1:].T
    places = [a / 4, b / -8, np.log(2 * (c - 0.5)), np.log((2 - d) / 2), (e - 1) / 10]
    for place, log in zip(places, (False, False, True, True, False)):
        place = (place / np.log(3) + 1) / 2 if log else place
        assert sorted((40 * place).astype(int)) == list(range(40))
    assert not np.array_equal(draw_points(transform, 6, 0), draw_points(transform, 6, 1))


def test_a_start_that_cannot_be_solved_is_left_out():
    """At a rate of 200 there are too many steps; at a third of that there are not."""
    start = {"rate": 200.0, "radius": 2.0}
    options = dict(positive=True, sigma=SIGMA, starts=2, steps=1, throw=False)
    result = fit_circle(DATA, start, **options, seed=1)
    assert result.starts[-1].message == "every solve fails"
    assert result.starts[-1].start == start
    assert not np.any(result.failed)
    with pytest.raises(ValueError, match="every solve from the start values fails"):
        fit_circle(DATA, {"rate": 1e6, "radius": 2.0}, **options)


def radius_from(lower, start=2.6, **options):
    bounds = ({"rate": -np.inf, "radius": lower}, np.inf)
    return fit_circle(DATA, {"rate": 1.1, "radius": start}, bounds=bounds, sigma=SIGMA, **options)


def test_a_parameter_at_its_bound_is_not_undetermined():
    result = radius_from(2.1)
    assert result.parameters["radius"] == 2.1
    assert result.at_bounds == ("radius",)
    assert result.unidentifiable == ()
    assert result.degrees_of_freedom == DATA.size - 1
    assert np.isnan(result.standard_errors["radius"])
    # The other has the error that it has with the radius known.
    expected = SIGMA / np.sqrt(np.sum((2.1 * TS) ** 2))
    np.testing.assert_allclose(result.standard_errors["rate"], expected, rtol=1e-6)
    assert re.search(r"radius +2.1 at its bound", str(result))
    assert "not determined" not in str(result)
    assert "a bound too narrow" in str(result)
    upper = fit_circle(DATA, {"rate": 1.1, "radius": 1.3}, bounds=(0.0, 1.9), sigma=SIGMA)
    np.testing.assert_allclose(upper.parameters["radius"], 1.9, rtol=1e-15)
    assert upper.at_bounds == ("radius",)


@pytest.mark.parametrize("lower", [0.0, 1.99, 1.996])
def test_a_parameter_near_its_bound_is_inside(lower):
    result = radius_from(lower)
    free = fit_circle(DATA, sigma=SIGMA)
    assert result.at_bounds == ()
    np.testing.assert_allclose(
        fit_cases.flat(result.parameters), fit_cases.flat(free.parameters), rtol=1e-6
    )
    np.testing.assert_allclose(
        fit_cases.flat(result.standard_errors), fit_cases.flat(free.standard_errors), rtol=1e-4
    )


@pytest.mark.parametrize("inside", [8e-6, -1e-5, -5e-3])
def test_a_bound_beside_the_minimum(inside):
    """One that is hardly active, or not quite: the other parameter has to move with the one at the bound."""
    ts = np.linspace(0.1, 4, 15)
    data = 2.0 * np.exp(-0.5 * ts) + 0.05 * np.random.default_rng(0).normal(size=15)
    given = (
        dfx.ODETerm(lambda t, y, p: -p["k"] * y),
        {"k": 0.9, "A": 1.5},
        jnp.asarray(ts),
        jnp.asarray(data),
    )
    options = dict(y0=lambda p: p["A"], t0=0.0, sigma=0.05)
    free = mj.fit(*given, **options).parameters["k"]
    lower = float(free) - inside
    result = mj.fit(*given, **options, bounds=({"k": lower, "A": 0.0}, {"k": 3.0, "A": 5.0}))
    residual = lambda p: (p[1] * np.exp(-p[0] * ts) - data) / 0.05
    bounds, tight = ([lower, 0], [3, 5]), dict(xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = scipy.optimize.least_squares(residual, [0.9, 1.5], bounds=bounds, **tight)
    assert result.at_bounds == (("k",) if inside < 0 else ())
    np.testing.assert_allclose([result.parameters["k"], result.parameters["A"]], found.x, rtol=2e-6)


def test_all_parameters_at_bounds():
    bounds = ({"rate": 1.0, "radius": 2.1}, {"rate": 1.4, "radius": 3.0})
    result = fit_circle(DATA, bounds=bounds, sigma=SIGMA)
    assert result.parameters == {"rate": 1.4, "radius": 2.1}
    assert result.at_bounds == ("radius", "rate")
    assert result.degrees_of_freedom == DATA.size


def test_a_parameter_put_on_its_bound_too_early_comes_off_again(monkeypatch):
    free = fit_circle(DATA, sigma=SIGMA)
    monkeypatch.setattr(optimize, "flat", lambda losses: True)
    monkeypatch.setattr(optimize, "driven", lambda *_: np.array([-1, 0]))
    result = radius_from(1.95)
    assert result.at_bounds == ()
    np.testing.assert_allclose(result.parameters["radius"], free.parameters["radius"], rtol=1e-6)


def test_a_record_that_fails_is_no_sign_of_the_minimum():
    """Its constant, beside which all that is left to gain would seem small."""
    J = np.array([[1.0], [1.0], [1.0], [0.0]])
    offset = convergence.relative_offset
    np.testing.assert_allclose(offset(J, np.array([0.1, -0.2, 0.1, 1e9])), 0, atol=1e-14)
    expected = np.sqrt(0.03 / (0.11 - 0.03) * 2)  # along, across, n = 3, N = 1
    np.testing.assert_allclose(offset(J, np.array([0.1, -0.1, 0.3, 1e9])), expected)
    assert offset(J[:1], np.ones(1)) == np.inf


def _leak(t, y, p):
    return p["k"] * (p["c"] - y)


def _level_and_other(t, y, p):
    return {"level": y, "other": p["other"]}


@pytest.mark.parametrize(
    ("unit", "c", "precision"),
    [
        pytest.param(1.0, 1e-8, 0.02, id="small start value"),
        pytest.param(1e-9, 1e-10, 0.02, id="small initial state that is unknown"),
        pytest.param(1.0, 0.1, 1e-8, id="one quantity far more precise than another"),
    ],
)
def test_standard_errors_do_not_depend_on_units(unit, c, precision):
    """`other` is measured itself, the initial level is unknown."""
    ts, noise = np.linspace(0.2, 5, 20), np.random.default_rng(0).normal(size=(2, 20))
    sigma = {"level": precision * unit, "other": 0.5}
    level = unit * (0.5 + 2.5 * np.exp(-0.7 * ts)) + sigma["level"] * noise[0]
    result = mj.fit(
        dfx.ODETerm(_leak),
        {"k": 0.5, "c": c, "other": 1.0},
        ts,
        {"level": level, "other": 3.0 + sigma["other"] * noise[1]},
        y0=jnp.asarray(2.5 * unit),
        fit_initial=True,
        t0=0.0,
        observe=_level_and_other,
        sigma=sigma,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-22),
    )
    k, c, decayed = (
        *(result.parameters[name] for name in "kc"),
        np.exp(-result.parameters["k"] * ts),
    )
    J = np.stack([(c - result.y0) * ts * decayed, 1 - decayed, decayed], axis=1) / sigma["level"]
    lengths = np.linalg.norm(J, axis=0)
    expected = np.sqrt(np.diag(np.linalg.inv((J / lengths).T @ (J / lengths)))) / lengths
    errors = result.standard_errors
    assert result.unidentifiable == ()
    assert result.degrees_of_freedom == 40 - 4
    np.testing.assert_allclose([errors["k"], errors["c"]], expected[:2], rtol=1e-5)
    np.testing.assert_allclose(errors["other"], 0.5 / np.sqrt(20), rtol=1e-6)
    np.testing.assert_allclose([k, c / unit], [0.7, 0.5], atol=0.1)


def _pressure(t, y, p):
    return p["ambient"] + y


def test_standard_errors_beside_a_large_offset():
    """A small overpressure decays beside that of the atmosphere, in Pa."""
    ts, sigma = np.linspace(0.1, 4, 20), 1e-4
    data = 101325 + 0.05 * np.exp(-0.7 * ts) + sigma * np.random.default_rng(0).normal(size=20)
    decay = dfx.ODETerm(lambda t, y, p: -p["k"] * y)
    start, given = {"k": 0.6, "ambient": 101325.1}, dict(y0=jnp.asarray(0.05), t0=0.0, sigma=sigma)
    controller = dfx.PIDController(rtol=1e-10, atol=1e-14)
    result = mj.fit(
        decay, start, ts, data, observe=_pressure, stepsize_controller=controller, **given
    )
    k = result.parameters["k"]
    J = np.stack([-0.05 * ts * np.exp(-k * ts), np.ones_like(ts)], axis=1) / sigma
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    errors = result.standard_errors
    assert result.unidentifiable == ()
    np.testing.assert_allclose([errors["k"], errors["ambient"]], expected, rtol=1e-5)


def test_a_parameter_that_cancels_but_for_rounding_is_not_determined():
    swing = lambda t, y, p: jnp.stack([y[1], -p["mass"] * p["g"] * y[0] / p["mass"]])
    start, truth = {"mass": 3.3, "g": 0.9}, np.stack([np.cos(TS), -np.sin(TS)], axis=1)
    result = mj.fit(dfx.ODETerm(swing), start, TS, noisy(truth, 0.01), y0=Y0, sigma=0.01)
    assert result.unidentifiable == ("mass (+1)",)
    assert np.isinf(result.standard_errors["mass"])
    assert 0 < result.standard_errors["g"] < 0.01


def test_memory_of_standard_errors_grows_with_the_data_only():
    J = np.random.default_rng(0).normal(size=(4000, 3))
    tracemalloc.start()
    found = gauss_newton(J, np.zeros((0, 3)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(found.covariance, np.linalg.inv(J.T @ J), rtol=1e-10)
    assert peak < 20 * J.nbytes


def test_progress_in_a_file_and_on_a_terminal(capsys, monkeypatch):
    fit_circle(DATA, sigma=SIGMA)
    assert capsys.readouterr().out == ""
    fit_circle(DATA, FAR, sigma=SIGMA, starts=2, progress=True)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "fit: compiling the solves"
    assert re.fullmatch(r"fit: compiled in \d+\.\d s", lines[1])
    assert any(re.fullmatch(r"fit: start 2 of 2: converged, \d+ steps, loss .*", x) for x in lines)
    assert not any("\x1b" in line for line in lines)
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    fit_circle(DATA, sigma=SIGMA, progress=True)
    shown = capsys.readouterr().out
    assert "\x1b" in shown
    assert "compiling the solves" in shown
    assert "━" in shown


def test_lines_of_progress_get_rarer(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    with FitMeter(True) as meter:
        meter.begin("fit", 4000)
        for _ in range(4000):
            now[0] += 0.3
            meter.advance(1.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "fit: step 4, loss 1, 1 s"
    assert 30 < len(lines) < 70


def test_inside_transformations_is_refused_with_what_to_do():
    fitted = lambda data: fit_circle(data, sigma=SIGMA).parameters
    message = r"(?s)`fit` cannot be called inside `jax.jit`.*{}.*mj.diffeqsolve.*optimistix"
    with pytest.raises(TypeError, match=message.format("`data` is traced")):
        jax.jit(fitted)(DATA)
    with pytest.raises(TypeError, match=message.format("all numbers are traced")):
        jax.jit(lambda: fitted(DATA))()
    with pytest.raises(TypeError, match=message.format("`data` is traced")):
        jax.vmap(fitted)(DATA[None])


@pytest.mark.slow
def test_inside_a_derivative_through_the_model_is_refused():
    def rate(radius):
        constraint = mj.Constraint(lambda t, y, args: y @ y - radius**2)
        model = lambda parameters: (TURN, constraint)
        return mj.fit(model, {"rate": 1.1}, TS, DATA, y0=Y0).parameters["rate"]

    with pytest.raises(TypeError, match="`fit` cannot be called inside.*`model` is traced"):
        jax.grad(rate)(2.0)


def test_report_and_picture(tmp_path):
    result = fit_circle(positions(TS), START)
    text = str(result)
    assert text.startswith("fitted: converged")
    assert "radius" in text
    assert "+-" in text
    assert len(result.starts) == 1
    assert "starts" not in text
    np.testing.assert_allclose(fit_cases.flat(result.parameters), fit_cases.flat(TRUTH), rtol=1e-7)
    figure = result.plot(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 1000
    assert len(figure.axes) == 3
