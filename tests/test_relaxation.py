"""Relaxation: order, a nonlinear invariant together with linear ones, derivatives, and what it refuses."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import manifold_jax as mj


# Two masses on a line and a spring that is not linear: the total momentum is a linear invariant.
MASSES = np.array([1.0, 3.0])
ARGS = {"masses": jnp.asarray(MASSES), "stiffness": jnp.asarray(2.0)}
START = jnp.array([0.0, 1.5]), jnp.array([0.4, -0.9])


def field(t, y, args):
    x, p = y
    stretch = x[1] - x[0] - 1.0
    pull = args["stiffness"] * (stretch + stretch**3)
    return p / args["masses"], jnp.stack([pull, -pull])


def energy(t, y, args):
    x, p = y
    stretch = x[1] - x[0] - 1.0
    spring = args["stiffness"] * (stretch**2 / 2 + stretch**4 / 4)
    return jnp.sum(p * p / args["masses"]) / 2 + spring


def solve(solver=None, t1=2.0, dt0=0.05, args=ARGS, approach=mj.Relaxation, **options):
    solver = dfx.Tsit5() if solver is None else solver
    hook = approach(solver, mj.Invariants(energy, y0=START, args=args))
    options = {"max_steps": 512} | options
    return mj.diffeqsolve(dfx.ODETerm(field), hook, 0.0, t1, dt0, START, args, **options)


BODY = mj.problems.rigid_body()


@pytest.mark.parametrize(
    ("solver", "steps"),
    [(dfx.Ralston(), 80), pytest.param(dfx.Dopri5(), 40, marks=pytest.mark.slow)],
)
def test_order(solver, steps):
    """Of a rigid body with its energy kept: the length of its momentum is not."""
    kinetic = mj.Invariants(
        lambda t, y, args: jnp.sum(y * y / args.inertia), y0=BODY.y0, args=BODY.args
    )
    hook, errors = mj.Relaxation(solver, kinetic), []
    for h in (5.0 / steps, 2.5 / steps):
        sol = mj.diffeqsolve(BODY.terms, hook, 0.0, 5.0, h, BODY.y0, BODY.args, max_steps=256)
        errors.append(np.max(np.abs(sol.ys[-1] - BODY.reference(5.0))))
    assert abs(np.log2(errors[0] / errors[1]) - solver.order(None)) < 0.2


@pytest.mark.parametrize(
    "steps",
    [
        dict(dt0=0.1),
        pytest.param(
            dict(dt0=None, stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5)),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_linear_invariants_stay(steps):
    """With constant steps and adaptive ones; a projection onto the energy moves the momentum."""
    changes = []
    for approach in (mj.Relaxation, mj.Projected):
        sol = solve(t1=20.0, approach=approach, saveat=dfx.SaveAt(steps=True), **steps)
        number = int(sol.stats["num_accepted_steps"])
        x, p = (leaf[:number] for leaf in sol.ys)
        energies = jax.vmap(lambda y: energy(0.0, y, ARGS))((x, p))
        assert np.max(np.abs(energies - energy(0.0, START, ARGS))) < 4e-15
        changes.append(np.max(np.abs(np.sum(p, axis=1) + 0.5)))
    assert changes[0] < 1e-14 < 1e-8 < changes[1]


def test_values_between_steps():
    """They are on the level of the energy, and go over into the ends of steps."""
    ts = jnp.linspace(0.0, 2.0, 41)
    sol = solve(t1=2.0, dt0=0.125, saveat=dfx.SaveAt(ts=ts, dense=True))
    energies = jax.vmap(lambda y: energy(0.0, y, ARGS))(sol.ys)
    np.testing.assert_allclose(energies, energy(0.0, START, ARGS), rtol=0, atol=2e-15)
    beside = jnp.nextafter(1.0, jnp.array([0.0, 2.0]))
    below, above = (np.stack(sol.evaluate(t)) for t in beside)
    np.testing.assert_allclose(below, above, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_gradients():
    """In both modes, and against differences; forces and energy both depend on the parameters."""
    end = lambda args: solve(t1=1.0, dt0=0.1, args=args, max_steps=16).ys[0][-1, 0]
    reverse, forward = jax.jit(jax.grad(end))(ARGS), jax.jit(jax.jacfwd(end))(ARGS)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), reverse, forward)
    value = jax.jit(end)
    for name, unit in (("stiffness", 1.0), ("masses", [1.0, 0.0]), ("masses", [0.0, 1.0])):
        unit = jnp.asarray(unit)
        at = lambda s, name=name, unit=unit: value(ARGS | {name: ARGS[name] + s * unit})
        slope = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
        np.testing.assert_allclose(jnp.sum(reverse[name] * unit), slope, rtol=1e-8)


@pytest.mark.slow
def test_lanes_are_one_by_one():
    """States, and gradients."""
    starts = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), START)
    hook = mj.Relaxation(dfx.Tsit5(), mj.Invariants(energy, y0=START, args=ARGS))
    parts = dfx.ODETerm(field), hook, 0.0, 1.0, 0.1

    def in_lanes(stiffness):
        args = ARGS | {"stiffness": stiffness}
        return mj.solve_ensemble(*parts, starts, args, args_axes=None, max_steps=16)

    def alone(stiffness, i):
        args, y0 = ARGS | {"stiffness": stiffness}, jax.tree.map(lambda x: x[i], starts)
        return mj.diffeqsolve(*parts, y0, args, max_steps=16).ys[0][-1, 0]

    assert in_lanes(ARGS["stiffness"]).execution == "in lanes"
    last = lambda stiffness: jnp.sum(in_lanes(stiffness).ys[0][:, -1, 0])
    value, slope = jax.value_and_grad(last)(ARGS["stiffness"])
    each = [jax.jit(jax.value_and_grad(alone))(ARGS["stiffness"], i) for i in range(2)]
    np.testing.assert_allclose(value, sum(x for x, _ in each), rtol=1e-13)
    np.testing.assert_allclose(slope, sum(x for _, x in each), rtol=1e-11)


def test_an_invariant_with_its_sign_changed():
    """The steps are the same, with the linear invariant beside it, and so are derivatives in both modes."""
    minus = lambda t, y, args: -energy(t, y, args)

    def ends(args, invariant):
        hook = mj.Relaxation(dfx.Tsit5(), mj.Invariants(invariant, y0=START, args=args))
        parts = dfx.ODETerm(field), hook, 0.0, 1.0, 0.1, START, args
        return jnp.concatenate([y[-1] for y in mj.diffeqsolve(*parts, max_steps=16).ys])

    value, slopes = ends(ARGS, energy), jax.jacfwd(ends)(ARGS, energy)
    np.testing.assert_allclose(ends(ARGS, minus), value, rtol=1e-13)
    np.testing.assert_allclose(value[2] + value[3], -0.5, rtol=1e-14)
    for derivative in (jax.jacfwd, jax.jacrev):
        flipped = jax.jit(lambda args, of=derivative: of(ends)(args, minus))(ARGS)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), flipped, slopes)


def test_an_invariant_neither_convex_nor_concave():
    """A pendulum goes over the top, where the energy falls along the line of the first step."""
    swing = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])])
    level = mj.Invariants(
        lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]), y0=jnp.array([3.0, 0.5])
    )
    hook, y0 = mj.Relaxation(dfx.Tsit5(), level), np.array([3.0, 0.5])
    sol = mj.diffeqsolve(dfx.ODETerm(swing), hook, 0.0, 5.0, 0.05, y0)
    own = lambda t, y: [y[1], -np.sin(y[0])]
    end = scipy.integrate.solve_ivp(own, (0, 5), y0, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(sol.ys[-1], end, rtol=0, atol=1e-7)
    assert abs(level(0.0, sol.ys[-1])) < 1e-14


def test_bad_input():
    level = mj.Invariants(energy, y0=START, args=ARGS)
    with pytest.raises(TypeError, match="`solver` must be an instance"):
        mj.Relaxation(dfx.Tsit5, level)
    with pytest.raises(ValueError, match="not an explicit Runge-Kutta method"):
        mj.Relaxation(dfx.Kvaerno3(), level)
    both = mj.Invariants(lambda t, y, args: (energy(t, y, args), y[1].sum()), y0=START, args=ARGS)
    with pytest.raises(ValueError, match="`constraint` has 2 equations"):
        mj.diffeqsolve(
            dfx.ODETerm(field), mj.Relaxation(dfx.Tsit5(), both), 0.0, 1.0, 0.1, START, ARGS
        )


def test_a_line_that_misses_the_level():
    """At rest nothing moves, and no direction leads to the energy that is asked for."""
    level = mj.Constraint(lambda t, y, args: energy(0.0, y, args) - 0.5 * t)
    hook = mj.Relaxation(dfx.Tsit5(), level)
    start = jnp.array([0.0, 1.0]), jnp.zeros(2)
    sol = mj.diffeqsolve(dfx.ODETerm(field), hook, 0.0, 1.0, 0.1, start, ARGS, throw=False)
    assert sol.result == dfx.RESULTS.nonlinear_divergence
