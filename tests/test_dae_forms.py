"""What reductions do beside the usual: combinations of equations, equations of index 1, unknowns
that are higher derivatives."""

import dae_models as models
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special

import manifold_jax as mj


# Combinations of equations from which derivatives cancel


def capacitor_between(t, x, xdot, a):
    """A capacitor between two nodes, each with a resistor to ground, and a source at the first:
    `u' - v'` is in both equations."""
    u, v = x
    into = a["C"] * (xdot[0] - xdot[1])
    return jnp.stack([into - (jnp.sin(t) - u) / a["R"], -into + v / a["S"]])


CAPACITOR_ARGS = {"C": 0.3, "R": 0.7, "S": 1.1}


def capacitor_by_hand(t, v, a):
    """`v' = u' - v / (S C)` and `v / S = (sin t - u) / R`."""
    gain = a["R"] / a["S"]
    return (jnp.cos(t) - v / (a["S"] * a["C"])) / (1 + gain)


def test_combination():
    args = jax.tree.map(jnp.asarray, CAPACITOR_ARGS)
    dae = mj.reduce_dae(capacitor_between, jnp.ones(2), args)
    report = dae.report
    assert (report.index, report.degrees_of_freedom, report.num_constraints) == (1, 1, 1)
    assert "F[0] + F[1]" in report.equations
    t, other = 0.4, jax.tree.map(lambda p: 1.3 * p, args)
    z, info = dae.consistent_state(t, jnp.array([0.2, 0.5]), other)
    assert info.success
    rate = dae.terms.vf(t, z, other)
    np.testing.assert_allclose(rate[1], capacitor_by_hand(t, z[1], other), rtol=1e-13)
    np.testing.assert_allclose(
        capacitor_between(t, *dae.outputs(t, z, other), other), 0, atol=1e-14
    )


def test_combination_of_algebraic_unknowns():
    """`i - j` is in two equations that together leave `v = 1`: index 2."""
    network = lambda t, x, xdot, a: jnp.stack(
        [-x[0] + x[1] + a, x[0] - x[1] - x[2], xdot[2] - x[1]]
    )
    dae = mj.reduce_dae(network, jnp.zeros(3), jnp.asarray(1.0))
    assert (dae.report.index, dae.report.degrees_of_freedom) == (2, 0)
    z, _ = dae.consistent_state(0.0, jnp.zeros(3), jnp.asarray(2.0))
    np.testing.assert_allclose(
        dae.outputs(0.0, z, jnp.asarray(2.0))[0], [2.0, 0.0, 2.0], atol=1e-15
    )


def test_combinations_of_a_circuit():
    """The transistor amplifier of the test set as it is written, three combinations."""
    dae = mj.reduce_dae(models.transistor, jnp.array([0.0, 3, 3, 6, 3, 3, 6, 0]))
    assert (dae.report.index, dae.report.degrees_of_freedom, dae.report.num_constraints) == (
        1,
        5,
        3,
    )


@pytest.mark.parametrize("pairs", [1, 2])
def test_combination_of_varying_coefficients(pairs):
    """A capacitance that depends on its voltage: `exp(u) (u' - v')` is added and subtracted, so
    `u + v = 0` and `u' = -u exp(-u) / 2`; two pairs need two combinations."""

    def charged(t, x, xdot, a):
        u, v = x
        into = jnp.exp(a * u) * (xdot[0] - xdot[1])
        return jnp.stack([into + u, -into + v])

    dae = mj.reduce_dae(charged, jnp.ones((2, pairs)), jnp.asarray(1.0))
    assert (dae.report.index, dae.report.degrees_of_freedom) == (1, pairs)
    a, z = (
        jnp.asarray(0.8),
        dae.consistent_state(0.0, jnp.full((2, pairs), 0.3), jnp.asarray(0.8))[0],
    )
    u, v = dae.outputs(0.0, z, a)[0]
    np.testing.assert_allclose(v, -u, rtol=1e-15)
    rates = dae.outputs(0.0, z, a)[1]
    np.testing.assert_allclose(rates[0], -u * jnp.exp(-a * u) / 2, rtol=1e-13)


def ring_modulator(t, y, rate, a):
    """Without the capacitors across its diodes: their currents are determined by an equation that
    is hidden in four, index 2 (Rentrop, Roche and Steinebach, Numer. Math. 55 (1989) 545-563)."""
    C, R, Cp, Rp, Lh, Ls1, Ls2 = 1.6e-8, 25e3, 1e-8, 50.0, 4.45, 2e-3, 5e-4
    current = lambda u: 40.67286402e-9 * jnp.expm1(17.7493332 * u)
    u1, u2 = 0.5 * jnp.sin(2e3 * jnp.pi * t), 2 * jnp.sin(2e4 * jnp.pi * t)
    (v1, v2, v3, v4, v5, v6, v7), (i1, i2, i3, i4, i5, i6, i7, i8) = y[:7], y[7:]
    q1, q2 = current(v3 - v5 - v7 - u2), current(-v4 + v6 - v7 - u2)
    q3, q4 = current(v4 + v5 + v7 + u2), current(-v3 - v6 + v7 + u2)
    return jnp.stack(
        [
            C * rate[0] - (i1 - 0.5 * i3 + 0.5 * i4 + i7 - v1 / R),
            C * rate[1] - (i2 - 0.5 * i5 + 0.5 * i6 + i8 - v2 / R),
            *(i3 - q1 + q4, -i4 + q2 - q3, i5 + q1 - q3, -i6 - q2 + q4),
            Cp * rate[6] - (-v7 / Rp + q1 + q2 - q3 - q4),
            *(Lh * rate[7] + v1, Lh * rate[8] + v2),
            Ls2 * rate[9] - (0.5 * v1 - v3 - 17.3 * i3),
            Ls2 * rate[10] - (-0.5 * v1 + v4 - 17.3 * i4),
            Ls2 * rate[11] - (0.5 * v2 - v5 - 17.3 * i5),
            Ls2 * rate[12] - (-0.5 * v2 + v6 - 17.3 * i6),
            Ls1 * rate[13] - (-v1 + u1 - 86.3 * i7),
            Ls1 * rate[14] - (-v2 - 636.3 * i8),
        ]
    )


@pytest.mark.slow
def test_ring_modulator():
    """Problem `ring modulator` of Mazzia & Magherini, Test Set for Initial Value Problem Solvers
    (2008): of index 2 for `Cs = 0`. Against SciPy's Radau at 1e-7 with capacitors of 2e-12 and
    2e-13, extrapolated to none: the voltages and the current that do not oscillate for longer the
    smaller the capacitors are."""
    dae = mj.reduce_dae(ring_modulator, jnp.zeros(15), form="index-1")
    assert (dae.report.index, dae.report.degrees_of_freedom) == (2, 10)
    assert "F[2] - F[3] + F[4] - F[5]" in dae.report.equations
    z0, _ = dae.consistent_state(0.0, jnp.zeros(15))
    sol = mj.diffeqsolve(
        *(dae.terms, mj.Projected(mj.Rodas5P(), dae.constraint), 0.0, 2e-4, None, z0),
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
        max_steps=10_000,
    )
    y, _ = dae.outputs(2e-4, sol.ys[-1])
    small = np.array([4.58085225e-01, 3.26378027e-01, 1.11708884e-01, 5.73766943e-04])
    smaller = np.array([4.58090967e-01, 3.26385209e-01, 1.11705336e-01, 5.73772416e-04])
    np.testing.assert_allclose(
        y[jnp.array([0, 1, 6, 13])], smaller + (smaller - small) / 9, rtol=1e-5
    )
    assert mj.constraint_violation(dae.constraint, 2e-4, sol.ys[-1]) < 1e-15


def refused_only_here(t, x, xdot, a):
    """Cancels for `a = 1`, not for other parameters."""
    return jnp.stack([a * (xdot[0] - xdot[1]) + x[0], xdot[1] - xdot[0] + x[1]])


def refused_as_it_has_no_gradient(t, x, xdot, a):
    """What cancels comes out of a loop."""
    once = lambda s: (s[0] + 1, 1.1 * s[1])
    into = jnp.exp(x[0]) * (xdot[0] - xdot[1])
    into = jax.lax.while_loop(lambda s: s[0] < 2, once, (0, into))[1]
    return jnp.stack([into + x[0], -into + x[1]])


def refused_as_it_varies(t, x, xdot, a):
    """It cancels at one time only."""
    into = xdot[0] - xdot[1]
    return jnp.stack([into * jnp.cos(t) + x[0], -into + x[1]])


def refused_only_without_it(t, x, xdot, a):
    """Cancels where `a` is zero, as in the example."""
    return jnp.stack([(1 + a) * xdot[0] - xdot[1] + x[0], xdot[1] - xdot[0] + x[1]])


@pytest.mark.parametrize(
    ("F", "a"),
    [
        (refused_only_here, 1.0),
        (refused_as_it_varies, 1.0),
        (refused_as_it_has_no_gradient, 1.0),
        (refused_only_without_it, 0.0),
    ],
)
def test_other_cancellations_are_refused(F, a):
    with pytest.raises(ValueError, match=r"`F\[0\]`, `F\[1\]` depend on each other"):
        mj.reduce_dae(F, jnp.ones(2), jnp.asarray(a))


# Unknowns that are higher derivatives than any in the other equations


def test_outputs_beyond_the_leading_derivatives():
    """A prescribed motion, its speed, acceleration and jerk, by name: nothing but outputs."""

    def motion(t, x, xdot, a):
        position, speed, acceleration, jerk = x
        rates = xdot[:3] - jnp.stack([speed, acceleration, 2 * jerk])
        return jnp.concatenate([rates, (position - jnp.sin(a * t))[None]])

    dae = mj.reduce_dae(motion, jnp.ones(4), jnp.asarray(1.0))
    t, a = 0.7, jnp.asarray(1.5)
    z, _ = dae.consistent_state(t, jnp.zeros(4), a)
    x, rates = jax.jit(dae.outputs)(t, z, a)
    s, c = np.sin(1.5 * t), np.cos(1.5 * t)
    np.testing.assert_allclose(x, [s, 1.5 * c, -(1.5**2) * s, -(1.5**3) * c / 2], rtol=1e-14)
    np.testing.assert_allclose(rates[3], 1.5**4 * s / 2, rtol=1e-14)


# Equations of index 1 for Rosenbrock methods


def solve(dae, z0, args, **options):
    control = dfx.PIDController(rtol=1e-9, atol=1e-9)
    solver = mj.Rodas5P()
    if dae.report.num_constraints > 0:
        solver = mj.Projected(solver, dae.constraint)
    return mj.diffeqsolve(
        *(dae.terms, solver, 0.0, 1.0, None, z0, args),
        **dict(stepsize_controller=control, **options),
    ).ys[-1]


@pytest.mark.slow
def test_index_one():
    args, guess = jax.tree.map(jnp.asarray, models.DIODE_ARGS), jnp.array([0.3, 0.2, 0.0])
    ends = {}
    for form in ("ode", "index-1"):
        dae = mj.reduce_dae(models.diode, guess, args, form=form)

        def end(args, dae=dae):
            z0, _ = dae.consistent_state(0.0, guess, args)
            return dae.outputs(1.0, solve(dae, z0, args), args)[0]

        ends[form] = jax.jit(jax.value_and_grad(lambda args, end=end: end(args)[0]))(args)
    assert isinstance(dae.terms, mj.MassMatrixTerm)
    assert len(dae.report.states) == 4
    assert dae.report.lifted == ()
    np.testing.assert_allclose(ends["ode"][0], ends["index-1"][0], rtol=1e-8)
    for name, gradient in ends["ode"][1].items():
        np.testing.assert_allclose(gradient, ends["index-1"][1][name], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("solver", "most_steps"), [(mj.Rodas5P(), 750), (mj.RadauIIA5(), 450)])
def test_derivatives_do_not_count_in_the_error(solver, most_steps):
    """A rectifier: the derivative of the voltage of its capacitor is thousands of times as large as the voltage and
    passes through zero, where rounding alone made more errors in it than the tolerance of the voltages. Kirchhoff's
    law for the diode and the resistance of the source, solved by Wright's function, leaves an ODE."""
    saturation, thermal, load, C = 1e-14, 0.025, 1e3, 1e-6
    source = lambda t: 10 * jnp.sin(314 * t)
    diode = lambda v: saturation * jnp.expm1(v / thermal)

    def F(t, x, xdot, _):
        through = diode(x["a"] - x["p"])
        return source(t) - x["a"] - through, C * xdot["p"] + x["p"] / load - through

    start = {"a": 0.0, "p": 0.0}
    dae = mj.reduce_dae(F, start, form="index-1")
    assert dae.report.states == ("p", "a", "p'")
    z0, _ = dae.consistent_state(0.0, start, fixed=("p",))
    ts = jnp.linspace(0.0, 8e-3, 5)
    sol = mj.diffeqsolve(
        dae.terms,
        solver,
        0.0,
        8e-3,
        None,
        z0,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-11),
    )

    def by_hand(t, p):
        argument = (source(t) - p + saturation) / thermal + np.log(saturation / thermal)
        through = thermal * scipy.special.wrightomega(float(argument[0])) - saturation
        return (through - p / load) / C

    reference = scipy.integrate.solve_ivp(
        by_hand, (0.0, 8e-3), [0.0], "LSODA", np.asarray(ts), rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(sol.ys[:, 0], reference.y[0], atol=2e-7)
    assert sol.stats["num_steps"] < most_steps
    # Derivatives are what follows from the equations, not what the steps left: errors of 1e-7 A before.
    x, xdot = dae.outputs(ts, sol.ys)
    law = jax.vmap(F, (0, 0, 0, None))(ts, x, xdot, None)
    np.testing.assert_allclose(jnp.stack(law), 0, atol=1e-14)


def test_derivatives_in_which_equations_are_nonlinear_count():
    """Friction that saturates: the stages of a step need the derivative."""
    friction = lambda t, x, xdot, a: xdot + 1e-3 * jnp.arcsinh(1e6 * xdot) + x - jnp.cos(20 * t)
    dae = mj.reduce_dae(friction, jnp.zeros(()), form="index-1")
    error = jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(dae.terms.counted_error(error), error)


def test_index_one_on_the_manifold():
    args = jax.tree.map(jnp.asarray, models.PENDULUM_ARGS)
    guess = jnp.array([1.3, 0.5, 0.6, -0.3, 0.0])
    dae = mj.reduce_dae(models.pendulum, guess, args, form="index-1")
    z0, info = dae.consistent_state(0.0, guess, args)
    assert info.success
    x, xdot = dae.outputs(0.0, z0, args)
    np.testing.assert_allclose(models.pendulum(0.0, x, xdot, args), 0, atol=1e-13)
    z = solve(dae, z0, args)
    assert mj.constraint_violation(dae.constraint, 1.0, z, args) < 1e-14


def test_forms(as_a_user_meets_it):
    with pytest.raises(ValueError, match="`form` must be 'ode' or 'index-1', got 'index-3'"):
        mj.reduce_dae(models.rlc_series, jnp.ones(4), models.RLC_ARGS, form="index-3")


def test_equations_that_need_their_multiplier():
    """Friction of the size of the multiplier: not defined for one of zero, which the equation of
    the state does not have."""

    def sliding(t, x, xdot, a):
        q, v, force = x["q"], x["v"], x["force"]
        size = jnp.sqrt(force**2)
        drag = a * size * v / jnp.sqrt(v @ v)
        normal = jnp.array([0.0, 1.0])
        motion = xdot["v"] - jnp.array([1.0, -9.81]) - force * normal + drag
        return {"kinematics": xdot["q"] - v, "motion": motion, "floor": q[1]}

    start = {"q": jnp.array([0.0, 0.0]), "v": jnp.array([1.0, 0.0]), "force": jnp.asarray(9.0)}
    a = jnp.asarray(0.2)
    dae = mj.reduce_dae(sliding, start, a, form="index-1")
    y, info = dae.consistent_state(0.0, start, a)
    assert info.success
    np.testing.assert_allclose(dae.outputs(0.0, y, a)[0]["force"], 9.81, rtol=1e-12)
    _, xdot = dae.outputs(0.0, y, a)
    np.testing.assert_allclose(xdot["v"][0], 1 - 0.2 * 9.81, rtol=1e-12)
    without_force = y.at[4].set(0.0)
    slopes = jax.jacrev(lambda y: dae.constraint(0.0, y, a))(without_force)
    np.testing.assert_allclose(slopes @ y, [y[1], y[3]], atol=1e-15)
