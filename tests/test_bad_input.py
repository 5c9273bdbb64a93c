"""What users get wrong: each case names the argument and says what to write instead."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
TURN = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
START = jnp.array([1.0, 0.0])


def solve(constraint=CIRCLE, y0=START, args=None, **options):
    options = {"dt0": 0.1, **options}
    dt0 = options.pop("dt0")
    return mj.diffeqsolve(
        TURN, mj.Projected(dfx.Tsit5(), constraint), 0.0, 1.0, dt0, y0, args, **options
    )


@pytest.mark.parametrize(
    ("y0", "message"),
    [
        (np.array([1, 0]), "`y0`.*int64.*float"),
        ((1, 0), "`y0`.*int.*float"),
        (jnp.array([1.0, 0.0], jnp.bfloat16), "`y0`.*bfloat16.*too few"),
        (jnp.array([1.0 + 0j, 0.0]), "`y0`.*complex.*z.real, z.imag"),
        (jnp.array([True, False]), "`y0`.*bool"),
        (["a"], "`y0`.*real arrays"),
    ],
)
def test_state_of_the_wrong_type(y0, message):
    with pytest.raises(TypeError, match=message):
        solve(y0=y0)


def test_empty_state():
    with pytest.raises(ValueError, match="`y0` has no array leaves"):
        solve(y0=())


@pytest.mark.parametrize(
    ("residual", "error", "message"),
    [
        (lambda t, y, args: jnp.concatenate([y, y]), ValueError, "4 residuals.*2 numbers.*Remove"),
        (lambda t, y, args: None, ValueError, "no residual at all.*`return`"),
        (lambda t, y, args: jnp.asarray(1), TypeError, "residual of type int"),
        (lambda t, y, args: y[0].astype(complex), TypeError, "complex128.*real and imaginary"),
        (lambda t, y, args: "on", TypeError, "leaf of type str"),
    ],
)
def test_residual_of_the_wrong_type_or_shape(residual, error, message):
    with pytest.raises(error, match=message):
        solve(mj.Constraint(residual))


def test_constraint_that_is_not_callable(as_a_user_meets_it):
    with pytest.raises(TypeError, match="callable"):
        mj.Constraint(jnp.zeros(3))
    with pytest.raises(TypeError, match="callable"):
        mj.Invariants(1.0, y0=START)


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (lambda t, y, args: y @ y - 1 + jnp.log(y[1] - 1.0), "not finite"),
        (lambda t, y, args: jnp.stack([y[0] - 1, 2 * y[0] - 2]), "full rank.*redundant"),
        (lambda t, y, args: jnp.asarray(0.3), "ignores y"),
        (lambda t, y, args: y[1] ** 2, "singular point"),
        (lambda t, y, args: y @ y + 1.0, "could not be made consistent"),
    ],
)
def test_starts_that_cannot_work(residual, message):
    constraint = mj.Constraint(residual)
    with pytest.raises(RuntimeError, match=f"(?s){message}"):
        solve(constraint)
    with pytest.raises(RuntimeError, match=f"(?s){message}"):
        mj.consistent_state(constraint, 0.0, START)
    # Under jit and without exceptions: a result code.
    sol = jax.jit(lambda y0: solve(constraint, y0, throw=False))(START)
    assert sol.result == dfx.RESULTS.nonlinear_divergence
    _, info = mj.consistent_state(constraint, 0.0, START, throw=False)
    assert not bool(info.success)


@pytest.mark.parametrize("consistent", ["project", "check"])
def test_a_start_that_is_not_finite(consistent):
    """Also where the constraint does not see it."""
    first = mj.Constraint(lambda t, y, args: y[0] - jnp.cos(t))
    starts = jnp.array([[1.0, 0.0], [1.0, jnp.nan]])
    options = dict(
        consistent=consistent, dt0=None, stepsize_controller=dfx.PIDController(1e-3, 1e-3)
    )
    with pytest.raises(RuntimeError, match="`y0` has numbers that are NaN or infinite"):
        solve(first, starts[1], **options)
    for move in (mj.project, mj.consistent_state):
        with pytest.raises(RuntimeError, match="has numbers that are NaN or infinite"):
            move(first, 0.0, starts[1])
    sol = jax.vmap(lambda y0: solve(first, y0, throw=False, **options))(starts)
    assert (sol.result == dfx.RESULTS.successful).tolist() == [True, False]
    assert (sol.result == dfx.RESULTS.nonlinear_divergence).tolist() == [False, True]
    assert sol.stats["num_steps"][1] == 0
    forwards = solve(first, starts[1], throw=False, adjoint=dfx.ForwardMode(), **options)
    assert forwards.stats["num_steps"] == 0


@pytest.mark.parametrize("solver", [dfx.Bosh3(), mj.Rodas3P()], ids=["explicit", "Rosenbrock"])
def test_a_start_that_is_not_finite_without_a_hook(solver):
    """An adaptive controller rejected `max_steps` steps, its tolerance being NaN."""
    starts = jnp.array([[1.0, 0.0], [1.0, jnp.nan]])
    options = dict(t0=0.0, t1=0.1, dt0=None, stepsize_controller=dfx.PIDController(1e-3, 1e-3))
    single = lambda y0, throw: mj.diffeqsolve(TURN, solver, y0=y0, throw=throw, **options)
    with pytest.raises(RuntimeError, match="The state is not finite"):
        single(starts[1], True)
    batch = jax.vmap(lambda y0: single(y0, False))(starts)
    for sol in (batch, mj.solve_ensemble(TURN, solver, y0s=starts, **options)):
        assert (sol.result == dfx.RESULTS.nonfinite).tolist() == [False, True]
        assert sol.stats["num_steps"].tolist()[1] == 0


def test_inconsistent_start_is_moved_and_reported():
    sol = solve(y0=jnp.array([1.1, 0.0]), saveat=dfx.SaveAt(t0=True, t1=True))
    np.testing.assert_allclose(np.sum(np.square(sol.ys), axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(sol.stats["initial_correction"], 0.1 / 2.1, rtol=1e-12)
    assert float(solve().stats["initial_correction"]) == 0.0


def test_check_refuses_and_assume_trusts():
    off = jnp.array([1.1, 0.0])
    with pytest.raises(RuntimeError, match='(?s)`y0` is not on the manifold.*"project"'):
        solve(y0=off, consistent="check")
    assert solve(y0=off, consistent="check", throw=False).result != dfx.RESULTS.successful
    assert solve(consistent="check").result == dfx.RESULTS.successful
    sol = solve(y0=off, consistent="assume", saveat=dfx.SaveAt(t0=True, t1=True))
    assert np.array_equal(sol.ys[0], off)
    # No step from there is small enough for the correction: it must not be tried for ever.
    adaptive = dfx.PIDController(rtol=1e-6, atol=1e-6)
    sol = solve(y0=off, consistent="assume", stepsize_controller=adaptive, max_steps=None)
    np.testing.assert_allclose(sol.ys[0] @ sol.ys[0], 1, atol=1e-15)


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_consistent_is_one_of_three_words():
    with pytest.raises(ValueError, match="`consistent`.*'project', 'check' or 'assume'"):
        solve(consistent="maybe")


def test_constraint_that_becomes_unsatisfiable():
    vanishing = mj.Constraint(lambda t, y, args: y @ y - jnp.where(t < 0.5, 1.0, -1.0))
    adaptive = dict(stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6))
    for options in ({}, adaptive, dict(max_steps=None, **adaptive)):
        with pytest.raises(RuntimeError):
            solve(vanishing, **options)
        sol = solve(vanishing, throw=False, **options)
        assert sol.result == dfx.RESULTS.nonlinear_divergence


def test_nan_in_the_constraint_on_the_way():
    """log(1 - 2 t) is NaN from t = 1/2 on: a code, not a hang and not a value."""
    breaking = mj.Constraint(lambda t, y, args: y @ y - 1 + 0 * jnp.log(1 - 2 * t))
    adaptive = dict(stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6))
    for options in ({}, adaptive):
        sol = solve(breaking, throw=False, **options)
        assert sol.result == dfx.RESULTS.nonlinear_divergence


def test_violation_of_mismatched_trajectories():
    with pytest.raises(ValueError, match="leading axis of length 3"):
        mj.constraint_violation(CIRCLE, jnp.zeros(3), jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match="scalar or of shape"):
        mj.constraint_violation(CIRCLE, jnp.zeros((3, 3)), jnp.zeros((3, 2)))


@pytest.mark.parametrize(
    "hook",
    [
        mj.Projected,
        mj.LocalCoordinates,
        lambda *a: mj.Stabilized(*a, stabilization=mj.InvariantStabilization(1.0)),
    ],
    ids=["projected", "coordinates", "stabilized"],
)
def test_a_constraint_of_no_equations_leaves_the_solver_alone(hook):
    nothing = mj.Constraint(lambda t, y, args: jnp.zeros(0))
    options = dict(stepsize_controller=dfx.PIDController(1e-3, 1e-3))
    call = lambda solver: mj.diffeqsolve(TURN, solver, 0.0, 1.0, 0.1, START, **options)
    hooked, plain = call(hook(dfx.Bosh3(), nothing)), call(dfx.Bosh3())
    assert np.array_equal(hooked.ys, plain.ys)
    assert hooked.stats["num_steps"] == plain.stats["num_steps"]
    batch = mj.solve_ensemble(
        TURN, hook(dfx.Bosh3(), nothing), 0.0, 1.0, 0.1, START[None], **options
    )
    np.testing.assert_allclose(batch.ys[0], plain.ys, atol=1e-15)
    with pytest.raises(ValueError, match=r"empty residual.*mj.diffeqsolve"):
        dfx.diffeqsolve(TURN, hook(dfx.Bosh3(), nothing), 0.0, 1.0, 0.1, START)


def test_output_times_are_a_vector():
    with pytest.raises(ValueError, match="`saveat.ts` must be a vector"):
        solve(saveat=dfx.SaveAt(ts=jnp.array([[0.1, 0.2]])))
