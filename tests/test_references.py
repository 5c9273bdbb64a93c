"""Published and exact solutions, met by projected solves through `MechanicalSystem`."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax.problems.lotka_volterra import COST_BY_RATES, COST_BY_START
from manifold_jax.problems.pendulum import A01_X, A01_Y


def solve(problem, tolerance, ts=None, solver=None, hook=mj.Projected, **options):
    solver = dfx.Dopri8() if solver is None else solver
    return mj.diffeqsolve(
        problem.terms,
        hook(solver, problem.constraint),
        problem.t0,
        problem.t1 if ts is None else ts[-1],
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts)),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        **{"max_steps": 65536, **options},
    )


def largest_error(problem, sol):
    reference = problem.reference(np.asarray(sol.ts))
    errors = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), sol.ys, reference)
    return max(jax.tree.leaves(errors))


def test_iftomm_a01_to_its_six_digits():
    problem = mj.problems.pendulum(q0=(-1.0, 0.0))
    sol = solve(problem, 1e-10, np.linspace(0, 10, 21))
    for values, printed in zip(np.asarray(sol.ys[0]).T, (A01_X, A01_Y)):
        # six significant digits
        unit = 10.0 ** (np.floor(np.log10(np.maximum(np.abs(printed), 1e-3))) - 5)
        assert np.all(np.abs(values - printed) <= 0.51 * unit)


def test_pendulum_to_1e_9():
    problem = mj.problems.pendulum()
    assert largest_error(problem, solve(problem, 1e-12, np.linspace(0, 10, 101))) <= 1e-9


# Test Set for IVP Solvers, at t = 3; the multipliers with the sign of M a + J^T lambda = Q.
CAR_AXIS = {
    "q": [0.0493455784275402809, 0.496989460230171154, 1.04174252488542152, 0.373911027265361257],
    "v": [-0.0770583684040972358, 0.00744686658723778553, 0.0175568157537232222, 0.770341043779251976],
    "multipliers": [0.00473688659084893325, 0.00110468033125734369],
}  # fmt: skip


@pytest.mark.slow
def test_car_axis_with_multipliers():
    problem = mj.problems.car_axis()
    sol = solve(problem, 1e-13)
    q, v = (np.asarray(leaf[0]) for leaf in sol.ys)
    np.testing.assert_allclose(q, CAR_AXIS["q"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(v, CAR_AXIS["v"], rtol=0, atol=1e-11)
    multipliers = problem.system.multipliers(3.0, (sol.ys[0][0], sol.ys[1][0]), problem.args)
    np.testing.assert_allclose(multipliers, CAR_AXIS["multipliers"], rtol=1e-10)


# SUNDIALS' slider-crank at t = 10, 9 digits from two formulations.
SLIDER_CRANK = {
    "q": [1.2756758486, 1.0235785590, -0.4988130492],
    "v": [-0.2399149972, 0.1337782832, 0.0397314960],
}


@pytest.mark.slow
def test_slider_crank():
    problem = mj.problems.slider_crank()
    sol = solve(problem, 1e-12)
    for name, leaf in zip(("q", "v"), sol.ys):
        np.testing.assert_allclose(leaf[0], SLIDER_CRANK[name], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "links", [2, *(pytest.param(links, marks=pytest.mark.slow) for links in (3, 5))]
)
def test_chain(links):
    problem = mj.problems.chain(links)
    assert largest_error(problem, solve(problem, 1e-12)) <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "rigid-body"])
def test_long_run(name):
    """Constraints at round-off for ever; the energy error is reported next to the plain one's."""
    if name == "pendulum":
        problem, end, tolerance = mj.problems.pendulum(t1=2000.0), 2000.0, 1e-8
        energy = lambda y: 0.5 * np.sum(y[1] ** 2, -1) + 9.81 * y[0][..., 1]
        scale = 9.81
    else:
        # Only the sphere, so that the energy is free to drift.
        rigid, end, tolerance = mj.problems.rigid_body(t1=1e4), 1e4, 1e-8
        problem = rigid
        moments = np.asarray(jax.tree.leaves(rigid.args)[0])
        energy = lambda y: 0.5 * np.sum(y**2 / moments, -1)
        scale = 1.0
    ts = np.linspace(0, end, 201)
    constraint = problem.constraint
    if name == "rigid-body":
        constraint = mj.Constraint(lambda t, y, args: y @ y - problem.y0 @ problem.y0)
    errors = {}
    for label, hook in (
        ("plain", lambda s, c: s),
        ("projected", lambda s, c: mj.Projected(s, constraint)),
    ):
        options = {} if label == "projected" else {"dt0": 0.01}
        sol = mj.diffeqsolve(
            problem.terms,
            hook(dfx.Dopri8(), constraint),
            0.0,
            end,
            options.get("dt0"),
            problem.y0,
            problem.args,
            saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=2**20,
        )
        values = energy(jax.tree.map(np.asarray, sol.ys))
        leaves = jax.tree.leaves(
            jax.vmap(lambda t, y: constraint(t, y, problem.args))(sol.ts, sol.ys)
        )
        violation = max(np.abs(np.asarray(leaf)).max() for leaf in leaves)
        errors[label] = np.abs(values - values[0]).max() / scale
        print(f"{name} {label}: violation {violation:.1e}, energy error {errors[label]:.1e}")
        if label == "projected":
            assert violation <= 5e-15
    assert errors["projected"] <= errors["plain"]


def test_lotka_volterra_cost_gradient_to_eleven_digits():
    """With respect to start and rates, both also in the invariant."""

    def cost(start, rates):
        problem = mj.problems.lotka_volterra().with_args(rates).with_initial(start)
        return jnp.sum((1 - solve(problem, 1e-13).ys[0]) ** 2) / 2

    problem = mj.problems.lotka_volterra()
    slopes = jax.jit(jax.grad(cost, (0, 1)))(problem.y0, problem.args)
    np.testing.assert_allclose(slopes[0], COST_BY_START, rtol=1e-11)
    np.testing.assert_allclose(slopes[1], COST_BY_RATES, rtol=1e-11)
