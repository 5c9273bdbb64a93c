"""Corners of `mj.StepReplayAdjoint`, where the reference is Diffrax's default on the same solve."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


RATE = jnp.asarray(1.3)
DECAY = dfx.ODETerm(lambda t, y, rate: -rate * y)
Y0 = jnp.array([1.0])


def same(objective, rtol=1e-12, checkpoints=(None,)):
    gradient = lambda adjoint: jax.jit(jax.grad(lambda r: objective(r, adjoint)))(RATE)
    reference = gradient(dfx.RecursiveCheckpointAdjoint())
    assert abs(reference) > 1e-3
    for number in checkpoints:
        replayed = gradient(mj.StepReplayAdjoint(checkpoints=number))
        np.testing.assert_allclose(replayed, reference, rtol=rtol)


def weighted(ys):
    flat = jnp.where(jnp.isfinite(ys), ys, 0.0).reshape(-1)
    return flat @ jnp.arange(1.0, 1 + flat.size)


def test_a_solve_that_ends_early_saves_its_end_once():
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5), t1=True)

    def objective(rate, adjoint):
        options = dict(saveat=saveat, adjoint=adjoint, max_steps=5, throw=False)
        sol = dfx.diffeqsolve(DECAY, dfx.Heun(), 0.0, 1.0, 0.1, Y0, rate, **options)
        return weighted(sol.ys)

    same(objective)


def test_without_a_step_what_is_saved_is_saved_at_t0():
    saveat = dfx.SaveAt(t0=True, fn=lambda t, y, rate: jnp.sin(rate * t) * y)

    def objective(rate, adjoint):
        options = dict(saveat=saveat, adjoint=adjoint, max_steps=5)
        sol = dfx.diffeqsolve(DECAY, dfx.Heun(), 0.5, 0.5, 0.1, Y0, rate, **options)
        return weighted(sol.ys)

    same(objective)


def jumping(saveat, solver, rtol, factor, t0=0.0, dt0=0.1):
    field = lambda t, y, rate: -jnp.where(t < 0.5, 1.0, factor) * rate * y
    steps = dfx.PIDController(rtol=rtol, atol=rtol)
    controller = dfx.ClipStepSizeController(steps, jump_ts=jnp.array([0.5]))

    def objective(rate, adjoint):
        options = dict(saveat=saveat, adjoint=adjoint, max_steps=200)
        options["stepsize_controller"] = controller
        sol = dfx.diffeqsolve(dfx.ODETerm(field), solver, t0, 1.0, dt0, Y0, rate, **options)
        return weighted(sol.ys)

    return objective


def test_a_time_saved_at_a_jump():
    """The step behind it is rejected first."""
    same(jumping(dfx.SaveAt(ts=jnp.array([0.5])), dfx.Bosh3(), 1e-4, 300.0))


def test_a_function_saved_at_the_end_of_a_step_before_a_jump():
    """Diffrax calls it with the time behind the jump."""
    saveat = dfx.SaveAt(steps=True, fn=lambda t, y, rate: jnp.where(t < 0.5, 1.0, 100.0) * rate * y)
    same(jumping(saveat, dfx.Heun(), 1e-3, 1.0))


def test_stages_at_the_end_of_a_step_are_not_behind_the_jump():
    """`t0 + 1 (t1 - t0)` may be: rounded, and the field is another one there."""
    t0 = 0.1303105720275551
    saveat = dfx.SaveAt(ts=jnp.array([0.5]))
    same(jumping(saveat, dfx.Dopri5(), 10.0, 30.0, t0=t0, dt0=0.5 - t0), rtol=1e-10)


@pytest.mark.parametrize("solver", [dfx.LeapfrogMidpoint(), dfx.ReversibleHeun()], ids=str)
def test_what_solvers_remember_is_part_of_the_state(solver):
    """With all states recorded, and with some of them."""

    def objective(rate, adjoint):
        options = dict(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)), adjoint=adjoint)
        sol = dfx.diffeqsolve(DECAY, solver, 0.0, 1.0, 0.05, Y0, rate, max_steps=30, **options)
        return weighted(sol.ys)

    same(objective, checkpoints=(None, 4))


def test_a_time_dependent_constraint_with_times():
    """The correction of what is saved depends on the times that are returned."""
    growing = mj.Constraint(lambda t, y, rate: y @ y - (1 + t) ** rate)
    field = dfx.ODETerm(lambda t, y, rate: rate / 2 / (1 + t) * y + jnp.stack([-y[1], y[0]]))

    def objective(rate, adjoint):
        solver = mj.Projected(dfx.Heun(), growing)
        options = dict(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)), adjoint=adjoint)
        y0 = jnp.array([1.0, 0.0])
        sol = mj.diffeqsolve(field, solver, 0.0, 1.0, 0.1, y0, rate, max_steps=20, **options)
        return weighted(sol.ys)

    same(objective)


def test_no_room_for_steps():
    adjoint = mj.StepReplayAdjoint()
    options = dict(adjoint=adjoint, max_steps=0, throw=False)
    end = lambda y0: dfx.diffeqsolve(DECAY, dfx.Heun(), 0.0, 1.0, 0.1, y0, RATE, **options).ys[0, 0]
    assert jax.grad(end)(Y0) == 1


def test_none_in_the_state_and_in_what_is_saved():
    circle = mj.Constraint(lambda t, y, args: y["a"] @ y["a"] - 1)

    def field(t, y, args):
        return {"a": args * jnp.stack([-y["a"][1], y["a"][0]]), "b": None}

    def objective(rate):
        sol = mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.Projected(dfx.Dopri8(), circle),
            0.0,
            1.0,
            0.1,
            {"a": jnp.array([1.0, 0.0]), "b": None},
            rate,
            saveat=dfx.SaveAt(ts=jnp.array([0.3, 0.7]), fn=lambda t, y, args: (y["a"][0], None)),
        )
        return jnp.sum(sol.ys[0])

    expected = -0.3 * np.sin(0.3) - 0.7 * np.sin(0.7)
    np.testing.assert_allclose(jax.jit(jax.grad(objective))(1.0), expected, rtol=1e-8)
