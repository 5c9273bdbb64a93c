"""Jumps of the state in ensembles, in memory and on disk, and in fits."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj


PID = dfx.PIDController(rtol=1e-9, atol=1e-9)
FALL = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -args["gravity"]]))
BOUNCE = mj.Reset(
    lambda t, y, args: y[0],
    lambda t, y, args: jnp.stack([0 * y[0], -args["restitution"] * y[1]]),
    direction=False,
)
KICK = mj.ResetAt(
    lambda args: args["kicks"], lambda t, y, args: y + jnp.stack([0 * y[0], args["strength"]])
)
SIZE = 9
HEIGHTS = jnp.linspace(0.02, 4.0, SIZE)
STARTS = jnp.stack([HEIGHTS, jnp.linspace(0.0, 1.0, SIZE)], axis=1)
ARGS = {
    "gravity": jnp.array(9.81),
    "restitution": jnp.linspace(0.97, 0.5, SIZE),
    "kicks": jnp.asarray(np.random.default_rng(7).uniform(0.0, 2.5, (SIZE, 2))),
    "strength": jnp.array(0.5),
}
AXES = {"gravity": None, "restitution": 0, "kicks": 0, "strength": None}
OPTIONS = dict(
    saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 5)),
    stepsize_controller=PID,
    resets=(BOUNCE, KICK),
    max_resets=60,
)


def of_one(args, i):
    return {name: x if AXES[name] is None else x[i] for name, x in args.items()}


def many(starts, args, **options):
    options = OPTIONS | dict(lanes=4) | options
    return mj.solve_ensemble(
        FALL, dfx.Tsit5(), 0.0, 2.0, None, starts, args, args_axes=AXES, **options
    )


def test_an_ensemble_is_one_by_one():
    """From a few to many resets, at times of its own in each trajectory: states, times and derivatives."""

    def with_gradient(solve):
        def loss(starts, args):
            sol = solve(starts, args)
            return jnp.sum(sol.ys[..., -1, :] ** 2), sol

        return eqx.filter_jit(jax.grad(loss, argnums=(0, 1), has_aux=True))

    one = lambda start, args: mj.diffeqsolve(
        FALL, dfx.Tsit5(), 0.0, 2.0, None, start, args, **OPTIONS
    )
    alone = with_gradient(one)
    slopes, ensemble = with_gradient(many)(STARTS, ARGS)
    assert not ensemble.failed.any()
    assert ensemble.execution == "mapped over, not in lanes: there are `resets`"
    assert ensemble.resets.number.min() <= 4
    assert ensemble.resets.number.max() >= 15
    common = 0.0
    for i in range(SIZE):
        (by_start, by_args), sol = alone(STARTS[i], of_one(ARGS, i))
        assert sol.resets.number == ensemble.resets.number[i]
        assert sol.stats["num_steps"] == ensemble.stats["num_steps"][i]
        np.testing.assert_allclose(ensemble.ys[i], sol.ys, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ensemble.resets.times[i], sol.resets.times, rtol=1e-13)
        np.testing.assert_allclose(slopes[0][i], by_start, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(slopes[1]["kicks"][i], by_args["kicks"], rtol=1e-9, atol=1e-9)
        common += by_args["strength"]
    np.testing.assert_allclose(slopes[1]["strength"], common, rtol=1e-9)


def test_an_ensemble_on_disk(tmp_path):
    """The chunks hold the resets; a trajectory with more of them than room has a message."""
    sample = lambda index, key: (STARTS[index], of_one(ARGS, index))
    folder = tmp_path / "falls"
    options = OPTIONS | dict(max_resets=5, chunk=4, progress=False)
    stored = mj.stream_ensemble(sample, SIZE, folder, FALL, dfx.Tsit5(), 0.0, 2.0, None, **options)
    ensemble = many(STARTS, ARGS, max_resets=5)
    assert ensemble.failed.any()
    assert not ensemble.failed.all()
    np.testing.assert_array_equal(np.asarray(stored.result) != 0, ensemble.failed)
    np.testing.assert_allclose(stored.resets["times"][:], ensemble.resets.times, rtol=1e-13)
    np.testing.assert_array_equal(stored.resets["number"][:], ensemble.resets.number)
    for index, message in stored.failures():
        assert ensemble.failed[index]
        assert "more events than `max_resets`" in message
    assert mj.open_ensemble(folder).resets["after"].shape == (SIZE, 5 + 2, 2)  # and for the kicks


def test_a_known_time_that_is_nan():
    """Its trajectory fails and says why, the others are as without it."""
    times = ARGS["kicks"].at[2, 1].set(jnp.inf)
    ensembles = [
        many(STARTS, {**ARGS, "kicks": kicks}, resets=(KICK,))
        for kicks in (times, times.at[4, 0].set(jnp.nan))
    ]
    without, ensemble = ensembles
    assert not without.failed.any()
    assert np.flatnonzero(ensemble.failed).tolist() == [4]
    ((index, message),) = ensemble.failures()
    assert index == 4
    assert "`times` of an `mj.ResetAt` in `resets` has NaN" in message
    others = np.arange(SIZE) != 4
    np.testing.assert_array_equal(ensemble.ys[others], without.ys[others])
    np.testing.assert_array_equal(ensemble.resets.times[others], without.resets.times[others])


def test_an_event_ends_each_trajectory():
    """Where it happens, or not at all."""
    ended = many(
        STARTS,
        ARGS,
        saveat=dfx.SaveAt(t1=True),
        resets=(),
        event=dfx.Event(lambda t, y, args, **kwargs: y[0], optx.Newton(1e-12, 1e-12)),
    )
    z, v = STARTS.T
    times = (v + jnp.sqrt(v**2 + 2 * 9.81 * z)) / 9.81
    assert not ended.failed.any()
    np.testing.assert_allclose(ended.ts[:, 0], times, rtol=1e-12)
    assert ended.event_mask.all()
    np.testing.assert_allclose(ended.ys[:, 0, 0], 0, atol=1e-12)


def test_fits_through_resets():
    """Doses of a two-compartment model: exchange, elimination, and the volume by which a dose is diluted,
    from what was given at known times."""

    def exchange(t, y, args):
        flow = args["exchange"] * (y[0] - y[1])
        return jnp.stack([-flow - args["elimination"] * y[0], flow])

    def dose(t, y, args):
        return y + jnp.stack([10.0 / args["volume"], 0 * y[1]])

    given = (mj.ResetAt([0.0, 2.0, 4.0], dose),)
    truth = {"exchange": 0.7, "elimination": 0.3, "volume": 2.0}
    ts, term, empty = jnp.linspace(0.25, 6.0, 24), dfx.ODETerm(exchange), jnp.zeros(2)
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8)
    measured = mj.diffeqsolve(
        term,
        dfx.Tsit5(),
        0.0,
        6.0,
        None,
        empty,
        truth,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
        resets=given,
    )
    start = {"exchange": 0.4, "elimination": 0.5, "volume": 1.5}
    options = dict(y0=empty, t0=0.0, observe=lambda t, y, parameters: y[0], sigma=0.01)
    result = mj.fit(term, start, ts, measured.ys[:, 0], resets=given, **options)
    for name, value in truth.items():
        np.testing.assert_allclose(result.parameters[name], value, rtol=1e-6)
    with pytest.raises(ValueError, match="`segments` must be 1 with `resets`"):
        mj.fit(term, start, ts, measured.ys[:, 0], resets=given, segments=2, **options)


def test_bad_input(as_a_user_meets_it):
    with pytest.raises(TypeError, match="`times` must be a vector of numbers, or a function"):
        mj.ResetAt("noon", lambda t, y, args: y)
    late = mj.ResetAt(lambda args: jnp.ones((2, 2)), lambda t, y, args: y)
    with pytest.raises(TypeError, match="`times` must be a vector of numbers, or a function"):
        many(STARTS, ARGS, resets=(late,))
    with pytest.raises(TypeError, match="`resets` must be a tuple"):
        many(STARTS, ARGS, resets=BOUNCE)
