"""Times that are no numbers: NaN is neither a start nor an end, and never a success."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
TURN = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
START = jnp.array([1.0, 0.0])
NAN, INF = float("nan"), float("inf")
SOLVERS = [
    pytest.param(mj.Projected(dfx.Heun(), CIRCLE), id="hook"),
    pytest.param(dfx.Heun(), id="alone"),
    pytest.param(mj.Rodas3P(), id="Rosenbrock"),
]
BAD = [
    pytest.param(dict(t1=NAN), "`t1` is NaN", id="t1"),
    pytest.param(dict(t0=NAN), "`t0` is NaN or infinite", id="t0"),
    pytest.param(dict(t0=-INF), "`t0` is NaN or infinite", id="t0 infinite"),
    pytest.param(dict(ts=[0.0, NAN, 1.0]), "`saveat.ts` has times that are NaN", id="ts"),
]


def solve(solver, t0=0.0, t1=1.0, dt0=0.1, ts=None, throw=True):
    saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts))
    return mj.diffeqsolve(TURN, solver, t0, t1, dt0, START, saveat=saveat, throw=throw)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("times", "message"), BAD)
def test_a_time_that_is_no_number(solver, times, message):
    with pytest.raises(RuntimeError, match=message):
        solve(solver, **times)
    assert solve(solver, throw=False, **times).result == dfx.RESULTS.nonfinite_input
    assert solve(solver, throw=False).result == dfx.RESULTS.successful


@pytest.mark.parametrize("solver", SOLVERS)
def test_under_jit_and_in_a_batch(solver):
    ends = jnp.array([1.0, NAN])
    result = jax.jit(jax.vmap(lambda t1: solve(solver, t1=t1, throw=False).result))(ends)
    assert (result == dfx.RESULTS.nonfinite_input).tolist() == [False, True]
    with pytest.raises(RuntimeError, match="`t1` is NaN"):
        jax.jit(lambda t1: solve(solver, t1=t1).ys)(NAN)
    with pytest.raises(RuntimeError, match="`t1` is NaN"):  # known while tracing
        jax.jit(lambda y0: solve(solver, t1=NAN).ys)(START)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dt0", [NAN, INF])
def test_a_first_step_that_is_no_number(solver, dt0):
    with pytest.raises(ValueError, match="`dt0` must be the length of the first step"):
        solve(solver, dt0=dt0)
    with pytest.raises(RuntimeError, match="`dt0` is zero, NaN or infinite"):
        solve(solver, dt0=jnp.asarray(dt0))
    traced = jax.jit(lambda dt0: solve(solver, dt0=dt0, throw=False).result)
    assert traced(dt0) == dfx.RESULTS.nonfinite_input


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("throw", [True, False])
def test_a_first_step_that_leads_away(solver, throw):
    """Diffrax's own message shows tracers under `jit`."""
    with pytest.raises(RuntimeError, match="`dt0` must have the sign of t1 - t0") as error:
        jax.jit(lambda dt0: solve(solver, dt0=dt0, throw=throw).ys)(-0.1)
    assert "Traced" not in str(error.value)


def test_a_constraint_that_depends_on_time():
    """The start fails, too; the time is what is at fault."""
    moving = mj.Constraint(lambda t, y, args: y @ y - 1.0 - 0 * t)
    solver = mj.Projected(dfx.Heun(), moving)
    with pytest.raises(RuntimeError, match="`t0` is NaN"):
        solve(solver, t0=NAN)
    assert solve(solver, t0=NAN, throw=False).result == dfx.RESULTS.nonfinite_input


def test_an_event_without_an_end():
    """The end may be infinite where an event ends the solve."""
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] < 0)
    sol = mj.diffeqsolve(TURN, dfx.Heun(), 0.0, INF, 0.1, START, event=event)
    assert sol.result == dfx.RESULTS.event_occurred


def ensemble(solver, t1, throw=False, **options):
    starts = jnp.stack([START, START])
    return mj.solve_ensemble(TURN, solver, 0.0, t1, 0.1, starts, throw=throw, **options)


@pytest.mark.parametrize("solver", [*SOLVERS, pytest.param(dfx.Kvaerno3(), id="mapped")])
def test_ensembles(solver):
    controller = {}
    if isinstance(solver, dfx.Kvaerno3):
        controller = dict(stepsize_controller=dfx.PIDController(1e-3, 1e-3))
    own = ensemble(solver, jnp.array([1.0, NAN]), **controller)
    assert own.failed.tolist() == [False, True]
    ((index, message),) = own.failures()
    assert index == 1
    assert "is NaN" in message
    assert "state" not in message
    common = ensemble(solver, NAN, **controller)
    assert common.failed.tolist() == [True, True]
    assert [text for _, text in common.failures()] == [message, message]
    with pytest.raises(RuntimeError, match="is NaN"):
        ensemble(solver, NAN, throw=True, **controller)


def test_output_and_first_steps_of_ensembles():
    saveat = dfx.SaveAt(ts=jnp.array([0.5, NAN]))
    with pytest.raises(RuntimeError, match="`saveat.ts` has times that are NaN"):
        ensemble(dfx.Heun(), 1.0, saveat=saveat)
    starts = jnp.stack([START, START])
    for dt0 in (NAN, INF):
        with pytest.raises(RuntimeError, match="`dt0` is zero, NaN or infinite"):
            mj.solve_ensemble(TURN, dfx.Heun(), 0.0, 1.0, jnp.asarray(dt0), starts)


@pytest.mark.parametrize("t1", [NAN, lambda index, key: jnp.where(index == 0, NAN, 1.0)])
def test_ensembles_on_disk(t1, tmp_path):
    stored = mj.stream_ensemble(
        lambda index, key: (START, None),
        2,
        tmp_path,
        TURN,
        dfx.Heun(),
        0.0,
        t1,
        0.1,
        progress=False,
    )
    assert stored.num_failed == (1 if callable(t1) else 2)
    assert "is NaN" in stored.failures()[0][1]
