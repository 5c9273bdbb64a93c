"""The ways to execute a step, held against each other: they may differ by rounding alone."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax._solver.interpolation import CorrectedInterpolation
from manifold_jax._solver.step.execution import (
    CarriedDerivative,
    execution_of,
    ExplicitStep,
    OwnStep,
)
from manifold_jax._solver.step.frame import StepFrame


CIRCLE = mj.Constraint(lambda t, y, args: y["x"] @ y["x"] - 1.0)
T0, T1, T2 = jnp.asarray([0.0, 0.3, 0.5])
SPEED = jnp.asarray(1.3)
START = {"x": jnp.array([0.6, 0.8])}


def field(t, y, args):
    x = y["x"]
    return {"x": args * (1 + t) * jnp.stack([-x[1], x[0]])}


TERM = dfx.ODETerm(field)
EXPLICIT = [dfx.Heun(), dfx.Bosh3(), dfx.Tsit5(), dfx.Dopri8()]
TIGHT = dfx.VeryChord(rtol=1e-12, atol=1e-12)


def unchanged(y):
    return y, mj.ProjectionInfo.of_nothing(y, jnp.asarray(True))


def two_steps(execution, corrected):
    """Return a function of the speed and of whether the field jumps behind the first of them."""

    def frame(t1, y0):
        if not corrected:
            return StepFrame.of_state(y0, TERM, unchanged)
        correct = lambda y: CIRCLE.correct(mj.NewtonProjection(), t1, y, None, fallback=y0)
        return StepFrame.of_state(y0, TERM, correct)

    def run(speed, jump):
        first = frame(T1, START)
        memory = execution.initial_memory(TERM, first, T0, T1, START, speed)
        one = execution.step(TERM, first, T0, T1, START, speed, memory, False)
        speed = jnp.where(jump, 2 * speed, speed)
        second = frame(T2, one.y1)
        two = execution.step(TERM, second, T1, T2, one.y1, speed, one.memory, jump)
        return [(s.y1, s.raw, s.error, s.dense_info, s.info.success) for s in (one, two)]

    def value(speed, jump):
        steps = run(speed, jump)
        return steps[1][0]["x"][0], steps

    return jax.jit(jax.grad(value, has_aux=True))


def check_equal(ways, jumps, corrected, accuracy):
    programs = [two_steps(way, corrected) for way in ways]
    for jump in jumps:
        first, *others = (program(SPEED, jump) for program in programs)
        for other in others:
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=accuracy), first, other)


@pytest.mark.parametrize("solver", EXPLICIT, ids=lambda s: type(s).__name__)
def test_explicit_steps(solver):
    """Stage by stage, in a loop, and Diffrax's own. Of methods whose last stage is the first one of
    the next step ours is taken at the corrected state, which Diffrax has not got: there the ways
    are compared with nothing to correct."""
    assert isinstance(execution_of(solver, TERM, T0, T1, START, SPEED), ExplicitStep)
    ways = [ExplicitStep(solver, False), ExplicitStep(solver, True)]
    check_equal(ways, [False, True], True, 1e-15)
    frame = StepFrame.of_state(START, TERM, unchanged)

    def step(way):
        memory = way.initial_memory(TERM, frame, T0, T1, START, SPEED)
        return way.step(TERM, frame, T0, T1, START, SPEED, memory, False)

    ours, diffrax = step(ExplicitStep(solver)), step(OwnStep(solver))
    for name in ("y1", "raw", "error", "dense_info"):
        same = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15)
        jax.tree.map(same, getattr(ours, name), getattr(diffrax, name))


@pytest.mark.parametrize("jump", [False, True])
def test_implicit_steps(jump):
    """The derivative that is carried is that of the stage, before its correction: the ways agree
    where there is none, and behind a jump, as accurately as stages are solved."""
    solver = dfx.Kvaerno3(root_finder=TIGHT)
    assert isinstance(execution_of(solver, TERM, T0, T1, START, SPEED), CarriedDerivative)
    check_equal([CarriedDerivative(solver), OwnStep(solver)], [jump], jump, 1e-4)


def test_what_has_no_other_way_makes_its_own_step():
    for solver in (dfx.HalfSolver(dfx.Heun()), dfx.ImplicitEuler(), dfx.EulerHeun()):
        assert isinstance(execution_of(solver, TERM, T0, T1, START, SPEED), OwnStep)


def test_a_bent_interpolant_keeps_its_slopes_at_the_ends():
    """`inner(t) + s^2 (3 - 2 s) correction`: from the old state to the corrected one."""
    inner = dfx.LocalLinearInterpolation(
        t0=jnp.asarray(1.0), t1=jnp.asarray(3.0), y0=jnp.array([0.0]), y1=jnp.array([4.0])
    )
    bent = CorrectedInterpolation(
        t0=inner.t0, t1=inner.t1, inner=inner, y1=jnp.array([4.5]), correction=jnp.array([0.5])
    )
    value, slope = jax.vmap(lambda t: jax.jvp(bent.evaluate, (t,), (jnp.ones(()),)))(
        jnp.array([1.0, 1.5, 3.0])
    )
    np.testing.assert_allclose(value[:, 0], [0.0, 1.0 + 0.5 * 0.15625, 4.5], atol=1e-15)
    np.testing.assert_allclose(slope[:, 0], [2.0, 2.0 + 0.5 * 1.125 / 2, 2.0], atol=1e-14)
