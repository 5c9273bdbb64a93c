"""Every Runge-Kutta type solver of Diffrax is kept on the manifold; the others are refused."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from variants import variants

import manifold_jax as mj


SPHERE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
START = jnp.array([0.6, 0.0, 0.8])
INERTIA = jnp.array([2.0, 1.0, 2.0 / 3.0])
VERY_CHORD = dict(root_finder=dfx.VeryChord(rtol=1e-9, atol=1e-9, norm=optx.max_norm))
EXPLICIT = [
    dfx.Euler(),
    dfx.Heun(),
    dfx.Midpoint(),
    dfx.Ralston(),
    dfx.Bosh3(),
    dfx.Dopri5(),
    dfx.Tsit5(),
    dfx.Dopri8(),
    dfx.HalfSolver(dfx.Heun()),
    dfx.HalfSolver(dfx.Euler()),
]
IMPLICIT = [
    dfx.ImplicitEuler(**VERY_CHORD),
    dfx.Kvaerno3(**VERY_CHORD),
    dfx.Kvaerno4(**VERY_CHORD),
    dfx.Kvaerno5(**VERY_CHORD),
]
IMEX = [dfx.KenCarp3(), dfx.KenCarp4(), dfx.KenCarp5(), dfx.Sil3()]
STRATONOVICH = [
    dfx.Heun(),
    dfx.Midpoint(),
    dfx.Ralston(),
    dfx.EulerHeun(),
    dfx.StratonovichMilstein(),
    dfx.GeneralShARK(),
    dfx.SlowRK(),
    dfx.SPaRK(),
    dfx.HalfSolver(dfx.Heun()),
]
name = lambda solver: type(solver).__name__
ONE_OF_A_KIND = (
    "Tsit5 Dopri8 ImplicitEuler Kvaerno3 KenCarp3 Heun EulerHeun StratonovichMilstein SlowRK"
)
one_of_a_kind = lambda solver: name(solver) in ONE_OF_A_KIND.split()


def field(t, y, args):
    return jnp.cross(y, y / INERTIA)


def off_sphere(ys):
    return np.abs(np.sum(np.square(ys), axis=-1) - 1).max()


def reference(t):
    """An independent solution: SciPy at 1e-12."""
    from scipy.integrate import solve_ivp

    f = lambda t, y: np.cross(y, y / np.asarray(INERTIA))
    return solve_ivp(f, (0, t), np.asarray(START), rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]


@pytest.mark.parametrize("solver", variants(EXPLICIT + IMPLICIT, one_of_a_kind), ids=name)
def test_constant_steps(solver):
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        mj.Projected(solver, SPHERE),
        0.0,
        1.0,
        0.02,
        START,
        saveat=dfx.SaveAt(
            subs=[dfx.SubSaveAt(ts=jnp.linspace(0.0, 1.0, 23)), dfx.SubSaveAt(steps=True)],
            dense=True,
        ),
    )
    assert off_sphere(sol.ys[0]) <= 1e-15
    assert off_sphere(sol.ys[1][:50]) <= 1e-15
    assert off_sphere(sol.evaluate(0.4567)) <= 1e-15
    np.testing.assert_allclose(sol.ys[0][-1], reference(1.0), atol=1e-2)


@pytest.mark.parametrize(
    "solver", [dfx.Tsit5(), dfx.HalfSolver(dfx.Heun()), *IMPLICIT[1:]], ids=name
)
def test_adaptive_steps(solver):
    if isinstance(solver, dfx.Kvaerno3 | dfx.Kvaerno4 | dfx.Kvaerno5):
        solver = type(solver)()  # tolerances of the stages from the controller
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        mj.Projected(solver, SPHERE),
        0.0,
        1.0,
        None,
        START,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    assert off_sphere(sol.ys) <= 1e-15
    np.testing.assert_allclose(sol.ys[-1], reference(1.0), atol=2e-5)


@pytest.mark.parametrize("solver", variants(IMEX, one_of_a_kind), ids=name)
def test_implicit_explicit(solver):
    half = dfx.ODETerm(lambda t, y, args: 0.5 * field(t, y, args))
    sol = mj.diffeqsolve(
        dfx.MultiTerm(half, half),
        mj.Projected(solver, SPHERE),
        0.0,
        1.0,
        0.01,
        START,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)),
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
    )
    assert off_sphere(sol.ys) <= 1e-15
    np.testing.assert_allclose(sol.ys[-1], reference(1.0), atol=2e-4)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Heun(), dfx.Kvaerno3(**VERY_CHORD)], ids=name)
def test_forward_mode_through_the_wrapper(solver):
    def end(y0, adjoint):
        return mj.diffeqsolve(
            dfx.ODETerm(field), mj.Projected(solver, SPHERE), 0.0, 0.2, 0.05, y0, adjoint=adjoint
        ).ys[0]

    forward = jax.jit(jax.jacfwd(lambda y: end(y, dfx.ForwardMode())))(START)
    reverse = jax.jit(jax.jacrev(lambda y: end(y, dfx.RecursiveCheckpointAdjoint())))(START)
    np.testing.assert_allclose(forward, reverse, atol=1e-13)


def tangent_noise(key, span=(0.0, 1.0)):
    """Brownian motion on the sphere, in Stratonovich form: dy = (I - y y') o dW."""
    path = dfx.VirtualBrownianTree(
        *span, tol=1e-3, shape=(3,), key=key, levy_area=dfx.SpaceTimeLevyArea
    )
    drift = dfx.ODETerm(lambda t, y, args: jnp.zeros_like(y))
    diffusion = dfx.ControlTerm(lambda t, y, args: jnp.eye(3) - jnp.outer(y, y), path)
    return dfx.MultiTerm(drift, diffusion)


@pytest.mark.parametrize("solver", variants(STRATONOVICH, one_of_a_kind), ids=name)
def test_stratonovich(solver):
    sol = mj.diffeqsolve(
        tangent_noise(jax.random.key(0)),
        mj.Projected(solver, SPHERE),
        0.0,
        1.0,
        0.02,
        START,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 11)),
    )
    assert off_sphere(sol.ys) <= 2e-15


@pytest.mark.slow
def test_brownian_motion_on_the_sphere_has_the_right_law():
    """E[y(t)] = exp(-t) y(0) on S^2: half the Laplacian has eigenvalue -1."""

    @jax.jit
    @jax.vmap
    def end(key):
        return mj.diffeqsolve(
            tangent_noise(key), mj.Projected(dfx.Heun(), SPHERE), 0.0, 1.0, 0.02, START
        ).ys[0]

    ys = np.asarray(end(jax.random.split(jax.random.key(1), 4000)))
    along = ys @ np.asarray(START)
    assert abs(along.mean() - np.exp(-1)) <= 4 * along.std() / np.sqrt(len(along))


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        (dfx.ItoMilstein(), "StratonovichMilstein"),
        (dfx.ReversibleHeun(), "Tsit5"),
        (dfx.LeapfrogMidpoint(), "Tsit5"),
        (dfx.SemiImplicitEuler(), "Tsit5"),
        (dfx.ALIGN(0.1), "Tsit5"),
        (dfx.HalfSolver(dfx.Kvaerno3()), r"Projected\(Kvaerno3\(\), constraint\)"),
        (dfx.HalfSolver(mj.Projected(dfx.Heun(), SPHERE)), "outermost"),
        (mj.Projected(dfx.Tsit5(), SPHERE), "one constraint"),
    ],
    ids=lambda x: name(x) if isinstance(x, dfx.AbstractSolver) else "",
)
def test_refused(solver, message):
    with pytest.raises(ValueError, match=message):
        mj.Projected(solver, SPHERE)


def test_ito_solver_of_a_stochastic_equation_is_refused():
    solver = mj.Projected(dfx.Euler(), SPHERE)
    with pytest.raises(ValueError, match="EulerHeun"):
        mj.diffeqsolve(tangent_noise(jax.random.key(0)), solver, 0.0, 1.0, 0.02, START)


def test_not_a_solver(as_a_user_meets_it):
    with pytest.raises(TypeError, match=r"Projected\(Tsit5\(\)"):
        mj.Projected(dfx.Tsit5, SPHERE)
    with pytest.raises(TypeError, match="Diffrax solver"):
        mj.Projected("Tsit5", SPHERE)
    with pytest.raises(TypeError, match="mj.Constraint"):
        mj.Projected(dfx.Tsit5(), lambda t, y, args: y @ y - 1)


def test_backsolve_is_refused():
    with pytest.raises(ValueError, match="StepReplayAdjoint"):
        mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.Projected(dfx.Tsit5(), SPHERE),
            0.0,
            1.0,
            0.1,
            START,
            adjoint=dfx.BacksolveAdjoint(),
        )


def test_other_solvers_pass_through():
    times = map(jnp.asarray, (0.0, 1.0, 0.1))  # constants are rounded in another way
    args = (dfx.ODETerm(field), dfx.Tsit5(), *times, START)
    assert np.array_equal(mj.diffeqsolve(*args).ys, dfx.diffeqsolve(*args).ys)
