"""Events with a root finder: the earliest of several in one step, on the manifold, with gradients."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
ROTATION = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
START = jnp.array([1.0, 0.0])
# Of the angles at which the first and the second component have these values: 0.451 and 0.305.
VALUES = jnp.array([0.9, 0.3])
FINDER = optx.Newton(1e-10, 1e-10)
SAVED = dfx.SaveAt(t0=True, ts=jnp.array([0.1, 0.2, 0.5]), t1=True)


def rotate(values, order=(0, 1), sign=1.0, hook=True, constraint=CIRCLE, **options):
    """Backwards in time for a `sign` of -1."""
    conditions = [lambda t, y, args, **kwargs: y[0] - args[0]]
    conditions.append(lambda t, y, args, **kwargs: y[1] - args[1])
    return mj.diffeqsolve(
        ROTATION,
        mj.Projected(dfx.Tsit5(), constraint) if hook else dfx.Tsit5(),
        0.0,
        3.0 * sign,
        0.7 * sign,
        START,
        values,
        event=dfx.Event([conditions[i] for i in order], FINDER),
        **options,
    )


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_earlier_of_two_events_in_one_step(order):
    """Diffrax takes the first in the order of `cond_fn` (its issue 639)."""
    sol = jax.jit(lambda values: rotate(values, order, saveat=SAVED))(VALUES)
    angle = np.arcsin(0.3)
    assert sol.result == dfx.RESULTS.event_occurred
    assert [bool(mask) for mask in sol.event_mask] == [i == 1 for i in order]
    # The step is 0.7 long, and so is the error of an interpolated value.
    np.testing.assert_allclose(sol.ts, [0, 0.1, 0.2, angle, np.inf], atol=1e-3)
    np.testing.assert_allclose(sol.ys[:4] @ jnp.array([0.0, 1.0]), np.sin(sol.ts[:4]), atol=1e-3)
    np.testing.assert_allclose(jnp.sum(sol.ys[:4] ** 2, axis=1), 1.0, rtol=1e-14)
    assert np.isinf(sol.ys[4]).all()


def test_events_in_a_batch_and_backwards_in_time():
    """Of the trajectories one has no event at all, and the last runs the other way."""
    many = jnp.array([[0.9, 0.3], [0.99, 0.5], [5.0, 5.0], [0.9, -0.3]])
    sign = jnp.array([1.0, 1.0, 1.0, -1.0])
    *ends, back = jax.jit(jax.vmap(lambda v, sign: rotate(v, sign=sign).ts[0]))(many, sign)
    np.testing.assert_allclose(ends, [np.arcsin(0.3), np.arccos(0.99), 3.0], atol=1e-3)
    np.testing.assert_allclose(back, -ends[0], rtol=1e-9)


@pytest.mark.parametrize("hook", [True, False])
def test_gradient_of_time_and_state_of_an_event(hook):
    """That of the implicit function; Diffrax's own is the same where only one event can happen."""

    def end(values, **options):
        sol = rotate(values, hook=hook, **options)
        return sol.ts[0] + 2 * sol.ys[0, 0]

    reverse = jax.jit(jax.grad(end))(VALUES)
    forward = jax.jit(jax.jacfwd(lambda v: end(v, adjoint=dfx.ForwardMode())))(VALUES)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(reverse[1], (1 - 2 * 0.3) / np.sqrt(1 - 0.3**2), rtol=1e-2)
    assert reverse[0] == 0


@pytest.mark.parametrize("solve", [mj.diffeqsolve, dfx.diffeqsolve])
def test_gradient_of_an_event_by_the_field_and_the_start(solve):
    """Through the interpolation of the step in which it happens: the angle asin 0.3 is reached at
    `(asin 0.3 - a) / rate`, and the state there does not change."""
    event = dfx.Event(lambda t, y, args, **kwargs: y[1] - 0.3, FINDER)
    options = dict(event=event, adjoint=mj.StepReplayAdjoint())
    options["stepsize_controller"] = dfx.PIDController(rtol=1e-9, atol=1e-9)
    field = dfx.ODETerm(lambda t, y, args: args * jnp.stack([-y[1], y[0]]))
    hook = mj.Projected(dfx.Tsit5(), CIRCLE)

    def end(rate, a):
        y0 = jnp.stack([jnp.cos(a), jnp.sin(a)])
        sol = solve(field, hook, 0.0, 3.0, 0.01, y0, rate, **options)
        return sol.ts[0] + 2 * sol.ys[0, 0]

    slopes = jax.jit(jax.grad(end, (0, 1)))(2.0, 0.1)
    np.testing.assert_allclose(slopes, [-(np.arcsin(0.3) - 0.1) / 4, -0.5], rtol=1e-6)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), mj.Rodas3P()], ids=["plain", "rosenbrock"])
def test_events_without_a_hook_see_the_true_time_backwards(solver):
    """Diffrax alone shows them -2 at the start, and ends there."""
    event = dfx.Event(lambda t, y, args, **kwargs: t - 1.03, optx.Newton(1e-10, 1e-10))
    field = dfx.ODETerm(lambda t, y, args: -y)
    sol = mj.diffeqsolve(field, solver, 2.0, 0.0, -0.1, jnp.ones(1), event=event)
    np.testing.assert_allclose(sol.ts[0], 1.03, rtol=1e-12)


def nowhere_for_a_while(t, y, args):
    """No state satisfies it between the ends of two steps."""
    return y @ y - 1.0 + jnp.where((t > 0.28) & (t < 0.32), 5.0, 0.0)


@pytest.mark.parametrize("saveat", [SAVED, dfx.SaveAt(t0=True)], ids=["saved", "not saved"])
def test_an_event_where_the_state_cannot_be_corrected(saveat):
    sol = rotate(VALUES, constraint=mj.Constraint(nowhere_for_a_while), saveat=saveat, throw=False)
    assert sol.result == dfx.RESULTS.nonlinear_divergence


def test_a_function_of_a_saved_value_that_cannot_be_corrected():
    """As without `fn`."""
    steps = dict(stepsize_controller=dfx.StepTo(jnp.linspace(0.0, 1.0, 11)), throw=False)
    for fn in (lambda t, y, args: y[0], None):
        options = {} if fn is None else dict(fn=fn)
        for times, result in (
            ([0.15, 0.25], dfx.RESULTS.nonlinear_divergence),
            ([0.15, 0.35], dfx.RESULTS.successful),
        ):
            sol = mj.diffeqsolve(
                ROTATION,
                mj.Projected(dfx.Tsit5(), mj.Constraint(nowhere_between_steps)),
                0.0,
                1.0,
                None,
                START,
                saveat=dfx.SaveAt(ts=jnp.array(times), **options),
                **steps,
            )
            assert sol.result == result


def nowhere_between_steps(t, y, args):
    return y @ y - 1.0 + jnp.where((t > 0.245) & (t < 0.255), 5.0, 0.0)


def test_an_event_in_the_other_direction_is_passed():
    """The second component rises through sin(0.5) at 0.5, and falls through it at pi - 0.5."""
    cond = lambda t, y, args, **kwargs: y[1] - np.sin(0.5)
    ends = [
        mj.diffeqsolve(
            ROTATION,
            mj.Projected(dfx.Tsit5(), CIRCLE),
            0.0,
            3.0,
            0.05,
            START,
            event=dfx.Event(cond, FINDER, direction),
        ).ts[0]
        for direction in (True, False)
    ]
    np.testing.assert_allclose(ends, [0.5, np.pi - 0.5], atol=1e-6)


def test_directions_of_two_events_in_one_step():
    """The second happens earlier: it rises, as is asked for, or is passed where falling is."""

    def end(directions):
        conds = [
            lambda t, y, args, **kwargs: y[0] - 0.9,
            lambda t, y, args, **kwargs: y[1] - 0.3,
        ]
        return mj.diffeqsolve(
            ROTATION,
            mj.Projected(dfx.Tsit5(), CIRCLE),
            0.0,
            3.0,
            0.7,
            START,
            event=dfx.Event(conds, FINDER, directions),
        ).ts[0]

    np.testing.assert_allclose(end([False, True]), np.arcsin(0.3), atol=1e-3)
    np.testing.assert_allclose(end([False, False]), np.arccos(0.9), atol=1e-3)
