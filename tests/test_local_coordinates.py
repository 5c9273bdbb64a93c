"""Local coordinates: the same numbers as with an explicit basis, and every stage on the manifold."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import outside
import pytest
import scipy.linalg
import scipy.optimize
from optimized import optimized_jit

import manifold_jax as mj


CHARTS = {"tangent": mj.TangentSpaceChart(), "partition": mj.CoordinatePartitionChart()}
AXES = np.array([1.0, 0.7, 1.4])
ROTATION = np.array([0.3, -0.5, 0.8])


def ellipsoid(t, y, args):
    return jnp.sum((y / AXES) ** 2) - 1.0


def field(t, y, args):
    return AXES * jnp.cross(ROTATION, y / AXES)


def unit_start():
    u = np.array([0.48, 0.6, 0.64])
    return AXES * u


def step_with_basis(y0, h, basis, normal):
    """One step of Dopri5 in coordinates `u` with `x = y0 + U u + V z`, in NumPy."""
    tableau = dfx.Dopri5().tableau
    f = lambda x: np.asarray(field(0.0, jnp.asarray(x), None))
    g = lambda x: np.sum((x / AXES) ** 2) - 1
    dual = np.linalg.inv(np.column_stack([basis, normal]))[:2]  # C^T: C^T U = I, C^T V = 0

    def lift(u):
        base = y0 + basis @ u
        z = 0.0
        for _ in range(30):
            x = base + normal * z
            z -= g(x) / (2 * (x / AXES**2) @ normal)
        return base + normal * z

    slopes = [dual @ f(y0)]
    for row in tableau.a_lower:
        u = h * sum(float(a) * k for a, k in zip(row, slopes))
        slopes.append(dual @ f(lift(u)))
    u1 = h * sum(float(b) * k for b, k in zip(tableau.b_sol, slopes))
    error_u = h * sum(float(e) * k for e, k in zip(tableau.b_error, slopes))
    x1 = lift(u1)
    G = 2 * x1 / AXES**2
    push = basis - np.outer(normal, G @ basis) / (G @ normal)  # dx/du
    return x1, push @ error_u


def step_of_library(y0, h, chart):
    solver = mj.LocalCoordinates(dfx.Dopri5(), mj.Constraint(ellipsoid), chart=chart)
    terms = dfx.ODETerm(field)
    y0 = jnp.asarray(y0)
    state = solver.init(terms, 0.0, h, y0, None)
    y1, error, *_ = solver.step(terms, 0.0, h, y0, None, state, False)
    return np.asarray(y1), np.asarray(error)


@pytest.mark.parametrize("rotated", [0.0, 0.9])
def test_one_step_equals_the_form_with_a_basis(rotated):
    """Independent of the basis; an error `e` of the coordinates is one of `Phi'(u) e` of the
    state, for a chart `Phi`."""
    y0 = unit_start()
    G = 2 * y0 / AXES**2
    U = scipy.linalg.null_space(G[None, :])
    Q = np.array([[np.cos(rotated), -np.sin(rotated)], [np.sin(rotated), np.cos(rotated)]])
    expected, error = step_with_basis(y0, 0.4, U @ Q, G)
    y1, estimate = step_of_library(y0, 0.4, mj.TangentSpaceChart())
    np.testing.assert_allclose(y1, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(estimate, error, rtol=0, atol=1e-13)


def test_one_step_equals_coordinate_partitioning():
    y0 = unit_start()
    G = 2 * y0 / AXES**2
    dependent = int(np.argmax(np.abs(G)))
    unit = np.eye(3)
    independent = [i for i in range(3) if i != dependent]
    expected, error = step_with_basis(y0, 0.3, unit[:, independent], unit[:, dependent])
    y1, estimate = step_of_library(y0, 0.3, mj.CoordinatePartitionChart())
    np.testing.assert_allclose(y1, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(estimate, error, rtol=0, atol=1e-13)


def test_error_tolerances_in_coordinates():
    """In d coordinates, |du_j| <= min_i tol_i / (d |U_ij|) keeps |dx_i| <= tol_i."""
    rng = np.random.default_rng(0)
    y0 = unit_start()
    U = scipy.linalg.null_space((2 * y0 / AXES**2)[None, :])
    tolerance = 1e-3 * (1 + np.abs(y0))
    allowed = np.min(tolerance[:, None] / (2 * np.abs(U)), axis=0)
    du = rng.uniform(-1, 1, size=(1000, 2)) * allowed
    assert np.max(np.abs(du @ U.T) / tolerance) <= 1


@pytest.mark.parametrize("chart", CHARTS)
def test_every_stage_is_on_the_manifold(chart):
    """A vector field that is NaN off the manifold."""

    def only_there(t, y, args):
        on = jnp.abs(ellipsoid(t, y, args)) < 1e-13
        return jnp.where(on, field(t, y, args), jnp.nan)

    def run(solver):
        return mj.diffeqsolve(
            dfx.ODETerm(only_there),
            solver,
            0.0,
            3.0,
            0.05,
            jnp.asarray(unit_start()),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
            throw=False,
        )

    constraint = mj.Constraint(ellipsoid)
    inside = run(mj.LocalCoordinates(dfx.Tsit5(), constraint, chart=CHARTS[chart]))
    assert inside.result == dfx.RESULTS.successful
    generator = np.cross(ROTATION, np.eye(3)).T
    exact = AXES * (scipy.linalg.expm(3.0 * generator) @ (unit_start() / AXES))
    np.testing.assert_allclose(inside.ys[0], exact, atol=1e-5)
    assert run(mj.Projected(dfx.Tsit5(), constraint)).result != dfx.RESULTS.successful


@pytest.mark.parametrize(
    ("solver", "chart", "accuracy"),
    [
        pytest.param(dfx.Tsit5(), "tangent", 1e-6, id="tsit5-tangent"),
        pytest.param(dfx.Tsit5(), "partition", 1e-6, id="tsit5-partition", marks=pytest.mark.slow),
        # Plain Kvaerno5 with accurate stages (`optimistix.Newton`): 50 steps and 1.7e-6.
        pytest.param(
            dfx.Kvaerno5(), "tangent", 4e-6, id="kvaerno5-tangent", marks=pytest.mark.slow
        ),
        pytest.param(
            dfx.Kvaerno5(), "partition", 4e-6, id="kvaerno5-partition", marks=pytest.mark.slow
        ),
    ],
)
def test_time_dependent_pytree_problem(solver, chart, accuracy):
    """Forward and backward, dense output, with an explicit and an implicit solver."""
    hook = mj.LocalCoordinates(solver, outside.constraint(), chart=CHARTS[chart])
    options = dict(
        args=outside.parameters(),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
        max_steps=16384,
    )
    ts = jnp.linspace(outside.T0, outside.T1, 100)
    saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(steps=True)], dense=True)
    sol = mj.diffeqsolve(
        outside.terms(), hook, outside.T0, outside.T1, None, outside.y0(), saveat=saveat, **options
    )
    check(sol.ts[0], sol.ys[0], accuracy)
    used = np.isfinite(np.asarray(sol.ts[1]))
    check(sol.ts[1][used], jax.tree.map(lambda leaf: leaf[used], sol.ys[1]), accuracy)
    times = np.random.default_rng(0).uniform(outside.T0, outside.T1, size=200)
    check(times, jax.vmap(sol.evaluate)(jnp.asarray(times)), accuracy)
    end = jax.tree.map(lambda leaf: leaf[-1], sol.ys[0])
    saveat = dfx.SaveAt(ts=ts[::-1])
    back = mj.diffeqsolve(
        outside.terms(), hook, outside.T1, outside.T0, None, end, saveat=saveat, **options
    )
    check(back.ts, back.ys, 2 * accuracy)


def check(t, y, accuracy):
    assert np.abs(outside.residual_numpy(t, y)).max() <= 1e-14
    for a, b in zip(jax.tree.leaves(y), jax.tree.leaves(outside.exact(t))):
        np.testing.assert_allclose(a, b, atol=accuracy)


def swinging(gravity, chart, adjoint):
    problem = mj.problems.pendulum()
    problem = problem.with_args(problem.args._replace(gravity=gravity))
    sol = mj.diffeqsolve(
        problem.terms,
        mj.LocalCoordinates(dfx.Dopri5(), problem.constraint, chart=CHARTS[chart]),
        0.0,
        1.0,
        0.02,
        problem.y0,
        problem.args,
        adjoint=adjoint,
        max_steps=64,
    )
    return sol.ys[0][0, 0] + 0.3 * sol.ys[1][0, 1]


@pytest.mark.parametrize("chart", ["tangent", pytest.param("partition", marks=pytest.mark.slow)])
def test_gradients(chart):
    """Reverse = forward = central differences, at constant steps."""
    end = lambda g: swinging(g, chart, dfx.RecursiveCheckpointAdjoint())
    run = jax.jit(jax.value_and_grad(end))
    reverse = run(9.81)[1]
    forward = jax.jit(jax.jacfwd(lambda g: swinging(g, chart, dfx.ForwardMode())))(9.81)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    differences = (run(9.81 + 1e-5)[0] - run(9.81 - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(reverse, differences, rtol=1e-7)


@pytest.mark.parametrize("adjoint", [mj.StepReplayAdjoint(), dfx.RecursiveCheckpointAdjoint()])
def test_stage_failure_rejects_the_step_and_leaves_the_gradient_finite(adjoint):
    """The first step is far too long for the chart: there is no point of the sphere above it. The
    field is not defined off the manifold."""

    def turning(t, y, args):
        return jnp.stack([-args * y[1], args * y[0]]) + 0 * jnp.sqrt(1.2 - y @ y)

    def run(speed):
        sol = mj.diffeqsolve(
            dfx.ODETerm(turning),
            mj.LocalCoordinates(dfx.Tsit5(), mj.Constraint(lambda t, y, args: y @ y - 1.0)),
            0.0,
            4.0,
            4.0,
            jnp.array([1.0, 0.0]),
            speed,
            stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
            adjoint=adjoint,
        )
        return sol.ys[0, 0], sol.stats["num_rejected_steps"]

    (x, rejected), slope = jax.jit(jax.value_and_grad(run, has_aux=True))(1.0)
    assert rejected >= 1
    np.testing.assert_allclose(x, np.cos(4.0), atol=1e-6)
    np.testing.assert_allclose(slope, -4.0 * np.sin(4.0), atol=1e-5)


def test_vmapped_equals_single():
    gravities = jnp.array([5.0, 9.81, 20.0])
    run = lambda g: swinging(g, "tangent", dfx.RecursiveCheckpointAdjoint())
    batch = jax.jit(jax.vmap(run))(gravities)
    np.testing.assert_allclose(batch, [jax.jit(run)(g) for g in gravities], rtol=1e-12)


def test_statistics_and_plain_diffrax():
    problem = mj.problems.rigid_body()
    sol = dfx.diffeqsolve(
        problem.terms,
        mj.LocalCoordinates(dfx.Dopri5(), problem.constraint),
        0.0,
        5.0,
        0.1,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    used = np.isfinite(np.asarray(sol.ts))
    violation = mj.constraint_violation(
        problem.constraint, sol.ts[used], sol.ys[used], problem.args
    )
    assert violation <= 1e-15


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_charts_need_independent_equations():
    both = lambda t, q, args: jnp.stack([q @ q - 1.0, 2.0 * (q @ q) - 2.0])
    force = lambda t, q, v, args: jnp.zeros(2)
    announced = mj.MechanicalSystem(1.0, both, force, redundant=True)
    with pytest.raises(ValueError, match="`constraint` is redundant"):
        mj.LocalCoordinates(dfx.Tsit5(), announced.constraint)
    with pytest.raises(TypeError, match="`chart` must be"):
        mj.LocalCoordinates(dfx.Tsit5(), mj.Constraint(ellipsoid), chart="tangent")
    hidden = mj.Constraint(lambda t, y, args: jnp.stack([ellipsoid(t, y, args)] * 2))
    with pytest.raises(RuntimeError, match="full rank"):
        mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.LocalCoordinates(dfx.Tsit5(), hidden),
            0.0,
            1.0,
            0.1,
            jnp.asarray(unit_start()),
        )


@pytest.mark.slow
@pytest.mark.parametrize("chart", ["tangent", "partition", None])
def test_stages_do_not_amplify_rounding(chart):
    """With given steps rounding stays rounding, in charts as without (`None`).

    With adaptive steps it does not: after a step whose error estimate is near rounding the next
    step size depends on it, so that ends differ by a part of the tolerance, also in plain Diffrax.
    """
    rng = np.random.default_rng(5)
    A, d = jnp.asarray(rng.normal(size=(50, 4, 4))), jnp.asarray(rng.normal(size=(50, 4)))
    q, y0 = jnp.asarray(rng.uniform(0.5, 2.0, (50, 4))), rng.normal(size=(50, 4))
    y0 = jnp.asarray(y0 / np.sqrt(np.sum(q * y0**2, axis=1))[:, None])

    def end(A, d, q, y0):
        def field(t, y, args):
            f, G = A @ y + jnp.cos(t) * d, q * y
            return f - G * (G @ f) / (G @ G)

        constraint = mj.Constraint(lambda t, y, args: (y @ (q * y) - 1) / 2)
        solver = dfx.Dopri8()
        if chart is not None:
            solver = mj.LocalCoordinates(solver, constraint, chart=CHARTS[chart])
        sol = mj.diffeqsolve(
            dfx.ODETerm(field),
            solver,
            0.0,
            1.5,
            None,
            y0,
            stepsize_controller=dfx.StepTo(jnp.linspace(0.0, 1.5, 25)),
            throw=False,
        )
        return sol.ys[0]

    end = optimized_jit(jax.vmap(end))
    change = 1e-15 * jnp.array([[1.0, -1.0, 2.0, 1.0]])
    ends, moved = end(A, d, q, y0), end(A, d, q, y0 * (1 + change))
    assert jnp.all(jnp.isfinite(ends))
    np.testing.assert_allclose(moved, ends, rtol=0, atol=1e-12)
