"""Solvers of the user's own: their steps are made as they are written, whatever their tableau."""

import copy
import pickle
from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
TURN = dfx.ODETerm(lambda t, y, args: args * jnp.stack([-y[1], y[0]]))
START = jnp.array([0.6, 0.8])


def to_circle(y):
    return y / np.sqrt(y @ y)


class Damped(dfx.Heun):
    """A step that is not the tableau's: a part of the second component is lost."""

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, *rest = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1 * jnp.array([1.0, 0.95]), *rest


class Remembering(dfx.Heun):
    """A field of its own for the first step, by `init` and `func`."""

    def func(self, terms, t0, y0, args):
        return jax.tree.map(lambda f: 1.5 * f, terms.vf(t0, y0, args))

    def init(self, terms, t0, t1, y0, args):
        return self.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        _, error, info, _, result = super().step(terms, t0, t1, y0, args, None, made_jump)
        y1 = y0 + (t1 - t0) * solver_state
        return y1, error, info, terms.vf(t1, y1, args), result


def one_step(solver, **options):
    options = {"consistent": "assume", **options}
    return mj.diffeqsolve(
        TURN, mj.Projected(solver, CIRCLE), 0.0, 0.1, 0.1, START, jnp.asarray(2.0), **options
    )


def test_a_step_of_the_users_own_is_made():
    f = lambda y: 2.0 * np.array([-y[1], y[0]])
    y = np.asarray(START)
    heun = y + 0.05 * (f(y) + f(y + 0.1 * f(y)))
    np.testing.assert_allclose(one_step(Damped()).ys[0], to_circle(heun * [1, 0.95]), atol=1e-15)
    np.testing.assert_allclose(
        one_step(Remembering()).ys[0], to_circle(y + 0.15 * f(y)), atol=1e-15
    )


def test_replay_repeats_a_step_of_the_users_own():
    """Not that of the tableau: the gradient belonged to another map than the solve."""

    def end(rate, adjoint):
        solver = mj.diffeqsolve(
            TURN, Damped(), 0.0, 1.0, 0.1, START, rate, adjoint=adjoint, max_steps=16
        )
        return solver.ys[0] @ jnp.array([1.0, 2.0])

    rate = jnp.asarray(1.3)
    gradient = lambda adjoint: jax.jit(jax.grad(lambda rate: end(rate, adjoint)))(rate)
    expected = gradient(dfx.RecursiveCheckpointAdjoint())
    np.testing.assert_allclose(gradient(mj.StepReplayAdjoint()), expected, rtol=1e-13)


def with_tableau(c, a_lower, b_sol, b_error):
    class Own(dfx.AbstractERK):
        tableau = dfx.ButcherTableau(
            c=np.asarray(c, float),
            a_lower=tuple(np.asarray(row, float) for row in a_lower),
            b_sol=np.asarray(b_sol, float),
            b_error=np.asarray(b_error, float),
        )
        interpolation_cls = dfx.ThirdOrderHermitePolynomialInterpolation.from_k

        def order(self, terms):
            return 1

    return Own()


def many_equations(t, y, args):
    """As long as a field whose stages are run in a loop."""
    for _ in range(400):
        y = 2.0 * (0.5 * y)
    return jnp.stack([-y[1], y[0]])


@pytest.mark.parametrize(
    "solver",
    [
        with_tableau([0.5], [[0.5]], [0, 1], [0, 0]),
        with_tableau([1.0], [[1.0]], [1, 0], [0.5, -0.5]),  # first same as last: one stage
        with_tableau([0.5, 0.0], [[0.5], [0.0, 0.0]], [0, 1, 0], [1, -1, 0]),
    ],
    ids=["without error estimate", "one stage of its own", "stage at the start"],
)
@pytest.mark.parametrize("field", [TURN.vector_field, many_equations], ids=["short", "long"])
def test_tableaux(solver, field):
    args = dfx.ODETerm(field), 0.0, 0.1, 0.1, START, jnp.asarray(1.0)
    terms, *rest = args
    plain = dfx.diffeqsolve(terms, solver, *rest)
    projected = mj.diffeqsolve(terms, mj.Projected(solver, CIRCLE), *rest)
    np.testing.assert_allclose(projected.ys[0], to_circle(plain.ys[0]), atol=1e-15)


class OneStage(dfx.ButcherTableau):
    """Diffrax asks for the last row of `a_lower`, which has none."""

    def __post_init__(self):
        for name, value in dict(ssal=False, fsal=False, implicit=False, num_stages=1).items():
            object.__setattr__(self, name, value)


class OwnEuler(dfx.AbstractERK):
    tableau = OneStage(c=np.zeros(0), a_lower=(), b_sol=np.ones(1), b_error=np.zeros(1))
    interpolation_cls = dfx.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 1


def test_one_stage():
    y = START + 0.1 * 2.0 * np.array([-START[1], START[0]])
    np.testing.assert_allclose(one_step(OwnEuler()).ys[0], to_circle(y), atol=1e-15)


class OwnHook(dfx.AbstractWrappedSolver):
    """A step hook that is none of the library's."""

    solver: dfx.AbstractSolver
    term_structure = dfx.Tsit5.term_structure
    interpolation_cls = dfx.Tsit5.interpolation_cls

    def order(self, terms):
        return self.solver.order(terms)

    def init(self, *args):
        return self.solver.init(*args)

    def func(self, *args):
        return self.solver.func(*args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, *rest = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1 / jnp.sqrt(y1 @ y1), *rest


def test_a_hook_of_the_users_own():
    """The library does not know its constraint, and says so; inside of `Projected` all is corrected."""
    off = START + 0.2
    solve = lambda solver: mj.diffeqsolve(
        TURN, solver, 0.0, 1.0, 0.2, off, 1.0, saveat=dfx.SaveAt(t0=True, ts=jnp.array([0.5, 0.7]))
    )
    with pytest.warns(UserWarning, match=r"`mj.Projected\(OwnHook\(...\), constraint\)`"):
        assert abs(solve(OwnHook(dfx.Tsit5())).ys[0] @ off - off @ off) < 1e-12
    ys = solve(mj.Projected(OwnHook(dfx.Tsit5()), CIRCLE)).ys
    np.testing.assert_allclose(jnp.sum(ys**2, axis=1), 1.0, atol=1e-15)


def test_copies_of_a_dense_solution():
    """Diffrax's can be copied and pickled; of this one pickling says what to save."""
    hook = mj.Projected(dfx.Tsit5(), CIRCLE)
    saveat = dfx.SaveAt(dense=True)
    sol = mj.diffeqsolve(TURN, hook, 0.0, 1.0, 0.5, START, jnp.asarray(2.0), saveat=saveat)
    np.testing.assert_array_equal(copy.deepcopy(sol).evaluate(0.3), sol.evaluate(0.3))
    with pytest.raises(TypeError, match=r"`jax.vmap\(sol.evaluate\)\(ts\)`"):
        pickle.dumps(sol)


class Relaxed(mj.AbstractManifoldSolver):
    """A step hook of the user's own: the new state is moved along the step until its length is 1."""

    inner: dfx.AbstractSolver
    constraint: mj.AbstractConstraint
    projection: mj.NewtonProjection = mj.NewtonProjection()
    corrects_output: ClassVar[bool] = True

    def prepare_terms(self, terms):
        return terms

    def frame(self, terms, t0, t1, y0, args):
        def correct(y):
            step = y - y0
            p = y0 - 2 * (y0 @ step) / (step @ step) * step
            violation = jnp.abs(p @ p - 1)
            return p, mj.ProjectionInfo.of_formula(y, p, violation, jnp.all(jnp.isfinite(p)))

        return mj.StepFrame.of_state(y0, terms, correct)


def relaxed(rate, **options):
    options = {"saveat": dfx.SaveAt(ts=jnp.array([0.3, 1.07, 2.0])), **options}
    start = 1.01 * START  # not on the circle
    return mj.diffeqsolve(TURN, Relaxed(dfx.Heun(), CIRCLE), 0.0, 2.0, 0.05, start, rate, **options)


def test_a_step_hook_of_the_users_own():
    """The start, the steps, and values between them are on the manifold; the steps are its own."""
    rate = jnp.asarray(1.3)
    sol = relaxed(rate, saveat=dfx.SaveAt(steps=True, ts=None), max_steps=64)
    np.testing.assert_allclose(sol.stats["initial_correction"], 0.01 * 0.8 / 1.808, rtol=1e-2)
    y, rows = np.asarray(START), np.asarray(sol.ys)[:40]
    f = lambda y: 1.3 * np.array([-y[1], y[0]])
    for row in rows:
        d = 0.025 * (f(y) + f(y + 0.05 * f(y)))
        y = y - 2 * (y @ d) / (d @ d) * d
        np.testing.assert_allclose(row, y, rtol=0, atol=1e-13)
    between = relaxed(rate).ys
    np.testing.assert_allclose(jnp.sum(between**2, axis=1), 1.0, rtol=0, atol=1e-15)


def test_gradients_and_batches_of_a_step_hook_of_the_users_own():
    end = lambda rate: relaxed(rate).ys[1] @ jnp.array([1.0, 2.0])
    rate, h = jnp.asarray(1.3), 1e-5
    run = jax.jit(jax.value_and_grad(end))
    difference = (run(rate + h)[0] - run(rate - h)[0]) / (2 * h)
    np.testing.assert_allclose(run(rate)[1], difference, rtol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(rate), difference, rtol=1e-8)
    rates = jnp.array([0.7, 1.3, 2.0])
    together = mj.solve_ensemble(
        TURN,
        Relaxed(dfx.Heun(), CIRCLE),
        0.0,
        2.0,
        0.05,
        jnp.tile(START, (3, 1)),
        rates,
        args_axes=0,
    )
    alone = mj.diffeqsolve(TURN, Relaxed(dfx.Heun(), CIRCLE), 0.0, 2.0, 0.05, START, rate)
    np.testing.assert_allclose(together.ys[1], alone.ys, rtol=0, atol=1e-14)
    assert together.execution == "in lanes"
