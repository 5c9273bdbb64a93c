"""Mistakes that a step hook around Diffrax invites, each with a test named after it."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
TURN = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
START = jnp.array([1.0, 0.0])
ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-6)


def off_circle(ys):
    return np.abs(np.sum(np.square(ys), axis=-1) - 1).max()


@pytest.mark.parametrize("solver", [dfx.Bosh3(), dfx.Tsit5(), dfx.Dopri5(), dfx.Dopri8()])
def test_stale_first_same_as_last_stage(solver):
    """The derivative carried to the next step belongs to the corrected state."""
    problem = mj.problems.rigid_body()
    projected = mj.Projected(solver, mj.Constraint(lambda t, y, args: y @ y - 1.0))
    terms, y0, args = problem.terms, problem.y0, problem.args
    state = projected.init(terms, 0.0, 3.0, y0, args)
    y1, _, info, state, _ = projected.step(terms, 0.0, 3.0, y0, args, state, made_jump=False)
    fresh = terms.vf(3.0, y1, args)
    assert np.abs(info["correction"]).max() > 1e-8
    np.testing.assert_allclose(state.memory, fresh, rtol=0, atol=1e-15)


def test_stale_derivative_of_a_solver_with_its_own_stages():
    """A step depends on the state it starts from, not on the uncorrected one before: in a batch
    Diffrax evaluates anew for all lanes if one of them needs it, and lanes would differ."""
    problem = mj.problems.rigid_body()
    solver = dfx.HalfSolver(dfx.Tsit5())
    projected = mj.Projected(solver, mj.Constraint(lambda t, y, args: y @ y - 1.0))
    terms, y0, args = problem.terms, problem.y0, problem.args
    start, middle, end = jnp.asarray(0.0), jnp.asarray(2.0), jnp.asarray(4.0)
    state = projected.init(terms, start, middle, y0, args)
    y1, _, info, state, _ = projected.step(terms, start, middle, y0, args, state, made_jump=False)
    assert np.abs(info["correction"]).max() > 1e-6
    carried, *_ = projected.step(terms, middle, end, y1, args, state, made_jump=False)
    fresh = projected.init(terms, middle, end, y1, args)
    anew, *_ = projected.step(terms, middle, end, y1, args, fresh, made_jump=False)
    np.testing.assert_allclose(carried, anew, rtol=0, atol=1e-10)


def test_interpolant_of_a_step_without_projection_is_off():
    """Why saved values need their own correction: this is what Diffrax alone returns."""
    ts = jnp.linspace(0.0, 3.0, 50)
    options = dict(saveat=dfx.SaveAt(ts=ts), stepsize_controller=ADAPTIVE)
    solver = mj.Projected(dfx.Tsit5(), CIRCLE)
    raw = dfx.diffeqsolve(TURN, solver, 0.0, 3.0, 0.1, START, **options)
    corrected = mj.diffeqsolve(TURN, solver, 0.0, 3.0, 0.1, START, **options)
    assert off_circle(raw.ys) > 1e-9
    assert off_circle(corrected.ys) <= 1e-15


def growing(t, y, args):
    return y @ y - (1 + t) ** 2


def spiral(t, y, args):
    return y / (1 + t) + jnp.stack([-y[1], y[0]])


def test_time_dependent_constraint_backwards():
    """Steps run in negated time there; the residual has to see the true one."""
    end = 3.0 * jnp.array([np.cos(2.0), np.sin(2.0)])
    for solve in (mj.diffeqsolve, dfx.diffeqsolve):
        sol = solve(
            dfx.ODETerm(spiral),
            mj.Projected(dfx.Tsit5(), mj.Constraint(growing)),
            2.0,
            0.0,
            -0.05,
            end,
            saveat=dfx.SaveAt(steps=True),
            stepsize_controller=ADAPTIVE,
        )
        used = np.isfinite(sol.ts)
        radius = np.sqrt(np.sum(np.square(sol.ys[used]), axis=1))
        np.testing.assert_allclose(radius, 1 + np.asarray(sol.ts[used]), atol=2e-15)
        np.testing.assert_allclose(sol.ys[used][-1], START, atol=1e-4)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8(), dfx.Dopri5(), dfx.Heun()])
def test_dense_output_is_continuous_across_steps(solver):
    """The local interpolant ends at the corrected state, also for solvers that ignore y1."""
    sol = dfx.diffeqsolve(
        TURN,
        mj.Projected(solver, CIRCLE),
        0.0,
        3.6,
        1.2,
        START,
        saveat=dfx.SaveAt(steps=True, dense=True),
    )
    assert float(np.abs(sol.interpolation.infos["correction"][0]).max()) > 1e-8
    for t, y in zip(sol.ts[:2], sol.ys[:2]):
        np.testing.assert_allclose(sol.evaluate(t, left=True), y, rtol=0, atol=1e-15)
        np.testing.assert_allclose(sol.evaluate(t, left=False), y, rtol=0, atol=1e-15)
        np.testing.assert_allclose(sol.evaluate(t - 1e-9), y, rtol=0, atol=5e-9)


@pytest.mark.parametrize("root_finder", [optx.Newton(1e-10, 1e-10), optx.Bisection(1e-10, 1e-10)])
@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8()])
def test_events_between_steps(solver, root_finder):
    """Large steps: the raw interpolant would jump by 1e-3 and hide the sign change."""
    crossings = np.linspace(0.4, 1.7, 5)
    event = dfx.Event(lambda t, y, args, **kwargs: y[0] - jnp.cos(args), root_finder)
    projected = mj.Projected(solver, CIRCLE)
    for angle in crossings:
        sol = mj.diffeqsolve(TURN, projected, 0.0, 4.0, 0.9, START, jnp.asarray(angle), event=event)
        assert sol.result == dfx.RESULTS.event_occurred
        np.testing.assert_allclose(sol.ts[0], angle, atol=5e-3)
        np.testing.assert_allclose(sol.ys[0], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_events_see_true_time_backwards():
    seen = dfx.Event(
        lambda t, y, args, *, t0, t1, **kwargs: t - 0.7 + 0 * (t0 - t1), optx.Newton(1e-12, 1e-12)
    )
    sol = mj.diffeqsolve(TURN, mj.Projected(dfx.Tsit5(), CIRCLE), 2.0, 0.0, -0.1, START, event=seen)
    np.testing.assert_allclose(sol.ts[0], 0.7, atol=1e-12)


def test_steady_state_event():
    """An event of Diffrax that evaluates the vector field through the solver."""
    problem = mj.problems.sphere_flow()
    sol = mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        0.0,
        1000.0,
        None,
        problem.y0,
        problem.args,
        event=dfx.Event(dfx.steady_state_event(rtol=1e-4, atol=1e-4)),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    assert sol.result == dfx.RESULTS.event_occurred
    np.testing.assert_allclose(problem.terms.vf(0.0, sol.ys[0], problem.args), 0, atol=1e-3)
    assert off_circle(sol.ys) <= 1e-14


def test_nan_in_a_rejected_step_and_the_gradient():
    """The first step is far too long; g is NaN there. The gradient must not be."""

    def residual(t, y, args):
        return y @ y - args + 0.0 * jnp.sqrt(1.3 - y[0] ** 2 - y[1] ** 2)

    def end(radius2):
        y0 = jnp.sqrt(radius2) * START
        sol = mj.diffeqsolve(
            TURN,
            mj.Projected(dfx.Tsit5(), mj.Constraint(residual)),
            0.0,
            20.0,
            8.0,
            y0,
            radius2,
            stepsize_controller=ADAPTIVE,
        )
        return sol.ys[0] @ jnp.array([1.0, 2.0]), sol.stats["num_rejected_steps"]

    gradient, rejected = jax.jit(jax.grad(end, has_aux=True))(jnp.asarray(1.1))
    assert int(rejected) > 0
    # y(20) = sqrt(r) (cos 20, sin 20)
    exact = (np.cos(20.0) + 2 * np.sin(20.0)) / (2 * np.sqrt(1.1))
    np.testing.assert_allclose(gradient, exact, rtol=1e-4)


def test_nan_at_the_end_of_a_rejected_step_and_the_gradient():
    """The stages of the first step are near the circle, its end is not, and neither the field nor g is
    defined there. An adjoint that goes through rejected steps must not see it."""
    defined = lambda y: 0.0 * jnp.sqrt(y @ y - 0.9)
    terms = dfx.ODETerm(lambda t, y, args: args * TURN.vf(t, y, None) + defined(y))
    hook = mj.Projected(dfx.Bosh3(), mj.Constraint(lambda t, y, args: y @ y - 1 + defined(y)))
    options = dict(stepsize_controller=ADAPTIVE, adjoint=dfx.RecursiveCheckpointAdjoint())

    def end(rate):
        sol = mj.diffeqsolve(terms, hook, 0.0, 2.0, 2**0.5, START, rate, **options)
        return sol.ys[0, 0], sol.stats["num_rejected_steps"]

    gradient, rejected = jax.jit(jax.grad(end, has_aux=True))(1.0)
    assert rejected > 0
    np.testing.assert_allclose(gradient, -2 * np.sin(2.0), rtol=1e-4)


def test_the_slope_of_dense_output_between_steps():
    """Bending the interpolant to the corrected end leaves its slope there: that of the field."""
    options = dict(saveat=dfx.SaveAt(dense=True), stepsize_controller=dfx.StepTo([0.0, 0.7, 1.4]))
    sol = dfx.diffeqsolve(TURN, mj.Projected(dfx.Tsit5(), CIRCLE), 0.0, 1.4, None, START, **options)
    field = TURN.vf(0.7, sol.evaluate(0.7), None)
    for left in (True, False):
        np.testing.assert_allclose(sol.derivative(0.7, left=left), field, rtol=0, atol=1e-12)


def test_unreached_outputs_and_the_gradient():
    """Values after an event stay infinite, and do not turn the gradient into NaN."""

    def end(theta):
        speed, radius = theta
        sol = mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: args[0] * jnp.stack([-y[1], y[0]])),
            mj.Projected(dfx.Tsit5(), mj.Constraint(lambda t, y, args: jnp.sqrt(y @ y) - args[1])),
            0.0,
            2.0,
            0.1,
            radius * START,
            (speed, radius),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 9)),
            event=dfx.Event(lambda t, y, args, **kwargs: y[0], optx.Newton(1e-9, 1e-9)),
        )
        used = jnp.isfinite(sol.ts)
        return jnp.sum(jnp.where(used[:, None], sol.ys, 0.0)[:3]), used

    theta = (jnp.asarray(1.0), jnp.asarray(1.0))
    (d_speed, d_radius), used = jax.jit(jax.grad(end, has_aux=True))(theta)
    assert 3 <= used.sum() < 9
    t = np.array([0.0, 0.25, 0.5])
    np.testing.assert_allclose(d_speed, np.sum(t * (np.cos(t) - np.sin(t))), rtol=1e-6)
    np.testing.assert_allclose(d_radius, np.sum(np.cos(t) + np.sin(t)), rtol=1e-6)


def test_arrays_in_the_constraint_and_dense_output():
    """`interpolation_cls` is static: arrays in it would leak out of the trace."""

    class Circle(eqx.Module):
        radius: jax.Array

        def __call__(self, t, y, args):
            return y @ y - self.radius**2

    def at(radius, t):
        sol = mj.diffeqsolve(
            TURN,
            mj.Projected(dfx.Tsit5(), mj.Constraint(Circle(radius))),
            0.0,
            1.0,
            0.1,
            radius * START,
            saveat=dfx.SaveAt(dense=True),
        )
        return sol.evaluate(t), sol.derivative(t)

    radius, t = jnp.asarray(2.0), jnp.asarray(0.33)
    y, dy = jax.jit(at)(radius, t)
    np.testing.assert_allclose(y, 2 * np.array([np.cos(0.33), np.sin(0.33)]), atol=1e-7)
    np.testing.assert_allclose(y @ dy, 0, atol=1e-14)
    slope = jax.jit(jax.jacrev(lambda r: at(r, t)[0]))(radius)
    np.testing.assert_allclose(slope, [np.cos(0.33), np.sin(0.33)], atol=1e-7)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8(), dfx.Dopri5()])
def test_projected_dense_output_ends_at_the_steps(solver):
    """Correcting the raw interpolant at the end of a step gives the corrected state again."""
    saveat = dfx.SaveAt(steps=True, dense=True)
    sol = mj.diffeqsolve(TURN, mj.Projected(solver, CIRCLE), 0.0, 3.6, 1.2, START, saveat=saveat)
    for t, y in zip(sol.ts[:2], sol.ys[:2]):
        for left in (True, False):
            np.testing.assert_allclose(sol.evaluate(t, left=left), y, rtol=0, atol=5e-14)
        np.testing.assert_allclose(sol.evaluate(t - 1e-9), y, rtol=0, atol=5e-9)


def test_dense_increment_has_the_sign_of_diffrax():
    sol = mj.diffeqsolve(
        TURN, mj.Projected(dfx.Tsit5(), CIRCLE), 0.0, 1.0, 0.1, START, saveat=dfx.SaveAt(dense=True)
    )
    plain = dfx.diffeqsolve(TURN, dfx.Tsit5(), 0.0, 1.0, 0.1, START, saveat=dfx.SaveAt(dense=True))
    np.testing.assert_allclose(sol.evaluate(0.2, 0.7), plain.evaluate(0.2, 0.7), atol=1e-6)


def test_pytree_states_and_residuals():
    def field(t, y, args):
        return {"a": (-y["b"],), "b": y["a"][0]}

    constraint = mj.Constraint(lambda t, y, args: {"circle": (y["a"][0] ** 2 + y["b"] ** 2 - 1,)})
    y0 = {"a": (jnp.asarray([1.0]),), "b": jnp.asarray([0.0])}
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        mj.Projected(dfx.Tsit5(), constraint),
        0.0,
        1.0,
        0.1,
        y0,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 4)),
    )
    np.testing.assert_allclose(sol.ys["a"][0] ** 2 + sol.ys["b"] ** 2, 1, atol=1e-15)


def test_user_function_in_saveat_sees_the_manifold():
    violation = lambda t, y, args: (t, y @ y - 1.0)
    for t0, t1, dt0 in ((0.0, 2.0, 0.2), (2.0, 0.0, -0.2)):
        ts = jnp.linspace(t0, t1, 33)
        sol = mj.diffeqsolve(
            TURN,
            mj.Projected(dfx.Tsit5(), CIRCLE),
            t0,
            t1,
            dt0,
            START,
            saveat=dfx.SaveAt(ts=ts, fn=violation),
        )
        np.testing.assert_allclose(sol.ys[0], ts)
        assert np.abs(sol.ys[1]).max() <= 1e-15


def test_first_step_without_dt0():
    """Diffrax always starts with 0.01; here the first step suits the problem."""
    for rate in (1e4, 1e-4):
        sol = mj.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: args * jnp.stack([-y[1], y[0]])),
            mj.Projected(dfx.Tsit5(), CIRCLE),
            0.0,
            3.0 / rate,
            None,
            START,
            rate,
            saveat=dfx.SaveAt(steps=True),
            stepsize_controller=ADAPTIVE,
        )
        assert 1e-3 <= float(sol.ts[0]) * rate <= 0.5
        assert int(sol.stats["num_steps"]) < 60


def test_restart_continues_the_same_run():
    solver = mj.Projected(dfx.Tsit5(), CIRCLE)
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    options = dict(stepsize_controller=dfx.ConstantStepSize())
    half = mj.diffeqsolve(TURN, solver, 0.0, 1.0, 0.1, START, saveat=saveat, **options)
    rest = mj.diffeqsolve(
        TURN, solver, 1.0, 2.0, 0.1, half.ys[0], solver_state=half.solver_state, **options
    )
    whole = mj.diffeqsolve(TURN, solver, 0.0, 2.0, 0.1, START, **options)
    np.testing.assert_allclose(rest.ys, whole.ys, atol=1e-14)


def test_correction_larger_than_the_error_estimate_rejects():
    """The correction is a lower bound of the local error: an estimate of zero is overruled."""

    def linear(t, y, args):  # exact for a straight line, so that the estimate is zero
        return jnp.stack([jnp.zeros_like(t), jnp.ones_like(t)])

    options = dict(
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.PIDController(rtol=1e-3, atol=1e-3),
        max_steps=4096,
    )
    args = (dfx.ODETerm(linear), mj.Projected(dfx.Dopri5(), CIRCLE), 0.0, 0.5, 0.5, START)
    blind = dfx.diffeqsolve(*args, **options)
    aware = mj.diffeqsolve(*args, **options)
    assert int(blind.stats["num_steps"]) < int(aware.stats["num_steps"])
    assert float(aware.stats["largest_correction"]) < 2e-3


def test_statistics_count_projections():
    sol = mj.diffeqsolve(TURN, mj.Projected(dfx.Tsit5(), CIRCLE), 0.0, 1.0, 0.1, START)
    steps, iterations = int(sol.stats["num_steps"]), int(sol.stats["num_projection_iterations"])
    assert steps <= iterations <= 20 * steps
    assert 0 < float(sol.stats["largest_correction"]) < 1e-6
    assert sol.solver_state is None
