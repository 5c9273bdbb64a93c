"""A chart and a stabilization of somebody else, written from the docstrings with public names only."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
START = jnp.array([0.6, 0.8])


def swing(t, y, args):
    """Turns at a rate that depends on where it is: `angle' = args (1.5 + sin t + y_0)`."""
    return args * (1.5 + jnp.sin(t) + y[0]) * jnp.stack([-y[1], y[0]])


class AngleChart(mj.AbstractChart):
    """The angle from where the step begins."""

    def at(self, constraint, projection, t, y, args):
        return Angle(y, jnp.zeros((), y.dtype))

    @property
    def state(self):
        return turned


class Angle(mj.AbstractCoordinates):
    centre: jax.Array
    origin: jax.Array

    def lift(self, t, w, args):
        near = jnp.abs(w) < 1.0
        y = turned(self.centre, jnp.where(near, w, 0.0))
        return y, mj.ProjectionInfo.of_nothing(y, near)

    def pull_back(self, t, w, y, vector):
        return y[0] * vector[1] - y[1] * vector[0]

    def push_forward(self, t, w, y, args, error):
        return error * jnp.stack([-y[1], y[0]])


def turned(y, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * y[0] - s * y[1], s * y[0] + c * y[1]])


def run(hook, dt0=None, speed=1.0, **options):
    return mj.diffeqsolve(
        dfx.ODETerm(swing), hook, 0.0, 2.0, dt0, START, jnp.asarray(speed), **options
    )


TIGHT = dict(stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10))


@pytest.fixture(scope="module")
def reference():
    return run(mj.Projected(dfx.Dopri8(), CIRCLE), **TIGHT).ys[0]


def test_a_chart_keeps_the_order(reference):
    steps = np.array([16, 23, 32, 45])
    end = jax.jit(
        lambda h: run(mj.LocalCoordinates(dfx.Bosh3(), CIRCLE, chart=AngleChart()), h).ys[0]
    )
    errors = [np.linalg.norm(end(jnp.asarray(2.0 / n)) - reference) for n in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(order - 3) < 0.2, errors


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Kvaerno5()], ids=lambda s: type(s).__name__)
def test_a_chart_with_adaptive_steps(solver, reference):
    """Output between steps, on the manifold; one that is too long is rejected; in a batch."""
    hook = mj.LocalCoordinates(solver, CIRCLE, chart=AngleChart())
    ts = jnp.linspace(0.0, 2.0, 8)
    options = dict(TIGHT, saveat=dfx.SaveAt(ts=ts, dense=True))
    solve = jax.jit(lambda speed: run(hook, 2.0, speed, **options))
    sol = solve(1.0)
    np.testing.assert_allclose(sol.ys[-1], reference, atol=1e-8)
    assert sol.stats["num_rejected_steps"] > 0
    between = jax.vmap(sol.evaluate)(jnp.array([0.123, 1.9]))
    for t, y in ((sol.ts, sol.ys), (jnp.array([0.123, 1.9]), between)):
        assert mj.constraint_violation(CIRCLE, t, y) < 1e-15
    batch = jax.vmap(lambda speed: solve(speed).ys[-1])(jnp.array([1.0, 0.3]))
    np.testing.assert_allclose(batch[0], sol.ys[-1], rtol=0, atol=1e-12)


def test_a_chart_is_differentiated():
    hook = mj.LocalCoordinates(dfx.Bosh3(), CIRCLE, chart=AngleChart())
    end = jax.jit(lambda speed: run(hook, 0.1, speed, max_steps=32).ys[0][0])
    differences = (end(1.0 + 1e-5) - end(1.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), differences, rtol=1e-8)


class Pull(mj.AbstractStabilization):
    """`F = f - s gain y (|y| - 1)`: the radius itself decays exponentially."""

    gain: float
    corrected: bool = eqx.field(static=True, default=False)

    @property
    def rate(self):
        return self.gain

    @property
    def ends_on_manifold(self):
        return self.corrected

    def field(self, f, constraint, projection, sign, t, y, args):
        return f(t, y, args) - sign * self.gain * y * (1 - 1 / jnp.sqrt(y @ y))


@pytest.mark.parametrize("t1", [1.0, -1.0])
def test_a_stabilization_decays_in_both_directions(t1):
    hook = mj.Stabilized(dfx.Tsit5(), CIRCLE, stabilization=Pull(3.0))
    options = dict(TIGHT, consistent="assume")
    sol = mj.diffeqsolve(dfx.ODETerm(swing), hook, 0.0, t1, None, 1.01 * START, 1.0, **options)
    np.testing.assert_allclose(np.linalg.norm(sol.ys[0]) - 1, 0.01 * np.exp(-3.0), rtol=1e-5)


def test_a_stabilization_says_what_it_needs(reference):
    """Steps beyond the stability interval are refused; ends are corrected if it asks for that."""
    stiff = mj.Stabilized(dfx.Tsit5(), CIRCLE, stabilization=Pull(300.0))
    with pytest.raises(RuntimeError, match="`stabilization` has a gain"):
        run(stiff, 0.1)
    exact = mj.Stabilized(dfx.Tsit5(), CIRCLE, stabilization=Pull(3.0, corrected=True))
    sol = run(exact, saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 5)), **TIGHT)
    np.testing.assert_allclose(sol.ys[-1], reference, atol=1e-8)
    assert mj.constraint_violation(CIRCLE, sol.ts, sol.ys) < 1e-15
