"""Implicit solvers: stages at round-off, a derivative that is carried, lanes that do not interact."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optimized import optimized_jit

import manifold_jax as mj


MASS = mj.Constraint(lambda t, y, args: jnp.sum(y) - 1.0)
# Robertson's reaction at t = 1e11: Test Set for IVP Solvers (Mazzia & Magherini 2008), II-10.
ROBERTSON_END = [0.2083340149701255e-07, 0.8333360770334713e-13, 0.9999999791665050]


def robertson(t, y, args):
    y1, y2, y3 = y
    r1, r2, r3 = 0.04 * y1, 1e4 * y2 * y3, 3e7 * y2 * y2
    return jnp.stack([-r1 + r2, r1 - r2 - r3, r3])


def digits_and_steps(solver):
    solve = lambda y0: mj.diffeqsolve(
        dfx.ODETerm(robertson),
        solver,
        0.0,
        1e11,
        1e-4,
        y0,
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-14),
    )
    sol = optimized_jit(solve)(jnp.array([1.0, 0.0, 0.0]))
    error = np.max(np.abs(np.asarray(sol.ys[0]) / ROBERTSON_END - 1))
    return -np.log10(error), int(sol.stats["num_steps"]), float(jnp.sum(sol.ys[0]) - 1)


def test_robertson_is_as_good_as_without_a_hook():
    """A stiff field multiplies even corrections of the size of rounding, 2e-16 * 1e4."""
    digits, steps, _ = digits_and_steps(dfx.Kvaerno5())
    assert digits > 5.7
    for metric in (None, "error"):
        solver = mj.Projected(dfx.Kvaerno5(), MASS, projection=mj.NewtonProjection(metric=metric))
        projected, more, violation = digits_and_steps(solver)
        assert projected > digits - 0.1
        assert more <= 1.2 * steps
        assert abs(violation) < 3e-16


PENDULUM = mj.problems.pendulum()


def split(problem):
    """The field in two parts, of which an additive method takes the second implicitly."""
    f = problem.terms.vector_field
    part = lambda share: dfx.ODETerm(
        lambda t, y, args: jax.tree.map(lambda x: share * x, f(t, y, args))
    )
    return dfx.MultiTerm(part(0.3), part(0.7))


@pytest.mark.parametrize("hook", [mj.Projected, None], ids=["projected", "plain"])
def test_additive_methods_reject_no_step_for_rounding(hook):
    """14979 steps with `diffrax.VeryChord`, which takes noise of rounding for divergence."""
    solver = dfx.KenCarp3() if hook is None else hook(dfx.KenCarp3(), PENDULUM.constraint)
    solve = lambda y0: mj.diffeqsolve(
        split(PENDULUM),
        solver,
        0.0,
        2.0,
        0.01,
        y0,
        PENDULUM.args,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        max_steps=20000,
    )
    sol = optimized_jit(solve)(PENDULUM.y0)
    assert sol.stats["num_steps"] <= 200
    assert sol.stats["num_rejected_steps"] < 20


def quadric(A, d, q, y0):
    """A flow on an ellipsoid with random coefficients."""

    def field(t, y, args):
        f, G = A @ y + jnp.cos(t) * d, q * y
        return f - G * (G @ f) / (G @ G)

    constraint = mj.Constraint(lambda t, y, args: (y @ (q * y) - 1) / 2)
    terms = dfx.MultiTerm(
        dfx.ODETerm(lambda t, y, args: 0.5 * field(t, y, args)),
        dfx.ODETerm(lambda t, y, args: 0.5 * field(t, y, args)),
    )
    sol = mj.diffeqsolve(
        terms,
        mj.Projected(dfx.KenCarp3(), constraint),
        0.0,
        1.5,
        0.05,
        y0,
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
        throw=False,
    )
    return sol.ys[0], sol.stats["num_steps"]


def test_paths_do_not_depend_on_rounding():
    """23 steps against 17 alone and in a batch, and states 9e-5 apart, with `VeryChord`."""
    rng = np.random.default_rng(5)
    A, d = rng.normal(size=(8, 4, 4)), rng.normal(size=(8, 4))
    q, y0 = rng.uniform(0.5, 2.0, (8, 4)), rng.normal(size=(8, 4))
    y0 /= np.sqrt(np.sum(q * y0**2, axis=1))[:, None]
    cases = [jnp.asarray(x) for x in (A, d, q, y0)]
    single = optimized_jit(quadric)
    ends, steps = optimized_jit(jax.vmap(quadric))(*cases)
    for i in range(8):
        end, number = single(*[x[i] for x in cases])
        assert number == steps[i]
        np.testing.assert_allclose(ends[i], end, rtol=0, atol=1e-11)


def test_lanes_of_a_batch_are_independent():
    """Diffrax evaluates the derivative anew in all lanes where one of them needs it: behind a
    rejected first step and behind a jump of the field."""

    def solve(dt0, jump):
        field = lambda t, y, args: PENDULUM.terms.vector_field(
            t, y, args._replace(gravity=args.gravity * jnp.where(t < jump, 1.0, 1.1))
        )
        controller = dfx.PIDController(rtol=1e-5, atol=1e-5)
        sol = mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.Projected(dfx.Kvaerno3(), PENDULUM.constraint),
            0.0,
            0.7,
            dt0,
            PENDULUM.y0,
            PENDULUM.args,
            stepsize_controller=dfx.ClipStepSizeController(controller, jump_ts=jump[None]),
        )
        return sol.ys[0], sol.stats["num_rejected_steps"]

    solve = optimized_jit(jax.vmap(solve))
    quiet, rejected = solve(jnp.array([0.01, 0.01]), jnp.array([0.6, 0.6]))
    disturbed, more = solve(jnp.array([0.01, 0.7]), jnp.array([0.6, 0.2]))
    assert more[1] > rejected[1]
    np.testing.assert_array_equal(disturbed[0], quiet[0])
    assert np.abs(disturbed[1] - quiet[1]).max() > 1e-6


def test_small_components_count_where_the_tolerance_says_so():
    """In the plain norm each correction of the sum by its rounding moves the smallest component by a
    thousandth of itself."""
    digits, steps, _ = digits_and_steps(mj.Rodas5P())
    projected, more, violation = digits_and_steps(mj.Projected(mj.Rodas5P(), MASS))
    assert projected > digits - 0.1
    assert more <= 1.1 * steps
    assert abs(violation) < 3e-16
    plain = mj.NewtonProjection(metric="identity")
    assert digits_and_steps(mj.Projected(mj.Rodas5P(), MASS, projection=plain))[0] < 6.5


SPIN = lambda t, y, a: jnp.stack([1.2 * y[1] * y[2], -1.1 * y[0] * y[2], -0.1 * y[0] * y[1]])
SPUN = jnp.array([0.6, 0.48, 0.64])


@pytest.mark.parametrize("solver", [dfx.Kvaerno3(), dfx.ImplicitEuler()], ids=["3", "1"])
@pytest.mark.parametrize("hook", [False, True])
def test_constant_steps_need_no_tolerances(solver, hook):
    """Stages are solved to round-off in any case, and the order is that of the method."""
    sphere = mj.Constraint(lambda t, y, args: y @ y - 1)
    used = mj.Projected(solver, sphere) if hook else solver
    end = jax.jit(lambda h: mj.diffeqsolve(dfx.ODETerm(SPIN), used, 0.0, 2.0, h, SPUN).ys[0])
    tight = dfx.PIDController(rtol=1e-12, atol=1e-12)
    options = dict(stepsize_controller=tight, max_steps=10**5)
    exact = mj.diffeqsolve(dfx.ODETerm(SPIN), dfx.Dopri8(), 0.0, 2.0, None, SPUN, **options).ys[0]
    errors = [np.abs(end(2.0 / n) - exact).max() for n in (40, 80)]
    assert abs(np.log2(errors[0] / errors[1]) - solver.order(None)) < 0.2
