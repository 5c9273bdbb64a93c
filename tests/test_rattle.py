"""RATTLE: order, symmetry, energy over long times, derivatives, and what it refuses."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import multibody_cases as cases
import numpy as np
import pytest
from differences import slopes_by_differences

import manifold_jax as mj


DOUBLE = mj.problems.double_pendulum()
PENDULUM = mj.problems.pendulum()
mb = mj.multibody


def solve(problem, order, t1, h, args=None, **options):
    args = problem.args if args is None else args
    options = {"max_steps": 100_000} | options
    solver = mj.rattle(problem.system, order=order)
    y0 = options.pop("y0", problem.with_args(args).y0)
    t0 = options.pop("t0", 0.0)
    return mj.diffeqsolve(problem.terms, solver, t0, t1, h, y0, args, **options)


def at_end(sol):
    return jax.tree.map(lambda leaf: leaf[-1], sol.ys)


def energy(y):
    """Of the pendulum."""
    q, v = y
    return 0.5 * jnp.sum(v**2, axis=-1) + PENDULUM.args.gravity * q[..., 1]


@pytest.mark.parametrize(
    ("order", "steps"),
    [
        pytest.param(2, 100, marks=pytest.mark.slow),
        (4, 50),
        pytest.param(6, 40, marks=pytest.mark.slow),
    ],
)
def test_order(order, steps):
    """Of the global error, against an independent solution."""
    exact = DOUBLE.reference(1.0)
    errors = []
    for number in (steps, 2 * steps):
        sol = solve(DOUBLE, order, 1.0, 1.0 / number)
        ours = at_end(sol)
        assert mj.constraint_violation(DOUBLE.constraint, 1.0, ours, DOUBLE.args) < 1e-15
        assert sol.stats["largest_correction"] < 1e-14  # steps end on the manifold by themselves
        errors.append(max(np.max(np.abs(a - b)) for a, b in zip(ours, exact, strict=True)))
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2


def test_it_is_reversible():
    """As many steps back, with the sign of the time changed, lead to the start: rounding errors do not
    add up. Without what is carried from step to step it is missed by 1e-13."""
    forth = solve(DOUBLE, 2, 10.0, 0.001)
    back = solve(DOUBLE, 2, 0.0, -0.001, t0=10.0, y0=at_end(forth))
    assert forth.stats["num_steps"] == back.stats["num_steps"] == 10_000
    for ours, start in zip(at_end(back), DOUBLE.y0, strict=True):
        np.testing.assert_allclose(ours, start, rtol=0, atol=2e-14)


def test_energy_has_no_trend():
    """A hundred swings: the error of the energy returns, while that of a projected method of higher order
    and with as many steps grows."""
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 200.0, 401))
    symplectic = solve(PENDULUM, 4, 200.0, 0.04, saveat=saveat)
    hook = mj.Projected(dfx.Dopri5(), PENDULUM.constraint)
    options = dict(saveat=saveat, max_steps=100_000)
    other = mj.diffeqsolve(
        PENDULUM.terms, hook, 0.0, 200.0, 0.04, PENDULUM.y0, PENDULUM.args, **options
    )
    errors = [np.asarray(energy(sol.ys) - energy(PENDULUM.y0)) for sol in (symplectic, other)]
    first, last = (np.mean(part) for part in np.split(errors[0][1:], [200]))
    assert abs(last - first) < 0.02 * np.max(np.abs(errors[0]))
    first, last = (np.mean(part) for part in np.split(errors[1][1:], [200]))
    assert abs(last - first) > 0.3 * np.max(np.abs(errors[1]))


def test_angular_momentum_is_kept_to_round_off():
    """About the vertical axis, of a spherical pendulum: what a symmetry of the system conserves."""
    problem = mj.problems.spherical_pendulum()
    y0 = jnp.array([0.8, 0.0, -0.6]), jnp.array([0.3, 2.0, 0.4])
    q, v = solve(problem, 2, 40.0, 0.01, y0=y0, saveat=dfx.SaveAt(steps=True), max_steps=4000).ys
    vertical = np.asarray(q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0])
    np.testing.assert_allclose(vertical, 1.6, rtol=0, atol=5e-15)


@pytest.mark.slow
def test_gradients():
    """In both modes, and against differences; each parameter alone, in the constraint, too."""
    end = lambda args: at_end(solve(DOUBLE, 4, 0.5, 0.05, args, max_steps=16))[0][2]
    args = DOUBLE.args
    reverse, forward = jax.jit(jax.grad(end))(args), jax.jit(jax.jacfwd(end))(args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), reverse, forward)
    value = jax.jit(end)
    for name in args._fields:
        slopes = slopes_by_differences(value, args, name)
        np.testing.assert_allclose(np.ravel(getattr(reverse, name)), slopes, rtol=1e-7, atol=1e-9)


def test_saved_values_and_dense_output():
    """Between the steps they are of third order, and on the manifold."""
    ts = jnp.linspace(0.0, 1.0, 23)
    errors = []
    for h in (0.02, 0.01):
        sol = solve(PENDULUM, 6, 1.0, h, saveat=dfx.SaveAt(ts=ts, dense=True))
        assert (
            jnp.max(mj.constraint_violation(PENDULUM.constraint, ts, sol.ys, PENDULUM.args)) < 1e-15
        )
        dense = jax.vmap(sol.evaluate)(ts)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14), dense, sol.ys)
        exact = PENDULUM.reference(np.asarray(ts))
        errors.append(np.max(np.abs(np.asarray(sol.ys[1]) - exact[1])))
    assert 2.5 < np.log2(errors[0] / errors[1]) < 4.5


@pytest.mark.slow
def test_a_batch_is_one_by_one():
    angles = jnp.array([0.3, 1.0, 2.0])
    starts = jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=1), jnp.zeros((3, 2))
    one = lambda y0: at_end(solve(PENDULUM, 2, 1.0, 0.01, y0=y0, max_steps=128))
    together = jax.jit(jax.vmap(one))(starts)
    for i in range(3):
        alone = one(jax.tree.map(lambda x, i=i: x[i], starts))
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-13), together, alone
        )

    def in_lanes(args):
        parts = PENDULUM.terms, mj.rattle(PENDULUM.system), 0.0, 1.0, 0.01, starts, args
        return mj.solve_ensemble(*parts, args_axes=None, max_steps=128)

    ensemble = in_lanes(PENDULUM.args)
    assert ensemble.execution == "in lanes"
    assert not ensemble.failed.any()
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[:, -1], b, atol=1e-13), ensemble.ys, together
    )
    lanes = jax.grad(lambda args: jnp.sum(in_lanes(args).ys[0][:, -1, 0]))(PENDULUM.args)
    batch = lambda args: jax.vmap(
        lambda y0: at_end(solve(PENDULUM, 2, 1.0, 0.01, args, y0=y0, max_steps=128))[0][0]
    )(starts)
    mapped = jax.jit(jax.grad(lambda args: jnp.sum(batch(args))))(PENDULUM.args)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-13), lanes, mapped
    )


@pytest.mark.slow
def test_bodies_in_the_plane():
    """A four-bar linkage from joints: equal to its known solution, to second order."""
    problem = mj.problems.four_bar()
    robot = cases.four_bar(problem.args)
    y0 = cases.four_bar_state(robot, problem.y0)
    exact = problem.reference(0.2)[0].reshape(3, 3)
    errors = []
    for h in (0.002, 0.001):
        sol = mj.diffeqsolve(robot.system.terms, mj.rattle(robot.system), 0.0, 0.2, h, y0)
        errors.append(np.max(np.abs(sol.ys[0].position[-1] - exact[:, :2])))
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.2


@pytest.mark.slow
def test_sparse_constraints_are_as_dense_ones():
    """Also in a composition, whose loop carries the structure of the rows."""
    chain, ends = mj.problems.chain(), []
    given = chain.system.mass_matrix.function, chain.system.holonomic, chain.system.force
    for structure in ("sparse", "dense"):
        system = mj.MechanicalSystem(*given, structure=structure)
        parts = system.terms, mj.rattle(system, order=4), 0.0, 0.05, 0.01, chain.y0, chain.args
        ends.append(at_end(mj.diffeqsolve(*parts, max_steps=8)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), *ends)


def test_resets():
    """A rod that loses half of its velocity at the bottom: the event is where the solution has it."""
    bounce = mj.Reset(lambda t, y, args: y[0][0], lambda t, y, args: (y[0], -0.5 * y[1]))
    sol = solve(PENDULUM, 6, 1.0, 0.02, resets=(bounce,), max_steps=128)
    assert sol.resets.number == 1
    exact = PENDULUM.reference(np.asarray(sol.resets.times[:1]))
    np.testing.assert_allclose(exact[0][0], [0.0, -1.0], atol=1e-8)
    np.testing.assert_allclose(sol.resets.after[1][0], -0.5 * exact[1][0], atol=1e-8)


def test_single_precision():
    """A hundred thousand steps end where those in double precision do (without what is carried from step to
    step 1.4e-4 beside it), and all are on the manifold to a few units of rounding."""
    h, steps, args = 1 / 128, 100_000, PENDULUM.args._replace(gravity=jnp.asarray(9.8125))
    exact = at_end(solve(PENDULUM, 2, steps * h, h, args, max_steps=None))
    with jax.enable_x64(False):
        single = mj.problems.pendulum()
        args = single.args._replace(gravity=jnp.asarray(9.8125))
        y = at_end(solve(single, 2, steps * h, h, args, max_steps=None))
        assert y[0].dtype == jnp.float32
        saveat = dfx.SaveAt(steps=True)
        sol = solve(single, 2, 100.0, h, args, saveat=saveat, max_steps=12_800)
    np.testing.assert_allclose(y[0], exact[0], rtol=0, atol=5e-5)
    q, v = (np.asarray(leaf, np.float64) for leaf in sol.ys)
    unit = np.finfo(np.float32).eps
    assert np.max(np.abs(np.sum(q * q, axis=1) - 1) / 2) < 2 * unit
    assert np.max(np.abs(np.sum(q * v, axis=1))) < 4 * unit


def test_bad_input(as_a_user_meets_it):
    with pytest.raises(TypeError, match=r"`system` must be an `mj.MechanicalSystem`"):
        mj.rattle(PENDULUM.constraint)
    with pytest.raises(ValueError, match="`order` must be 2, 4 or 6"):
        mj.rattle(PENDULUM.system, order=3)
    with pytest.raises(ValueError, match="has constraints on velocities"):
        mj.rattle(mj.problems.rolling_disc().system)
    with pytest.raises(Exception, match="step size"):
        mj.diffeqsolve(
            PENDULUM.terms,
            mj.rattle(PENDULUM.system),
            0.0,
            1.0,
            0.1,
            PENDULUM.y0,
            PENDULUM.args,
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )
