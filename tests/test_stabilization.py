"""Constraint stabilization: violations decay as the formulas say, in both directions of time."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import outside
import pytest
from variants import variants

import manifold_jax as mj


GAIN, SPAN = 3.0, 1.0
TIGHT = dfx.PIDController(rtol=1e-11, atol=1e-11)
DECAYING = {
    "invariant, projected": mj.InvariantStabilization(GAIN, projected=True),
    "exact": mj.ExactStabilization(GAIN),
}
PROBLEMS = ["rigid-body", "kepler", "pendulum", "outside"]


class Outside:
    """The time-dependent problem that is not in the gallery, with the names of one that is."""

    def __init__(self):
        self.terms, self.constraint, self.y0 = outside.terms(), outside.constraint(), outside.y0()
        self.t0, self.args = outside.T0, outside.parameters()


def build(name):
    return Outside() if name == "outside" else mj.problems.ALL[name]()


def residual(problem, t, y):
    leaves = jax.tree.leaves(problem.constraint(t, y, problem.args))
    return np.concatenate([np.ravel(leaf) for leaf in leaves])


def residual_and_jacobian(problem):
    """Of the state as a vector."""
    _, unravel = jax.flatten_util.ravel_pytree(problem.y0)

    def g(t, x):
        return jax.flatten_util.ravel_pytree(problem.constraint(t, unravel(x), problem.args))[0]

    return jax.jit(lambda t, x: (g(t, x), jax.jacobian(g, 1)(t, x)))


def start_off(problem, size):
    """A start off the manifold along its normals, where constraints and distance agree."""
    flat, unravel = jax.flatten_util.ravel_pytree(problem.y0)
    _, G = map(np.asarray, residual_and_jacobian(problem)(problem.t0, flat))
    normal = np.linalg.pinv(G) @ np.linspace(1, 2, G.shape[0])
    return unravel(flat + size * normal / np.linalg.norm(normal))


def distance(problem, t, y):
    """From the nearest point, found by Newton's method on its own equations in NumPy."""
    flat, _ = jax.flatten_util.ravel_pytree(y)
    linearized = residual_and_jacobian(problem)
    x0, p = np.asarray(flat), np.asarray(flat)
    for _ in range(30):
        r, G = map(np.asarray, linearized(t, p))
        # the point of the tangent plane at p nearest to x0
        p = x0 + np.linalg.pinv(G) @ (G @ (p - x0) - r)
    return np.linalg.norm(p - x0)


def ends(problem, stabilization, y0, spans=(SPAN, -SPAN)):
    """Final times and states, forwards and backwards in time, by one program."""
    solver = mj.Stabilized(dfx.Dopri5(), problem.constraint, stabilization=stabilization)

    @jax.jit
    def end(t1):
        sol = mj.diffeqsolve(
            problem.terms,
            solver,
            problem.t0,
            t1,
            None,
            y0,
            problem.args,
            stepsize_controller=TIGHT,
            max_steps=16384,
            consistent="assume",
        )
        return jax.tree.map(lambda leaf: leaf[0], sol.ys)

    return [(problem.t0 + span, end(problem.t0 + span)) for span in spans]


@pytest.mark.parametrize("name", PROBLEMS)
def test_projected_invariant_stabilization_decays_exponentially(name):
    """`g' = -gain g` where the field is tangent: |g(1)| / |g(0)| = exp(-3), either way in time."""
    problem = build(name)
    y0 = start_off(problem, 1e-3)
    before = residual(problem, problem.t0, y0)
    for t1, y1 in ends(problem, DECAYING["invariant, projected"], y0):
        np.testing.assert_allclose(
            residual(problem, t1, y1) / before, np.exp(-GAIN * SPAN), rtol=1e-5
        )


@pytest.mark.parametrize("name", ["rigid-body", "kepler", "sphere-flow"])
def test_exact_stabilization_decays_exponentially(name):
    """The distance from the manifold decays at the rate of the gain."""
    problem = mj.problems.ALL[name]()
    y0 = start_off(problem, 3e-4)
    ((t1, y1),) = ends(problem, DECAYING["exact"], y0, spans=(SPAN,))
    ratio = distance(problem, t1, y1) / distance(problem, problem.t0, y0)
    np.testing.assert_allclose(ratio, np.exp(-GAIN * SPAN), rtol=1e-5)


STABILIZATIONS = {
    "invariant": mj.InvariantStabilization(20.0),
    **DECAYING,
    "projected stages": mj.ExactStabilization(0),
}


@pytest.mark.parametrize("which", variants(STABILIZATIONS, lambda name: name != "exact"))
def test_violations_decay_in_the_direction_of_integration(which):
    """A time-dependent constraint; the plain solver stays off it."""
    problem = build("outside")
    y0 = start_off(problem, 1e-4)
    for t1, y1 in ends(problem, STABILIZATIONS[which], y0):
        violation = np.abs(residual(problem, t1, y1)).max()
        if which == "projected stages":
            assert violation <= 1e-14
        elif which == "exact":
            ratio = distance(problem, t1, y1) / distance(problem, problem.t0, y0)
            np.testing.assert_allclose(ratio, np.exp(-GAIN * SPAN), rtol=1e-4)
        else:
            assert violation <= 0.06 * np.abs(residual(problem, problem.t0, y0)).max()


def test_stages_projected_hands_out_values_on_the_manifold():
    problem = mj.problems.rigid_body()
    solver = mj.Stabilized(dfx.Tsit5(), problem.constraint, stabilization=mj.ExactStabilization(0))
    sol = mj.diffeqsolve(
        problem.terms,
        solver,
        problem.t0,
        problem.t1,
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(ts=jnp.linspace(problem.t0, problem.t1, 50), dense=True),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    assert mj.constraint_violation(problem.constraint, sol.ts, sol.ys, problem.args) <= 1e-15
    y = sol.evaluate(0.5 * problem.t1)
    assert mj.constraint_violation(problem.constraint, 0.5 * problem.t1, y, problem.args) <= 1e-15


def pendulum_system(stabilization):
    return mj.MechanicalSystem(
        1.0,
        lambda t, q, args: q @ q - 1.0,
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
        stabilization=stabilization,
    )


def test_baumgarte():
    """`phi'' + 2 alpha phi' + beta^2 phi = 0` in the direction of integration: with the start
    phi = d, phi' = 0 and alpha = beta, phi(t) = d (1 + alpha t) exp(-alpha t)."""
    alpha, d = 4.0, 1e-3
    system = pendulum_system(mj.Baumgarte(alpha, alpha))
    y0 = jnp.array([np.sqrt(1 + d), 0.0]), jnp.zeros(2)

    @jax.jit
    def end(t1):
        return dfx.diffeqsolve(
            system.terms, dfx.Dopri8(), 0.0, t1, 0.01 * t1, y0, stepsize_controller=TIGHT
        ).ys

    for t1 in (1.0, -1.0):
        q, v = (np.asarray(leaf[0]) for leaf in end(t1))
        np.testing.assert_allclose(q @ q - 1, d * (1 + alpha) * np.exp(-alpha), rtol=1e-7)
        np.testing.assert_allclose(2 * q @ v, -t1 * d * alpha**2 * np.exp(-alpha), rtol=1e-7)
    # multipliers and accelerations are the physical ones, without stabilization
    np.testing.assert_array_equal(
        system.accelerations(0.0, y0), pendulum_system(None).accelerations(0.0, y0)
    )


def test_velocity_stabilization_keeps_positions_whatever_the_velocities():
    system = pendulum_system(mj.VelocityStabilization())
    y0 = jnp.array([0.6, 0.8]), jnp.array([0.3, 0.1])  # not tangent
    (dq, _) = system.terms.vf(0.0, y0, None)
    assert abs(y0[0] @ dq) <= 1e-16
    tangent = jnp.array([0.8, -0.6])
    np.testing.assert_allclose(dq, (y0[1] @ tangent) * tangent, atol=1e-16)


@pytest.mark.parametrize(
    ("solver", "interval"),
    [(dfx.Euler(), 2.0), (dfx.Heun(), 2.0), (dfx.Bosh3(), 2.5127), (dfx.Dopri5(), 3.3066)],
)
def test_gains_beyond_the_stability_interval(solver, interval):
    """Constant steps: refused, or with `throw=False` a failure code; just within: fine."""
    problem = mj.problems.rigid_body()

    def run(gain, **options):
        stabilization = mj.InvariantStabilization(jnp.asarray(gain))
        hook = mj.Stabilized(solver, problem.constraint, stabilization=stabilization)
        return mj.diffeqsolve(
            problem.terms, hook, 0.0, 1.0, 0.1, problem.y0, problem.args, **options
        )

    assert run(0.99 * interval / 0.1).result == dfx.RESULTS.successful
    with pytest.raises(RuntimeError, match="stability interval"):
        run(1.01 * interval / 0.1)
    failed = run(1.01 * interval / 0.1, throw=False)
    assert failed.result == dfx.RESULTS.nonlinear_divergence


def test_adaptive_steps_stay_within_the_stability_interval():
    problem = mj.problems.rigid_body()
    hook = mj.Stabilized(
        dfx.Dopri5(), problem.constraint, stabilization=mj.InvariantStabilization(100.0)
    )
    sol = mj.diffeqsolve(
        problem.terms,
        hook,
        0.0,
        5.0,
        None,
        problem.y0,
        problem.args,
        stepsize_controller=dfx.PIDController(rtol=1e-2, atol=1e-2),
        saveat=dfx.SaveAt(steps=True),
    )
    steps = np.diff(np.asarray(sol.ts)[np.isfinite(sol.ts)], prepend=0.0)
    assert steps.max() <= 3.31 / 100


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_stabilization():
    constraint = mj.Constraint(lambda t, y, args: y @ y - 1.0)
    for make in (
        lambda: mj.InvariantStabilization(-1.0),
        lambda: mj.ExactStabilization(-1.0),
        lambda: mj.Baumgarte(-1.0, 1.0),
        lambda: mj.Baumgarte(1.0, float("nan")),
    ):
        with pytest.raises(ValueError, match="must not be negative"):
            make()
    with pytest.raises(TypeError, match="mj.MechanicalSystem"):
        mj.Stabilized(dfx.Tsit5(), constraint, stabilization=mj.Baumgarte(1.0, 1.0))
    stabilized = mj.Stabilized(
        dfx.KenCarp3(), constraint, stabilization=mj.InvariantStabilization(1.0)
    )
    terms = dfx.MultiTerm(dfx.ODETerm(lambda t, y, args: -y), dfx.ODETerm(lambda t, y, args: y))
    with pytest.raises(ValueError, match="`terms` is a `MultiTerm`"):
        mj.diffeqsolve(
            terms, stabilized, 0.0, 1.0, 0.1, jnp.array([1.0, 0.0]), stepsize_controller=TIGHT
        )
    noise = dfx.ControlTerm(lambda t, y, args: y, dfx.UnsafeBrownianPath((), jax.random.key(0)))
    sde = dfx.MultiTerm(dfx.ODETerm(lambda t, y, args: -y), noise)
    stabilized = mj.Stabilized(dfx.Heun(), constraint, stabilization=mj.InvariantStabilization(1.0))
    with pytest.raises(ValueError, match="`terms` has noise"):
        mj.diffeqsolve(sde, stabilized, 0.0, 1.0, 0.1, jnp.array([1.0, 0.0]))
    system = pendulum_system(mj.Baumgarte(50.0, 50.0))
    with pytest.raises(RuntimeError, match="stability interval"):
        mj.diffeqsolve(
            system.terms, dfx.Tsit5(), 0.0, 1.0, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2))
        )


def test_numbers_of_python_as_a_state():
    """With constant steps the check of the gain had no array to go with."""
    constraint = mj.Constraint(lambda t, y, args: y[0] ** 2 + y[1] ** 2 - 1.0)
    terms = dfx.ODETerm(lambda t, y, args: (-y[1], y[0]))
    hook = mj.Stabilized(dfx.Tsit5(), constraint, stabilization=mj.InvariantStabilization(1.0))
    sol = mj.diffeqsolve(terms, hook, 0.0, 1.0, 0.1, (1.0, 0.0))
    np.testing.assert_allclose(np.ravel(sol.ys), [np.cos(1.0), np.sin(1.0)], atol=1e-6)
    system = mj.MechanicalSystem(
        1.0,
        lambda t, q, args: q[0] ** 2 + q[1] ** 2 - 1.0,
        lambda t, q, v, args: (0.0, 0.0),
        stabilization=mj.Baumgarte(1.0, 1.0),
    )
    y0 = (1.0, 0.0), (0.0, 1.0)
    sol = mj.diffeqsolve(system.terms, dfx.Tsit5(), 0.0, 1.0, 0.1, y0)
    np.testing.assert_allclose(np.ravel(sol.ys[0]), [np.cos(1.0), np.sin(1.0)], atol=1e-6)
