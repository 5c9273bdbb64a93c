"""How solves end that do not end well: codes, messages, and batches."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
START = jnp.array([1.0, 0.0])
ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-6)


def turn(t, y, args):
    return jnp.stack([-y[1], y[0]])


def still(t, y, args):
    return 0.0 * y


def undefined_at_first(t, y, args):
    return jnp.where(t > 0, 1.0, jnp.nan) * turn(t, y, args)


@pytest.mark.parametrize("field", [still, undefined_at_first])
def test_unbounded_time_and_a_field_without_scale(field):
    """The first step was infinite, the state as well, and the event "occurred"."""
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] - 0.5)
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        mj.Projected(dfx.Bosh3(), CIRCLE),
        0.0,
        jnp.inf,
        None,
        START,
        event=event,
        stepsize_controller=ADAPTIVE,
        throw=False,
    )
    assert sol.result not in (dfx.RESULTS.successful, dfx.RESULTS.event_occurred)


def test_first_step_towards_an_event():
    """At t = 0 the field vanishes; t1 gives no scale of time."""
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] - 0.5)
    sol = mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: t * turn(t, y, args)),
        mj.Projected(dfx.Tsit5(), CIRCLE),
        0.0,
        jnp.inf,
        None,
        START,
        event=event,
        stepsize_controller=ADAPTIVE,
    )
    assert sol.result == dfx.RESULTS.event_occurred
    assert np.cos(sol.ts[0] ** 2 / 2) < 0.5
    np.testing.assert_allclose(
        sol.ys[0], [np.cos(sol.ts[0] ** 2 / 2), np.sin(sol.ts[0] ** 2 / 2)], atol=1e-5
    )


def lost_mass(stabilization=None):
    """A pendulum whose mass is lost on the way down."""
    return mj.MechanicalSystem(
        lambda q, args: 1.0 + 2.0 * q[1],
        lambda t, q, args: q @ q - 1.0,
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
        stabilization=stabilization,
    )


SYSTEM = lost_mass()
UNDEFINED = {
    "stabilized": (
        SYSTEM,
        mj.Stabilized(dfx.Bosh3(), SYSTEM.constraint, stabilization=mj.InvariantStabilization(1.0)),
    ),
    "Baumgarte": (lost_mass(mj.Baumgarte(1.0, 1.0)), dfx.Bosh3()),
    "plain": (SYSTEM, dfx.Tsit5()),
}
SAVED = {
    "end": dfx.SaveAt(t1=True),
    "function": dfx.SaveAt(t1=True, fn=lambda t, y, args: t),
    "dense": dfx.SaveAt(dense=True),
}


@pytest.mark.parametrize(
    ("which", "saved"),
    [("stabilized", "function"), ("Baumgarte", "end"), ("plain", "function"), ("plain", "dense")],
)
def test_undefined_accelerations_are_no_success(which, saved):
    """With constant steps nothing rejects them: NaN was returned as a success."""
    system, solver = UNDEFINED[which]

    def solve(q0, throw=False):
        return mj.diffeqsolve(
            system.terms,
            solver,
            0.0,
            1.0,
            0.05,
            (q0, jnp.zeros(2)),
            saveat=SAVED[saved],
            throw=throw,
        )

    starts = jnp.array([[1.0, 0.0], [0.0, 1.0]])  # falls; stands
    sol = jax.vmap(solve)(starts)
    assert (sol.result == dfx.RESULTS.nonfinite).tolist() == [True, False]
    assert (sol.result == dfx.RESULTS.successful).tolist() == [False, True]
    with pytest.raises(RuntimeError, match="(?s)not finite.*mass matrix"):
        solve(START, throw=True)
    if saved == "function":
        assert sol.ys.shape == (2, 1)


def test_a_solve_of_diffrax_is_what_it_was():
    ts = jnp.linspace(0.0, 1.0, 3)
    # Numbers are constants of the program to Diffrax, which rounds otherwise.
    times = tuple(map(jnp.asarray, (0.0, 1.0, 0.1)))
    for saveat in (
        dfx.SaveAt(ts=ts, fn=lambda t, y, args: y[0]),
        dfx.SaveAt(subs={"a": dfx.SubSaveAt(t1=True), "b": dfx.SubSaveAt(steps=2)}, dense=True),
    ):
        args = dfx.ODETerm(turn), dfx.Heun(), *times, START
        options = dict(saveat=saveat, max_steps=16)
        ours, theirs = mj.diffeqsolve(*args, **options), dfx.diffeqsolve(*args, **options)
        theirs = mj.Solution.of(theirs)
        same = jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), ours, theirs)
        assert all(jax.tree.leaves(same))


def test_a_failed_step_with_an_event():
    """Diffrax notes the event and forgets the failure."""
    ends = mj.Constraint(lambda t, y, args: y @ y - jnp.where(t < 0.45, 1.0, -1.0))
    sol = mj.diffeqsolve(
        dfx.ODETerm(turn),
        mj.Projected(dfx.Bosh3(), ends),
        0.0,
        1.0,
        0.1,
        START,
        saveat=dfx.SaveAt(t1=True, fn=lambda t, y, args: t),
        event=dfx.Event(lambda t, y, args, **kwargs: t > 0.45),
        throw=False,
    )
    assert sol.result == dfx.RESULTS.nonlinear_divergence


def outward(t, y, args):
    return turn(t, y, args) + args * y


def solve_outward(share, tolerance, t1=10.0):
    """One program for all of these numbers, as they are arrays."""
    share, tolerance, t1 = map(jnp.asarray, (share, tolerance, t1))
    return mj.diffeqsolve(
        dfx.ODETerm(outward),
        mj.Projected(dfx.Tsit5(), CIRCLE),
        0.0,
        t1,
        None,
        START,
        share,
        stepsize_controller=dfx.PIDController(tolerance, tolerance),
        max_steps=512,
    )


@pytest.mark.parametrize(("share", "tolerance"), [(1.0, 1e-3), (0.3, 1e-6), (0.003, 1e-8)])
def test_a_field_that_is_not_tangent(share, tolerance):
    with pytest.raises(RuntimeError, match=r"(?s)maximum number.*not tangent.*mj.tangent_field"):
        solve_outward(share, tolerance)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
def test_a_tangent_field_that_takes_many_steps(tolerance):
    with pytest.raises(RuntimeError, match=r"(?s)maximum number.*larger `max_steps`.*32-bit"):
        solve_outward(0.0, tolerance, 1e5)


def test_the_share_that_corrections_undo():
    """Normal part over whole, whatever the steps: h along the normal, h sqrt(1 + share^2) in all."""

    @jax.jit
    def share(step):
        sol = mj.diffeqsolve(
            dfx.ODETerm(outward),
            mj.Projected(dfx.Bosh3(), CIRCLE),
            0.0,
            10 * step,
            step,
            START,
            0.5,
        )
        return sol.stats["correction_share"]

    for step in (1e-3, 1e-4):
        np.testing.assert_allclose(share(step), 0.5 * 0.5, rtol=0.02)


def test_a_batch_names_the_cause_of_the_point_that_failed():
    """The largest number of all causes was reported, also of points without fault."""
    singular = mj.Constraint(lambda t, y, args: y[0] ** 2 - y[1] ** 2)
    starts = jnp.array([[1.0, 0.9], [0.0, 0.0]])
    with pytest.raises(RuntimeError, match="full rank"):
        jax.vmap(lambda y: mj.consistent_state(singular, 0.0, y))(starts)
    with pytest.raises(RuntimeError, match="full rank"):
        jax.vmap(
            lambda y: (
                mj.diffeqsolve(
                    dfx.ODETerm(still), mj.Projected(dfx.Heun(), singular), 0.0, 1.0, 0.5, y
                ).ys
            )
        )(starts)
