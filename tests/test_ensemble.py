"""Many trajectories in lanes: each is what it is alone."""

import importlib

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

import manifold_jax as mj


execution = importlib.import_module("manifold_jax._ensemble.lanes.execution")
in_lanes = importlib.import_module("manifold_jax._ensemble.lanes.in_lanes")
reverse = importlib.import_module("manifold_jax._ensemble.lanes.reverse")
PID = dfx.PIDController(rtol=1e-6, atol=1e-6)
CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1)
TURN = dfx.ODETerm(lambda t, y, args: args * jnp.stack([-y[1], y[0]]) * (1 + y[0] ** 2 * t))
SIZE, LANES = 7, 3  # lanes are refilled, and one is left over
ANGLES = np.linspace(0.1, 2.9, SIZE)
STARTS = jnp.asarray(np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1))
RATES = jnp.linspace(0.5, 3.0, SIZE)
HOOKS = {
    "projected": mj.Projected(dfx.Bosh3(), CIRCLE),
    "stabilized": mj.Stabilized(dfx.Bosh3(), CIRCLE, stabilization=mj.InvariantStabilization(2.0)),
    "charts": mj.LocalCoordinates(dfx.Bosh3(), CIRCLE),
    "plain": dfx.Bosh3(),
    "stiff": mj.Rodas3P(),
}


@pytest.fixture
def only_in_lanes(monkeypatch):
    """The way of `diffeqsolve` fails the test."""

    def refuse(*args):
        raise AssertionError("not in lanes")

    monkeypatch.setattr(execution, "solve_mapped", refuse)
    monkeypatch.setattr(in_lanes, "gradient_of_mapped", refuse)
    monkeypatch.setattr(in_lanes, "tangents_of_mapped", refuse)


def alone(hook, t0, t1, dt0, y0, args, **options):
    return mj.diffeqsolve(TURN, hook, t0, t1, dt0, y0, args, throw=False, **options)


def assert_equal(sol, singles, atol=1e-13):
    np.testing.assert_allclose(sol.ts, singles.ts, rtol=0, atol=atol)
    np.testing.assert_allclose(sol.ys, singles.ys, rtol=0, atol=atol)
    np.testing.assert_array_equal(sol.failed, singles.result != dfx.RESULTS.successful)
    for name, value in sol.stats.items():
        if name == "num_projection_iterations":  # the last of them are decided by rounding
            continue
        np.testing.assert_allclose(value, singles.stats[name], rtol=0, atol=1e-10, err_msg=name)


@pytest.mark.usefixtures("only_in_lanes")
@pytest.mark.parametrize("name", HOOKS)
def test_each_is_what_it_is_alone(name):
    """Both directions of time, own parameters and ends, at the start, between and at the end."""
    hook = HOOKS[name]
    saveat = dfx.SaveAt(t0=True, ts=jnp.array([0.25, 0.5]), t1=True)
    t1s = jnp.linspace(0.5, 2.0, SIZE)
    options = dict(saveat=saveat, stepsize_controller=PID)
    sol = mj.solve_ensemble(
        TURN, hook, 0.25, t1s, None, STARTS, RATES, lanes=LANES, **options, args_axes=0
    )
    single = jax.jit(jax.vmap(lambda t1, y, a: alone(hook, 0.25, t1, None, y, a, **options)))
    assert_equal(sol, single(t1s, STARTS, RATES))
    if name not in ("stabilized", "plain", "stiff"):
        violation = np.abs(np.sum(np.square(sol.ys), -1) - 1)
        assert violation.max() < 1e-15
    assert sol.failures() == []


@pytest.mark.usefixtures("only_in_lanes")
def test_backwards_with_constant_steps_and_functions():
    hook = HOOKS["projected"]
    saveat = dfx.SaveAt(ts=jnp.array([0.4, 0.1]), fn=lambda t, y, args: t * y[0] + args)
    run = lambda f, y, a: f(hook, 1.0, 0.0, -0.125, y, a, saveat=saveat)
    ensemble = lambda hook, t0, *args, **options: mj.solve_ensemble(
        TURN, hook, t0, *args, args_axes=None, lanes=LANES, **options
    )
    sol = run(ensemble, STARTS, jnp.asarray(2.0))
    assert_equal(sol, jax.vmap(lambda y: run(alone, y, jnp.asarray(2.0)))(STARTS))
    assert sol.ys.shape == (SIZE, 2)


@pytest.mark.usefixtures("only_in_lanes")
def test_steps_that_end_just_short_of_the_end():
    """By less than a hundred numbers, before and behind zero: there is no step of what is left."""
    t0s, t1s = jnp.array([0.0, -2.5, 0.0]), jnp.array([1.25, -1.25, 1.3])
    dt0, rate = 0.625 - 40 * np.finfo(float).eps, jnp.asarray(2.0)
    options = dict(stepsize_controller=dfx.PIDController(rtol=1.0, atol=1.0, dtmax=dt0))
    solver, starts = HOOKS["plain"], STARTS[:3]
    sol = mj.solve_ensemble(TURN, solver, t0s, t1s, dt0, starts, rate, lanes=LANES, **options)
    single = jax.jit(jax.vmap(lambda *of: alone(solver, *of[:2], dt0, of[2], rate, **options)))
    assert_equal(sol, single(t0s, t1s, starts))
    assert sol.stats["num_steps"].tolist() == [2, 2, 3]


@pytest.mark.usefixtures("only_in_lanes")
def test_a_failure_leaves_the_others_as_they_are():
    hook = HOOKS["projected"]
    solve = jax.jit(
        lambda y, a: mj.solve_ensemble(
            TURN,
            hook,
            0.0,
            2.0,
            None,
            y,
            a,
            lanes=LANES,
            stepsize_controller=PID,
            max_steps=2000,
            args_axes=0,
        )
    )
    good = solve(STARTS, RATES)
    starts = STARTS.at[1].set(jnp.nan).at[4].set(0.0)
    bad = solve(starts, RATES.at[2].set(1e6))
    others = np.array([0, 3, 5, 6])
    np.testing.assert_array_equal(good.ys[others], bad.ys[others])
    failures = dict(bad.failures())
    assert list(failures) == [1, 2, 4]
    assert "maximum number of solver steps" in failures[2]
    assert "larger `max_steps`" in failures[2]
    assert "`y0` has numbers that are NaN" in failures[1]
    assert "`y0` could not be made consistent" in failures[4]
    assert bad.stats["num_steps"][jnp.array([1, 4])].tolist() == [0, 0]
    with pytest.raises(RuntimeError, match="maximum number of solver steps"):
        mj.solve_ensemble(
            TURN,
            hook,
            0.0,
            2.0,
            None,
            STARTS[:1],
            jnp.array([1e6]),
            stepsize_controller=PID,
            max_steps=9,
            throw=True,
            args_axes=0,
        )


@pytest.mark.usefixtures("only_in_lanes")
@pytest.mark.parametrize("bad", [jnp.nan, 0.0], ids=["not a number", "singular"])
def test_one_of_a_thousand(bad, thousand):
    starts = np.resize(STARTS, (1000, 2))
    good, one_bad = (
        thousand(starts),
        thousand(np.where(np.arange(1000)[:, None] == 500, bad, starts)),
    )
    assert [number for number, _ in one_bad.failures()] == [500]
    others = np.arange(1000) != 500
    np.testing.assert_array_equal(one_bad.ys[others], good.ys[others])


@pytest.fixture(scope="module")
def thousand():
    options = dict(args_axes=None, stepsize_controller=PID)
    hook, rate = HOOKS["projected"], jnp.asarray(2.0)
    return jax.jit(lambda y: mj.solve_ensemble(TURN, hook, 0.0, 1.0, None, y, rate, **options))


@pytest.mark.usefixtures("only_in_lanes")
def test_a_saved_value_that_cannot_be_corrected():
    """Is a failure of that trajectory, and not of the next one in its lane."""

    def g(t, y, args):
        return y @ y - 1 + jnp.where((args > 2) & (jnp.abs(t - 0.3) < 0.01), jnp.nan, 0.0)

    hook = mj.Projected(dfx.Bosh3(), mj.Constraint(g))
    options = dict(saveat=dfx.SaveAt(ts=jnp.array([0.2, 0.3, 0.4])))
    rates = RATES[::-1]  # those that fail come first
    sol = mj.solve_ensemble(
        TURN, hook, 0.0, 0.5, 0.125, STARTS, rates, lanes=LANES, **options, args_axes=0
    )
    single = jax.jit(jax.vmap(lambda y, a: alone(hook, 0.0, 0.5, 0.125, y, a, **options)))
    assert_equal(sol, single(STARTS, rates))
    np.testing.assert_array_equal(sol.failed, rates > 2)
    undefined = np.outer(rates > 2, [False, True, False])
    np.testing.assert_array_equal(np.isnan(sol.ys).any(axis=2), undefined)


@pytest.mark.usefixtures("only_in_lanes")
def test_undefined_starts_leave_the_others_untouched():
    def solve(y):
        options = dict(lanes=LANES, stepsize_controller=PID)
        return mj.solve_ensemble(
            TURN, HOOKS["projected"], 0.0, 0.5, None, y, RATES, **options, args_axes=0
        )

    all, some = solve(STARTS), solve(STARTS.at[2, 0].set(jnp.nan).at[5].set(0.0))
    assert [number for number, _ in some.failures()] == [2, 5]
    defined = np.array([0, 1, 3, 4, 6])
    np.testing.assert_array_equal(some.ys[defined], all.ys[defined])
    assert not all.failures()


def gradients(hook, saveat, t1s, loss):
    """Of `loss(ys)` with respect to what all have in common, and to what each has of its own: in lanes,
    and by trajectories alone; and forwards in lanes, along a random direction."""
    options = dict(saveat=saveat, stepsize_controller=PID)

    def field(t, y, args):
        common, own = args
        return common * own * TURN.vector_field(t, y, 1.0)

    terms = dfx.ODETerm(field)

    def together(values, adjoint):
        common, own, y = values
        ys = mj.solve_ensemble(
            terms,
            hook,
            0.0,
            t1s,
            None,
            y,
            (common, own),
            args_axes=(None, 0),
            lanes=LANES,
            adjoint=adjoint,
            **options,
        ).ys
        return loss(ys)

    def each_alone(values):
        common, own, y = values

        def one(t1, own, y):
            args = common, own
            return mj.diffeqsolve(terms, hook, 0.0, t1, None, y, args, throw=False, **options).ys

        return loss(jax.vmap(one)(t1s, own, y))

    at = jnp.asarray(0.8), RATES, STARTS
    along = jnp.asarray(0.3), jnp.cos(RATES), jnp.sin(5 * STARTS)
    forwards = lambda at: together(at, dfx.ForwardMode())
    _, slope = jax.jit(lambda: jax.jvp(forwards, (at,), (along,)))()
    backwards = lambda at: together(at, mj.StepReplayAdjoint())
    found, expected = jax.jit(jax.grad(backwards))(at), jax.jit(jax.grad(each_alone))(at)
    np.testing.assert_allclose(slope, sum(map(jnp.vdot, expected, along)), rtol=0, atol=1e-11)
    return found, expected


@pytest.mark.usefixtures("only_in_lanes")
@pytest.mark.parametrize(
    ("name", "saveat", "segments"),
    [
        ("projected", dfx.SaveAt(t0=True, ts=jnp.array([0.0, 0.25, 0.5]), t1=True), True),
        pytest.param("stabilized", dfx.SaveAt(t1=True), False, marks=pytest.mark.slow),
        pytest.param("plain", dfx.SaveAt(ts=jnp.array([0.6])), True, marks=pytest.mark.slow),
        pytest.param("stiff", dfx.SaveAt(ts=jnp.array([0.6])), True, marks=pytest.mark.slow),
        pytest.param(
            "charts",
            dfx.SaveAt(ts=jnp.array([0.1, 0.2, 0.6]), fn=lambda t, y, args: y * args[1]),
            True,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_gradients(name, saveat, segments, monkeypatch):
    """The record of a segment has few steps: several of them for each trajectory."""
    if segments:
        monkeypatch.setattr(reverse, "_BYTES", 1000)
    t1s = jnp.linspace(1.0, 0.7, SIZE)
    found, expected = gradients(HOOKS[name], saveat, t1s, lambda ys: jnp.mean(jnp.sin(3 * ys)))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
        assert np.abs(a).max() > 1e-3


@pytest.mark.slow
@pytest.mark.usefixtures("only_in_lanes")
def test_gradient_beside_values_that_have_none():
    """Functions that also return whole numbers and truth values, at given times and at the end."""
    fn = lambda t, y, args: {"is up": y[1] > 0, "turns": jnp.floor(t).astype(int), "x": args * y[0]}
    saveat = dfx.SaveAt(ts=jnp.array([0.2]), t1=True, fn=fn)
    solve = lambda rates, adjoint: mj.solve_ensemble(
        TURN,
        HOOKS["projected"],
        0.0,
        0.5,
        0.125,
        STARTS,
        rates,
        lanes=LANES,
        adjoint=adjoint,
        saveat=saveat,
        args_axes=0,
    )
    loss = lambda rates, adjoint: jnp.sum(jnp.sin(solve(rates, adjoint).ys["x"]))
    reverse = jax.grad(loss)(RATES, mj.StepReplayAdjoint())
    along = jnp.cos(RATES)
    _, slope = jax.jvp(lambda r: loss(r, dfx.ForwardMode()), (RATES,), (along,))
    np.testing.assert_allclose(slope, along @ reverse, rtol=0, atol=1e-12)
    h = 1e-6 * along
    both = loss(RATES + h, dfx.ForwardMode()) - loss(RATES - h, dfx.ForwardMode())
    np.testing.assert_allclose(slope, both / 2e-6, rtol=0, atol=1e-8)


@pytest.mark.usefixtures("only_in_lanes")
def test_gradient_beside_a_failure():
    """A trajectory that nothing depends on adds nothing, also if its steps have no derivative."""

    def field(t, y, args):
        defined = jnp.where(args > 2, 0.3 - t, 1.0)
        return jnp.sqrt(defined) * TURN.vector_field(t, y, args)

    def mean(rates, counted):
        sol = mj.solve_ensemble(
            dfx.ODETerm(field),
            HOOKS["projected"],
            0.0,
            0.5,
            0.125,
            STARTS,
            rates,
            lanes=LANES,
            args_axes=0,
        )
        counted = counted & ~sol.failed
        return jnp.sum(jnp.where(counted[:, None, None], sol.ys, 0.0) ** 3), sol.failed

    gradient = jax.jit(jax.grad(mean, has_aux=True))
    defined = RATES < 2
    assert 0 < defined.sum() < SIZE
    some, failed = gradient(jnp.where(defined, RATES, 1.5), defined)
    assert not failed.any()
    all, failed = gradient(RATES, jnp.full(SIZE, True))
    np.testing.assert_array_equal(failed, ~defined)
    assert np.abs(some).max() > 1e-3
    np.testing.assert_array_equal(some, all)


@pytest.mark.parametrize(
    "solver",
    [mj.Projected(dfx.ImplicitEuler(), CIRCLE), dfx.ImplicitEuler()],
    ids=["projected", "plain"],
)
def test_implicit_solvers_take_the_ordinary_way(solver):
    options = dict(stepsize_controller=PID)
    sol = mj.solve_ensemble(
        TURN, solver, 0.0, 0.5, 0.1, STARTS, RATES, lanes=LANES, **options, args_axes=0
    )
    assert sol.execution.startswith("mapped over")
    assert "ImplicitEuler is not an explicit" in sol.execution
    single = jax.jit(jax.vmap(lambda y, a: alone(solver, 0.0, 0.5, 0.1, y, a, **options)))
    assert_equal(sol, single(STARTS, RATES))


@pytest.mark.usefixtures("only_in_lanes")
def test_stiff_systems_fail_alone():
    """Where `f` has no value, from some time on or at all."""

    def field(t, y, args):
        return jnp.stack([-1e3 * (y[0] - jnp.cos(t)), args * jnp.sqrt(2 * args - t) * y[1]])

    rates = jnp.array([0.2, 1.0, 2.0, jnp.nan])
    starts, options = jnp.array([[0.0, 1.0]] * 4), dict(stepsize_controller=PID, max_steps=500)
    terms, solver = dfx.ODETerm(field), mj.Rodas3P()
    sol = mj.solve_ensemble(
        terms, solver, 0.0, 1.0, None, starts, rates, lanes=LANES, **options, args_axes=0
    )
    one = lambda y, a: mj.diffeqsolve(terms, solver, 0.0, 1.0, None, y, a, throw=False, **options)
    singles = jax.jit(jax.vmap(one))(starts, rates)
    np.testing.assert_allclose(sol.ys, singles.ys, rtol=0, atol=1e-12)
    steps, expected = sol.stats["num_steps"], singles.stats["num_steps"]
    np.testing.assert_array_equal(
        steps[1:], expected[1:]
    )  # rounding decides how the first one ends
    assert dict(sol.failures()).keys() == {0, 3}
    assert np.all(np.isnan(sol.ys[sol.failed]))


def test_large_stiff_systems_take_the_ordinary_way():
    decay = dfx.ODETerm(lambda t, y, args: -args * y)
    starts, rates = jnp.ones((2, 9)), jnp.array([1.0, 2.0])
    sol = mj.solve_ensemble(decay, mj.Rodas3P(), 0.0, 1.0, 0.1, starts, rates, args_axes=0)
    assert sol.execution == "mapped over, not in lanes: more than 8 unknowns of a stiff system"
    np.testing.assert_allclose(sol.ys[:, 0, 0], jnp.exp(-rates), rtol=1e-3)


def test_too_many_operations_take_the_ordinary_way(monkeypatch):
    monkeypatch.setattr(in_lanes, "_LONGEST", 100)
    sol = mj.solve_ensemble(TURN, HOOKS["projected"], 0.0, 0.5, 0.1, STARTS, RATES, args_axes=0)
    assert "more than 100 operations" in sol.execution
    singles = jax.vmap(lambda y, a: alone(HOOKS["projected"], 0.0, 0.5, 0.1, y, a))
    assert_equal(sol, singles(STARTS, RATES))


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_arguments():
    def solve(t1=1.0, y=STARTS, args=RATES, **options):
        return mj.solve_ensemble(
            TURN, HOOKS["projected"], 0.0, t1, 0.1, y, args, **{"args_axes": 0, **options}
        )

    with pytest.raises(ValueError, match=r"Leading axes.*'y0s': 7, 'args': 2"):
        solve(args=jnp.ones(2))
    with pytest.raises(ValueError, match="`args` is one number.*args_axes"):
        solve(args=1.0)
    with pytest.raises(ValueError, match="no trajectories"):
        solve(y=STARTS[:0], args=RATES[:0])
    with pytest.raises(ValueError, match="`lanes` must be a positive integer"):
        solve(lanes=0)
    with pytest.raises(ValueError, match="`args_axes` must be 0 or None"):
        solve(args_axes=1)
    with pytest.raises(ValueError, match="`max_steps` must be"):
        solve(max_steps=None)
    with pytest.raises(TypeError, match="`mesh` must be None or a `jax.sharding.Mesh`.*got int"):
        solve(mesh=2)
    with pytest.raises(ValueError, match="`mesh` has no devices"):
        solve(mesh=Mesh(np.array([]), "x"))
    implicit, mesh = mj.Projected(dfx.Kvaerno3(), CIRCLE), Mesh(jax.devices()[:1], "x")
    with jax.set_mesh(mesh), pytest.raises(ValueError, match="`mesh` cannot be used inside"):
        solve(mesh=mesh)
    with pytest.raises(ValueError, match="`mesh` is for explicit solvers"):
        mj.solve_ensemble(TURN, implicit, 0.0, 1.0, 0.1, STARTS, RATES, mesh=mesh, args_axes=0)
    with pytest.raises(TypeError, match="`y0s`"):
        solve(y=jnp.ones((7, 2), int))
    with pytest.raises(RuntimeError, match="`dt0` must have the sign"):
        solve(t1=-1.0)
    with pytest.raises(RuntimeError, match=r"`saveat.ts` must lie between"):
        solve(saveat=dfx.SaveAt(ts=jnp.array([0.5, 1.5])))
    with pytest.raises(RuntimeError, match=r"`saveat.ts` must be sorted"):
        solve(saveat=dfx.SaveAt(ts=jnp.array([0.5, 0.2])))
