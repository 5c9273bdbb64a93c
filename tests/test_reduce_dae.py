"""Reduced equations against those reduced by hand, and against published values."""

import dae_models as models
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import manifold_jax as mj
from benchmarks.tools import andrews, stiff_problems
from manifold_jax.problems.car_axis import CarAxisArgs, END as CAR_AXIS_END


def solve(terms, constraint, z0, args, t1, tolerance=1e-10, solver=None, **kwargs):
    solver = dfx.Tsit5() if solver is None else solver
    if constraint is not None:
        solver = mj.Projected(solver, constraint)
    control = dfx.PIDController(rtol=tolerance, atol=tolerance)
    return mj.diffeqsolve(
        *(terms, solver, 0.0, t1, None, z0, args),
        stepsize_controller=control,
        max_steps=20_000,
        **kwargs,
    )


def reference(field, z0, args, t1):
    """By SciPy, from the vector field reduced by hand."""
    f = jax.jit(field)
    found = scipy.integrate.solve_ivp(
        lambda t, z: np.asarray(f(t, jnp.asarray(z), args)),
        *((0.0, t1), np.asarray(z0)),
        method="DOP853",
        rtol=3e-14,
        atol=1e-14,
    )
    return found.y[:, -1]


PENDULUM_GUESS = jnp.array([1.3, 0.5, 0.6, -0.3, 0.0])
TWO_LINKS = models.chain_example(2)
ARM_GUESS = {"q": jnp.array([0.3, 0.9]), "v": jnp.array([0.4, -0.2]), "force": jnp.asarray(0.0)}
# Model, example, parameters, order; vector field and constraint by hand.
BY_HAND = {
    "pendulum": (
        *(models.pendulum, PENDULUM_GUESS, models.PENDULUM_ARGS, 1),
        *(models.pendulum_field, models.pendulum_constraint),
    ),
    "pendulum, second order": (
        models.pendulum_second_order,
        {"q": PENDULUM_GUESS[:2], "tension": jnp.asarray(0.0)},
        *(models.PENDULUM_ARGS, 2),
        *(models.pendulum_field, models.pendulum_constraint),
    ),
    "two links": (
        *(models.chain, *TWO_LINKS, 1),
        *(models.chain_field, models.chain_constraint),
    ),
    "RLC": (models.rlc_series, jnp.ones(4), models.RLC_ARGS, 1, models.rlc_field, None),
    "capacitor loop": (
        *(models.capacitor_loop, jnp.ones(4), models.RLC_ARGS, 1, models.capacitor_field),
        lambda t, z, a: z[:1] - jnp.sin(a["w"] * t),
    ),
    "arm on a path": (
        *(models.arm_on_path, ARM_GUESS, models.ARM_ARGS, 1),
        *(models.arm_field, models.arm_constraint),
    ),
}


@pytest.fixture(scope="module")
def reduced():
    """Each model is reduced once."""
    made = {}

    def of(name):
        if name not in made:
            model, x, args, order, *_ = BY_HAND[name]
            made[name] = mj.reduce_dae(model, x, args, order=order)
        return made[name]

    return of


@pytest.mark.parametrize("name", BY_HAND)
def test_field_and_constraint_are_those_by_hand(reduced, name):
    """On the manifold and near it."""
    dae, (_, x, args, _, field, constraint) = reduced(name), BY_HAND[name]
    start, info = dae.consistent_state(0.3, x, args)
    assert info.success
    near = start + 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=start.shape))
    ours, theirs = (
        jax.jit(jax.vmap(dae.terms.vf, (None, 0, None))),
        jax.vmap(field, (None, 0, None)),
    )
    states = jnp.stack([start, near])
    other = jax.tree.map(lambda leaf: 1.1 * leaf, args)  # than those of the example
    for parameters in (args, other):
        expected = theirs(0.3, states, parameters)
        found = ours(0.3, states, parameters)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    if constraint is None:
        assert dae.report.num_constraints == 0
    else:
        g = constraint(0.3, near, args)
        np.testing.assert_allclose(dae.constraint(0.3, near, args), g, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(constraint(0.3, start, args), 0, atol=1e-14)


@pytest.mark.parametrize(
    "name",
    [
        *("pendulum", "two links", "RLC", "capacitor loop"),
        pytest.param("arm on a path", marks=pytest.mark.slow),
    ],
)
def test_trajectories(reduced, name):
    dae, (model, x, args, _, field, constraint) = reduced(name), BY_HAND[name]
    start, _ = dae.consistent_state(0.0, x, args)
    manifold = None if constraint is None else dae.constraint
    z = solve(dae.terms, manifold, start, args, 1.0, 1e-11).ys[-1]
    np.testing.assert_allclose(z, reference(field, start, args, 1.0), rtol=0, atol=1e-9)
    if constraint is not None:
        assert mj.constraint_violation(dae.constraint, 1.0, z, args) < 1e-15
        np.testing.assert_allclose(constraint(1.0, z, args), 0, atol=2e-14)
    outputs = jax.jit(dae.outputs)(1.0, z, args)
    for residual in jax.tree.leaves(model(jnp.asarray(1.0), *outputs, args)):
        np.testing.assert_allclose(residual, 0, atol=1e-12)


@pytest.mark.slow
def test_gradients_alone_and_in_a_batch(reduced):
    """Of a position with respect to all parameters, which enter the start, too."""
    dae = reduced("pendulum")

    def by_hand(args):
        manifold = mj.Constraint(models.pendulum_constraint)
        start, _ = dae.consistent_state(0.0, PENDULUM_GUESS, args)
        terms = dfx.ODETerm(models.pendulum_field)
        return solve(terms, manifold, start, args, 0.5, 1e-8).ys[-1, 0]

    def position(args):
        start, _ = dae.consistent_state(0.0, PENDULUM_GUESS, args)
        return solve(dae.terms, dae.constraint, start, args, 0.5, 1e-8).ys[-1, 0]

    batch = {"m": jnp.array([1.3, 0.7]), "g": jnp.array([9.81, 1.6]), "L": jnp.array([1.1, 1.2])}
    alone = jax.tree.map(lambda x: x[1], batch)
    ours = jax.jit(jax.vmap(jax.value_and_grad(position)))(batch)
    theirs = jax.jit(jax.vmap(jax.value_and_grad(by_hand)))(batch)
    single = jax.jit(jax.value_and_grad(position))(alone)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8), ours, theirs)
    second = jax.tree.map(lambda x: x[1], ours)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-10), second, single)
    assert abs(ours[1]["g"]).min() > 1e-3


@pytest.mark.parametrize(
    "name", ["two links", pytest.param("arm on a path", marks=pytest.mark.slow)]
)
def test_derivatives_of_the_field(reduced, name):
    """Forward and reverse, in the state and all parameters, those of the field by hand."""
    dae, (_, x, args, _, field, _) = reduced(name), BY_HAND[name]
    start, _ = dae.consistent_state(0.0, x, args)
    near = start + 0.1
    weights = jnp.asarray(np.random.default_rng(1).normal(size=start.shape))
    for f, hand in ((dae.terms.vf, field), (dae.constraint, BY_HAND[name][5])):
        weigh = lambda f: lambda z, args: weights[: len(f(0.0, z, args))] @ f(0.0, z, args)
        ours = jax.jit(jax.grad(weigh(f), argnums=(0, 1)))(near, args)
        theirs = jax.grad(weigh(hand), argnums=(0, 1))(near, args)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), ours, theirs
        )
    along = jax.jit(lambda dz: jax.jvp(lambda z: dae.terms.vf(0.0, z, args), (near,), (dz,))[1])
    expected = jax.jvp(lambda z: field(0.0, z, args), (near,), (weights,))[1]
    np.testing.assert_allclose(along(weights), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_every_approach_and_an_ensemble(reduced):
    dae, args = reduced("pendulum"), jax.tree.map(jnp.asarray, models.PENDULUM_ARGS)
    start, _ = dae.consistent_state(0.0, PENDULUM_GUESS, args)
    exact = reference(models.pendulum_field, start, args, 1.0)
    control = dfx.PIDController(rtol=1e-8, atol=1e-8)
    gain = mj.InvariantStabilization(5.0)
    hooks = [
        mj.Projected(dfx.Tsit5(), dae.constraint),
        mj.Stabilized(dfx.Tsit5(), dae.constraint, stabilization=gain),
        mj.LocalCoordinates(dfx.Tsit5(), dae.constraint),
    ]
    problem = 0.0, 1.0, None
    for hook in hooks:
        sol = mj.diffeqsolve(dae.terms, hook, *problem, start, args, stepsize_controller=control)
        np.testing.assert_allclose(sol.ys[-1], exact, rtol=0, atol=1e-6)
    many = {**args, "g": jnp.array([5.0, args["g"]])}
    settings = {"args_axes": {"g": 0, "m": None, "L": None}, "stepsize_controller": control}
    starts = jnp.tile(start, (2, 1))
    ensemble = mj.solve_ensemble(dae.terms, hooks[0], *problem, starts, many, **settings)
    np.testing.assert_allclose(ensemble.ys[1, -1], exact, rtol=0, atol=1e-6)


def test_single_precision():
    x, args = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), TWO_LINKS)
    dae = mj.reduce_dae(models.chain, x, args)
    z, info = dae.consistent_state(0.0, x, args)
    assert z.dtype == jnp.float32
    assert info.success
    field = jax.jit(dae.terms.vf)(jnp.float32(0), z, args)
    assert field.dtype == jnp.float32
    exact = models.chain_field(0.0, z.astype(float), jax.tree.map(lambda x: x.astype(float), args))
    np.testing.assert_allclose(field, exact, rtol=1e-5, atol=1e-5)


def test_no_freedom_is_left_to_a_crane():
    """Its inputs, by differentiating four times, against the formulas of a flat system."""
    args, guess = models.CRANE_ARGS, jnp.array(models.CRANE_GUESS)
    dae = mj.reduce_dae(models.crane, guess, args)
    assert (dae.report.index, dae.report.degrees_of_freedom) == (5, 0)
    z, info = jax.jit(lambda a: dae.consistent_state(0.4, guess, a))(args)
    assert info.success
    x, xdot = jax.jit(dae.outputs)(0.4, z, args)
    flat = lambda t: models.crane_flat(t, args)
    expected = jax.jvp(flat, (jnp.asarray(0.4),), (jnp.ones(()),))
    np.testing.assert_allclose(x, expected[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(xdot, expected[1], rtol=0, atol=1e-10)


def test_a_motion_that_is_prescribed():
    """Without states: everything is known at each time."""

    def driven(t, x, xdot, args):
        return xdot["p"] - x["v"], x["p"] - jnp.sin(t), x["f"] - xdot["v"]

    guess = {"p": jnp.array(0.0), "v": jnp.array(1.0), "f": jnp.array(0.0)}
    dae = mj.reduce_dae(driven, guess)
    z0, _ = dae.consistent_state(0.0, guess)
    assert z0.size == 0
    ts = jnp.linspace(0.0, 2.0, 5)
    x, _ = dae.outputs(ts, jnp.zeros((5, 0)))
    for name, exact in (("p", jnp.sin), ("v", jnp.cos), ("f", lambda t: -jnp.sin(t))):
        np.testing.assert_allclose(x[name], exact(ts), atol=1e-14)


@pytest.mark.slow
def test_servo():
    """A path for the tip, and the torques that follow from it."""
    args = models.ARM_ARGS
    guess = {"q": jnp.array([0.0, 1.0]), "v": jnp.zeros(2), "torque": jnp.zeros(2)}
    dae = mj.reduce_dae(models.servo, guess, args)
    assert dae.report.degrees_of_freedom == 0
    z0, _ = dae.consistent_state(0.0, guess, args)
    z = solve(dae.terms, dae.constraint, z0, args, 0.5, 1e-8).ys[-1]
    x, xdot = jax.jit(dae.outputs)(0.5, z, args)
    np.testing.assert_allclose(
        models.arm_tip(x["q"], args), models.servo_path(0.5, args), atol=1e-14
    )
    M, h = models.arm_dynamics(x["q"], x["v"], args)
    np.testing.assert_allclose(x["torque"], M @ xdot["v"] + h, rtol=0, atol=1e-11)
    tip = lambda t, q: models.arm_tip(q, args)
    _, speed = jax.jvp(tip, (0.0, x["q"]), (1.0, x["v"]))
    _, given = jax.jvp(lambda t: models.servo_path(t, args), (0.5,), (1.0,))
    np.testing.assert_allclose(speed, given, atol=1e-14)


# Unknowns in which equations are nonlinear


def test_diode():
    """Its voltage becomes a state; against the equations with it solved for at each time."""
    args, guess = models.DIODE_ARGS, jnp.array([0.6, 0.3, 0.2])
    dae = mj.reduce_dae(models.diode, guess, args)
    assert dae.report.lifted == ("x[1]", "x[2]")
    z0, info = dae.consistent_state(0.0, guess, args)
    assert info.success
    assert z0[0] == 0.6  # the charge of the capacitor is free
    z = solve(dae.terms, dae.constraint, z0, args, 1.0, 1e-10).ys[-1]

    def field(t, u):
        def law(ud):
            return (u[0] - ud) / args["Rd"] - args["Is"] * (np.exp(ud / args["Vt"]) - 1)

        ud = scipy.optimize.brentq(law, -3, 3, xtol=1e-15, rtol=1e-14)
        return [((np.sin(args["w"] * t) - u[0]) / args["R"] - (u[0] - ud) / args["Rd"]) / args["C"]]

    exact = scipy.integrate.solve_ivp(field, (0, 1), [0.6], rtol=1e-12, atol=1e-12, method="DOP853")
    np.testing.assert_allclose(z[0], exact.y[0, -1], rtol=0, atol=1e-9)


def test_an_implicit_equation():
    """`x'^3 + x' = sin t - x`: the derivative itself becomes a state."""
    model = lambda t, x, xdot, args: xdot**3 + xdot - jnp.sin(t) + x
    dae = mj.reduce_dae(model, jnp.asarray(1.0))
    assert dae.report.states == ("x", "x'")
    z, _ = dae.consistent_state(0.0, jnp.asarray(1.5))
    np.testing.assert_allclose(z[1] ** 3 + z[1], -1.5, rtol=1e-14)
    assert z[0] == 1.5
    np.testing.assert_allclose(dae.terms.vf(0.0, z, None)[1], (1 - z[1]) / (3 * z[1] ** 2 + 1))


@pytest.mark.slow
def test_akzo_nobel():
    published = stiff_problems.PROBLEMS["chemical Akzo Nobel"]
    start = jnp.array(published.y0)
    dae = mj.reduce_dae(models.akzo_nobel, start)
    assert dae.report.lifted == ("x[5]",)
    z0, _ = dae.consistent_state(0.0, start.at[5].add(0.1))
    np.testing.assert_allclose(z0, start, rtol=1e-14)
    z = solve(dae.terms, dae.constraint, z0, None, 180.0, 1e-9, dfx.Kvaerno5()).ys[-1]
    np.testing.assert_allclose(z, published.end, rtol=1e-5)


@pytest.mark.slow
def test_robertson():
    """Index 1: the third species is an output."""
    rates = jnp.array([0.04, 3e7, 1e4])
    dae = mj.reduce_dae(models.robertson, jnp.array([1.0, 0.0, 0.0]), rates)
    assert dae.report.num_constraints == 0
    z0, _ = dae.consistent_state(0.0, jnp.array([1.0, 0.0, 0.0]), rates)
    z = solve(dae.terms, None, z0, rates, 40.0, 1e-9, dfx.Kvaerno5()).ys[-1]
    x, _ = dae.outputs(40.0, z, rates)
    field = lambda t, y: [
        -0.04 * y[0] + 1e4 * y[1] * (1 - y[0] - y[1]),
        0.04 * y[0] - 1e4 * y[1] * (1 - y[0] - y[1]) - 3e7 * y[1] ** 2,
    ]
    control = {"method": "Radau", "rtol": 1e-10, "atol": 1e-14}
    y1, y2 = scipy.integrate.solve_ivp(field, (0, 40), [1.0, 0.0], **control).y[:, -1]
    np.testing.assert_allclose(x, [y1, y2, 1 - y1 - y2], rtol=1e-7)


# Published benchmarks


@pytest.mark.slow
def test_car_axis():
    args = CarAxisArgs()
    x = {
        "q": jnp.array([0, 0.5, 1, 0.5]),
        "v": jnp.array([-0.5, 0, -0.5, 0]),
        "force": jnp.zeros(2),
    }
    dae = mj.reduce_dae(models.car_axis, x, args)
    z0, info = dae.consistent_state(0.0, x, args)
    assert info.correction == 0  # consistent as published
    z = solve(dae.terms, dae.constraint, z0, args, 3.0, 1e-12, dfx.Dopri8()).ys[-1]
    x, _ = jax.jit(dae.outputs)(3.0, z, args)
    np.testing.assert_allclose(x["q"], CAR_AXIS_END[0], rtol=0, atol=2e-12)
    np.testing.assert_allclose(x["v"], CAR_AXIS_END[1], rtol=0, atol=1.5e-11)
    np.testing.assert_allclose(x["force"], models.CAR_AXIS_FORCE, rtol=0, atol=1e-13)
    assert mj.constraint_violation(dae.constraint, 3.0, z, args) < 1e-15


@pytest.mark.slow
def test_andrews():
    model = models.mechanism(andrews._mass, andrews._loops, andrews._force)
    args = andrews.AndrewsArgs()
    x = {"q": jnp.asarray(andrews.START), "v": jnp.zeros(7), "force": jnp.zeros(6)}
    dae = mj.reduce_dae(model, x, args)
    assert (dae.report.index, dae.report.degrees_of_freedom) == (3, 2)
    z0, _ = dae.consistent_state(0.0, x, args)
    at_start, rates = jax.jit(dae.outputs)(0.0, z0, args)
    np.testing.assert_allclose(rates["v"][:2], andrews.ACCELERATIONS, rtol=1e-10)
    np.testing.assert_allclose(at_start["force"][:2], andrews.MULTIPLIERS, rtol=1e-10)
    z = solve(dae.terms, dae.constraint, z0, args, 0.03, 1e-12).ys[-1]
    np.testing.assert_allclose(z[:7], andrews.END, rtol=1e-9)


# Initial values


@pytest.mark.parametrize(
    "name", ["pendulum", pytest.param("arm on a path", marks=pytest.mark.slow)]
)
def test_start_and_its_gradient(reduced, name):
    """From a guess far away; the derivative against differences of sixth order."""
    dae, (_, x, args, *_) = reduced(name), BY_HAND[name]

    def start(scale):
        far = jax.tree.map(lambda leaf: leaf + 0.4 * scale, x)
        varied = jax.tree.map(lambda leaf: leaf * scale, args)
        z, info = dae.consistent_state(0.1 * scale, far, varied)
        return z, info.success

    (z, success), (slope, _) = jax.jit(lambda s: jax.jvp(start, (s,), (jnp.ones(()),)))(
        jnp.ones(())
    )
    assert success
    np.testing.assert_allclose(dae.constraint(0.1, z, args), 0, atol=2e-15)
    at, h = jax.jit(lambda s: start(s)[0]), 1e-2
    differences = [(at(1 + k * h) - at(1 - k * h)) / (2 * h * k) for k in (1, 2, 3)]
    sixth = 1.5 * differences[0] - 0.6 * differences[1] + 0.1 * differences[2]
    np.testing.assert_allclose(slope, sixth, rtol=0, atol=1e-8)
    back = jax.jit(jax.jacrev(lambda s: start(s)[0]))(jnp.ones(()))
    np.testing.assert_allclose(back, slope, rtol=1e-11, atol=1e-12)


def test_lifted_start_and_its_gradient():
    args, guess = models.DIODE_ARGS, jnp.array([0.6, 0.3, 0.2])
    dae = mj.reduce_dae(models.diode, guess, args)
    start = lambda Is: dae.consistent_state(0.0, guess, {**args, "Is": Is})[0]
    slope = jax.jit(jax.jacrev(start))(1e-2)
    h, weights = 1e-4, {1: 45 / 60, 2: -9 / 60, 3: 1 / 60}
    sixth = sum(w * (start(1e-2 + k * h) - start(1e-2 - k * h)) for k, w in weights.items()) / h
    np.testing.assert_allclose(slope, sixth, rtol=0, atol=1e-8)
    u, ud, i = start(1e-2)
    np.testing.assert_allclose(u - ud - args["Rd"] * i, 0, atol=1e-15)
    np.testing.assert_allclose(i, 1e-2 * (jnp.exp(ud / args["Vt"]) - 1), rtol=1e-13)
    # Microamperes are not less accurate.
    micro = {**args, "R": args["R"] * 1e6, "Rd": args["Rd"] * 1e6, "C": args["C"] / 1e6}
    z, _ = dae.consistent_state(0.0, guess, {**micro, "Is": 1e-8})
    np.testing.assert_allclose(z, [u, ud, 1e-6 * i], rtol=1e-14)


def test_what_is_fixed_stays(reduced):
    dae, (_, x, args, *_) = reduced("two links"), BY_HAND["two links"]
    far = jax.tree.map(lambda leaf: leaf + 0.1, x)
    z, info = dae.consistent_state(0.0, far, args, fixed=("p[0,0]", "p[1,0]", "v[1,0]"))
    kept = np.array([0, 2, 6])
    np.testing.assert_array_equal(
        z[kept], jnp.concatenate([far["p"].ravel(), far["v"].ravel()])[kept]
    )
    assert info.success
    np.testing.assert_allclose(models.chain_constraint(0.0, z, args), 0, atol=1e-14)


def test_guesses_of_derivatives(reduced):
    dae, (_, x, args, *_) = reduced("pendulum, second order"), BY_HAND["pendulum, second order"]
    speed = {"q": jnp.array([0.6, -0.3]), "tension": jnp.asarray(0.0)}
    z, _ = dae.consistent_state(0.0, x, args, derivatives=(speed,))
    z1, _ = reduced("pendulum").consistent_state(0.0, PENDULUM_GUESS, args)
    np.testing.assert_allclose(z, z1, rtol=1e-14)
    assert dae.report.states == ("q[0]", "q[1]", "q[0]'", "q[1]'")
    still, _ = dae.consistent_state(0.0, x, args)
    np.testing.assert_array_equal(still[2:], 0)


# Bad input


def test_not_square():
    with pytest.raises(ValueError, match="returned 2 equations for the 3 unknowns"):
        mj.reduce_dae(lambda t, x, xdot, args: xdot[:2], jnp.ones(3))
    with pytest.raises(ValueError, match="`order` must be 1, 2 or 3"):
        mj.reduce_dae(lambda t, x, xdot, args: xdot, jnp.ones(3), order=0)
    with pytest.raises(TypeError, match=r"F\(t, x, x', x'', args\)"):
        mj.reduce_dae(lambda t, x, xdot, args: xdot, jnp.ones(3), order=2)
    with pytest.raises(TypeError, match="`x_example` has a leaf of type int"):
        mj.reduce_dae(lambda t, x, xdot, args: xdot, jnp.ones(3, int))
    with pytest.raises(TypeError, match="leaf of type int"):
        mj.reduce_dae(lambda t, x, xdot, args: jnp.zeros(3, int), jnp.ones(3))


def test_structurally_singular():
    def model(t, x, xdot, args):
        free, loose = x["free"], x["loose"]
        return {
            "load": xdot["free"] + loose[0] + loose[1],
            "twice": jnp.stack([free - t, free**2 - 1]),
        }

    message = (
        r"equations `twice\[0\]`, `twice\[1\]` are too many for the unknowns in them: `free`. "
        r"The unknowns `loose\[0\]`, `loose\[1\]` are left to too few equations: `load`"
    )
    with pytest.raises(ValueError, match=message):
        mj.reduce_dae(model, {"free": jnp.asarray(1.0), "loose": jnp.ones(2)})


def test_numerically_singular():
    def varying(t, x, xdot, args):
        into = (2 + x[0] ** 2) * (xdot[0] - xdot[1])
        return jnp.stack([into - jnp.sin(t), x[1] - jnp.cos(t) * into])

    with pytest.raises(ValueError, match=r"`F\[0\]`, `F\[1\]`.*mj.MassMatrixTerm.*mj.Rodas5P"):
        mj.reduce_dae(varying, jnp.ones(2))


def test_parameters_that_switch_structure():
    """The example has to have them as they will be used. One equation depends on no other."""
    model = lambda t, x, xdot, eps: jnp.stack([xdot[0] + x[0] * x[1], eps * xdot[1] - x[1] + x[0]])
    vanishing = r"coefficients of `x\[1\]'` in the equation `F\[1\]`.* are zero"
    with pytest.raises(ValueError, match=f"{vanishing} there.*`args_example`"):
        mj.reduce_dae(model, jnp.ones(2), 0.0)
    dae = mj.reduce_dae(model, jnp.ones(2), 0.1)
    with pytest.raises(ValueError, match=f"{vanishing} at the start"):
        dae.consistent_state(0.0, jnp.ones(2), 0.0)
    assert np.isfinite(dae.terms.vf(0.0, jnp.ones(2), 0.1)).all()
    assert np.isnan(dae.terms.vf(0.0, jnp.ones(2), 0.0)).any()


def doubled(t, x, xdot, args):
    """A pendulum with two rods, of which one is always parallel to the other."""
    q, v = x["q"], x["v"]
    rods = jnp.stack([q @ q - 1, (q @ q) ** 2 - 1])
    force = 2 * q * x["tension"][0] + 4 * q * (q @ q) * x["tension"][1]
    weight = jnp.array([0.0, 9.81])
    return {"kinematics": xdot["q"] - v, "motion": xdot["v"] + force + weight, "rods": rods}


def redundant(t, x, xdot, args):
    """Three equations for a point in space, of which one follows from the others on the manifold
    alone: two spheres and the plane in which they meet."""
    q, v = x["q"], x["v"]
    g = lambda q: jnp.stack([q @ q - 1, (q - 1.0) @ (q - 1.0) - 1, (q.sum() - 1.5) * jnp.exp(q[0])])
    _, pull = jax.vjp(g, q)
    motion = xdot["v"] + pull(x["force"])[0]
    return {"kinematics": xdot["q"] - v, "motion": motion, "joints": g(q)}


def test_redundant_constraints():
    guess = {"q": jnp.array([0.9, 0.5, 0.1]), "v": jnp.zeros(3), "force": jnp.zeros(3)}
    dae = mj.reduce_dae(redundant, guess)
    with pytest.raises(ValueError, match=r"`joints\[0\]`, `joints\[1\]`, `joints\[2\]`.*redundant"):
        dae.consistent_state(0.0, guess)
    z, info = jax.jit(lambda x: dae.consistent_state(0.0, x, throw=False))(guess)
    assert not info.success
    on = mj.project(
        mj.Constraint(lambda t, q, a: jnp.stack([q @ q - 1, q.sum() - 1.5])), 0.0, guess["q"]
    )[0]
    z = jnp.concatenate([on, jnp.zeros(3)])
    assert np.isnan(dae.terms.vf(0.0, z, None)).any()
    with pytest.raises(
        RuntimeError, match="`dae.consistent_state`, called outside of `jit`, says which"
    ):
        solve(dae.terms, dae.constraint, z, None, 1.0)


@pytest.mark.parametrize("form", ["ode", "index-1"])
def test_a_derivative_that_is_not_guessed(form):
    """Where it is zero, as by default, `x'^2 = x` does not determine the next one."""
    square = lambda t, x, xdot, args: {"e": xdot["x"] ** 2 - x["x"]}
    dae, x = mj.reduce_dae(square, {"x": 1.0}, form=form), {"x": 1.0}
    with pytest.raises(ValueError, match=r"where `x'` is zero.*`derivatives=\({'x': 1.0},\)`"):
        dae.consistent_state(0.0, x, fixed=("x",))
    with pytest.raises(RuntimeError, match=r"guess of `x'` is zero"):
        eqx.filter_jit(lambda x: dae.consistent_state(0.0, x, fixed=("x",)))(x)
    z, _ = dae.consistent_state(0.0, x, fixed=("x",), derivatives=({"x": -0.5},))
    np.testing.assert_allclose(z, [1.0, -1.0], rtol=1e-14)


def test_infeasible_starts(reduced):
    dae, args = reduced("pendulum"), models.PENDULUM_ARGS
    with pytest.raises(RuntimeError, match=r"`x\[0\]` fixed"):
        dae.consistent_state(0.0, PENDULUM_GUESS.at[0].set(2.0), args, fixed=("x[0]",))
    level = PENDULUM_GUESS.at[:2].set(jnp.array([args["L"], 0.0]))
    with pytest.raises(RuntimeError, match=r"fixed: .* depend on each other.*form='index-1'"):
        dae.consistent_state(0.0, level, args, fixed=("x[0]",))  # no direction is left to x[1]
    held = "x[0]", "x[1]"
    with pytest.raises(RuntimeError, match=r"No state near .* with `x\[0\]`, `x\[1\]` fixed"):
        dae.consistent_state(0.0, PENDULUM_GUESS, args, fixed=held)
    z, _ = dae.consistent_state(0.0, level, args, fixed=held)  # which is where they can be
    np.testing.assert_allclose(z, [args["L"], 0.0, 0.0, -0.3], atol=1e-15)
    with pytest.raises(ValueError, match=r"`x\[4\]`, not of the state.*follows from it"):
        dae.consistent_state(0.0, PENDULUM_GUESS, args, fixed=("x[4]",))
    with pytest.raises(TypeError, match="a tuple of names"):
        dae.consistent_state(0.0, PENDULUM_GUESS, args, fixed="x")
    with pytest.raises(ValueError, match="must be like `x_example`"):
        dae.consistent_state(0.0, PENDULUM_GUESS[:4], args)
    with pytest.raises(ValueError, match=r"vector of shape \(4,\)"):
        dae.terms.vf(0.0, PENDULUM_GUESS, args)
    for guess in (PENDULUM_GUESS, tuple(PENDULUM_GUESS)):  # unknowns for the state
        with pytest.raises(ValueError, match=r"shape \(4,\).*`dae.consistent_state` makes one"):
            solve(dae.terms, dae.constraint, guess, args, 1.0)
    batch = jnp.stack([PENDULUM_GUESS, PENDULUM_GUESS.at[0].set(jnp.nan), jnp.zeros(5)])
    _, info = jax.vmap(lambda x: dae.consistent_state(0.0, x, args, throw=False))(batch)
    assert info.success.tolist() == [True, False, False]


def test_without_constraints(reduced):
    """The solver alone, to the last bit."""
    dae = reduced("RLC")
    ends = [
        mj.diffeqsolve(dae.terms, solver, 0.0, 1.0, 0.1, jnp.ones(2), models.RLC_ARGS).ys
        for solver in (mj.Projected(dfx.Heun(), dae.constraint), dfx.Heun())
    ]
    assert np.array_equal(*ends)


def test_derivatives_that_do_not_exist():
    @jax.custom_vjp
    def square(x):
        return x**2

    square.defvjp(lambda x: (x**2, x), lambda x, g: (2 * x * g,))
    with pytest.raises(TypeError, match="custom_vjp"):
        mj.reduce_dae(lambda t, x, xdot, args: xdot - square(x), jnp.ones(2))
    with pytest.raises(ValueError, match="not finite near `x_example`"):
        mj.reduce_dae(lambda t, x, xdot, args: jnp.sqrt(-1 - x**2) * xdot, jnp.ones(2))


def test_no_unknowns():
    with pytest.raises(ValueError, match="`x_example` has no numbers"):
        mj.reduce_dae(lambda t, x, xdot, args: x, jnp.zeros(0))


def test_not_under_jit():
    reduce = lambda x: mj.reduce_dae(lambda t, x, xdot, args: xdot - x, x).report.index
    with pytest.raises(ValueError, match="cannot be called under `jax.jit`"):
        jax.jit(reduce)(jnp.ones(2))

    def closed_over(a):
        return mj.reduce_dae(lambda t, x, xdot, args: a * xdot - x, jnp.ones(2)).report.index

    with pytest.raises(ValueError, match="cannot be called under `jax.jit`"):
        jax.jit(closed_over)(1.0)


# The report


def test_report(reduced):
    report = reduced("pendulum").report
    assert (report.index, report.degrees_of_freedom, report.num_constraints) == (3, 2, 2)
    np.testing.assert_array_equal(report.c, [1, 1, 0, 0, 2])
    np.testing.assert_array_equal(report.d, [2, 2, 1, 1, 0])
    assert report.states == ("x[0]", "x[1]", "x[2]", "x[3]")
    assert report.dropped == ("F[0]", "F[1]")
    assert 1 < report.condition < 10
    lines = str(report).splitlines()
    assert (
        lines[0]
        == "index 3, 2 degrees of freedom: 5 equations reduced to 4 states with 2 constraints"
    )
    assert repr(reduced("pendulum")) == f"ReducedDAE({lines[0]}; see `report`)"
    assert lines[2].split() == ["x[0]", "x[1]", "x[2]", "x[3]", "x[4]", "c"]
    assert lines[7].split() == ["F[4]", "0", "0", ".", ".", ".", "2"]
    assert lines[8].split() == ["d", "2", "2", "1", "1", "0"]


def test_report_of_many():
    x, args = models.chain_example(10)
    report = mj.reduce_dae(models.chain, x, args).report
    text = str(report)
    assert "2 times rods[0], rods[1]" in text
    assert max(map(len, text.splitlines())) < 700
    assert "taken to depend" not in text


def test_factors_of_names():
    """`2 x' = v`, and a chain of them with rates of its own."""
    model = lambda t, x, xdot, args: jnp.stack(
        [2 * xdot[0] - x[1], x[1] / 4 - xdot[2], x[2] - xdot[1] + x[0]]
    )
    dae = mj.reduce_dae(model, jnp.ones(3))
    assert dae.report.states == ("x[0]", "x[1]", "x[2]")
    z = jnp.array([0.3, -0.7, 1.1])
    np.testing.assert_allclose(dae.terms.vf(0.0, z, None), [-0.35, 1.4, -0.175], rtol=1e-15)
    x, xdot = dae.outputs(0.0, z)
    np.testing.assert_allclose(x, z, rtol=1e-15)
    np.testing.assert_allclose(model(0.0, x, xdot, None), 0, atol=1e-15)


@pytest.mark.parametrize("guess", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("equation", [lambda x: jnp.cosh(x) - 0.5, lambda x: x**2 + 1])
def test_equations_that_no_state_satisfies(equation, guess):
    """The message does not judge them where the iterations end: at zero or infinity."""

    def equations(t, x, x_dot, args):
        return x_dot["a"] - x["b"], equation(x["a"])

    example = {"a": guess, "b": 1.0}
    system = mj.reduce_dae(equations, example)
    with pytest.raises(
        RuntimeError, match="No state near `x_guess` satisfies the equations of `F`"
    ):
        system.consistent_state(0.0, example)
