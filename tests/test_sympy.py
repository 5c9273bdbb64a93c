"""Models of SymPy: the same equations as by hand, on the manifold, differentiable, and what is refused."""

import functools
import importlib.util
import re
import sys
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy_models import (
    disc_by_kane,
    four_bar_by_lagrange,
    pendulum_by_kane,
    pendulum_by_lagrange,
)

import manifold_jax as mj


sys.path.append(str(Path(__file__).parents[1]))

FOUR_BAR = dict(l1=0.4, l2=1.1, l3=0.9, m1=0.5, m2=1.5, m3=0.7, d=1.0, g=9.81)
PENDULUM = dict(m=1.3, g=9.81, length=0.8)


def assert_close(found, expected, tolerance=1e-12):
    found, expected = (jax.flatten_util.ravel_pytree(x)[0] for x in (found, expected))
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def motion(model, t, y, args):
    """Field, constraint and multipliers, compiled together."""
    mechanics = getattr(model, "mechanics", model)
    forces = None if mechanics is None else mechanics.multipliers

    @jax.jit
    def all_of_them(t, y, args):
        of_forces = () if forces is None else forces(t, y, args)
        return model.terms.vf(t, y, args), model.constraint(t, y, args), of_forces

    return all_of_them(t, y, args)


def four_bar_by_hand():
    """From the Lagrangian in JAX."""

    def centers(q, p):
        lengths = jnp.stack([p["l1"], p["l2"], p["l3"]])
        along = lengths[:, None] * jnp.stack([jnp.cos(q), jnp.sin(q)], axis=1)
        ends = jnp.cumsum(along, axis=0)
        return ends - along / 2, ends[-1]

    def lagrangian(t, q, v, p):
        masses, lengths = (jnp.stack([p[f"{x}{i}"] for i in (1, 2, 3)]) for x in "ml")
        place, velocity = jax.jvp(lambda q: centers(q, p)[0], (q,), (v,))
        kinetic = masses @ jnp.sum(velocity**2, axis=1) + masses @ (lengths * v) ** 2 / 12
        return kinetic / 2 - p["g"] * masses @ place[:, 1]

    closed = lambda t, q, p: centers(q, p)[1] - jnp.stack([p["d"], 0.0 * p["d"]])
    torque = lambda t, q, v, p: jnp.stack([jnp.sin(t) + 0.1 * v[0], 0.0, 0.0])
    return mj.MechanicalSystem.from_lagrangian(lagrangian, closed, torque)


def test_a_four_bar_linkage_by_lagranges_method_is_that_by_hand():
    torque = me.dynamicsymbols("T")
    method = four_bar_by_lagrange(torque)
    model = mj.from_sympy(method, inputs={torque: lambda t, y, args: jnp.sin(t) + 0.1 * y[1][0]})
    hand, args = four_bar_by_hand(), {k: jnp.asarray(x) for k, x in FOUR_BAR.items()}
    y = jnp.array([0.9, 0.2, -1.3]), jnp.array([0.7, -1.1, 0.4])  # not on the manifold
    assert model.coordinates == ("a", "b", "c")
    assert model.speeds == ("a'", "b'", "c'")
    assert_close(motion(model, 0.3, y, args), motion(hand, 0.3, y, args))
    # Corrections in the same metric, and a start as the nearest state.
    off = (jnp.array([1.0, 0.3, -1.6]), jnp.array([1.0, 0.0, 0.0]))
    start = model.state({"a": 1.0, "b": 0.3, "c": -1.6, "a'": 1.0}, args)
    assert_close(start, mj.consistent_state(hand.constraint, 0.0, off, args)[0])
    assert mj.constraint_violation(model.constraint, 0.0, start, args) < 1e-15


def test_lagranges_and_kanes_pendulum_are_that_by_hand():
    weight = lambda t, q, v, p: p["m"] * jnp.stack([0 * p["g"], -p["g"]])
    rod = lambda t, q, p: q @ q - p["length"] ** 2
    hand = mj.MechanicalSystem(lambda q, p: p["m"], rod, weight)
    args = {k: jnp.asarray(x) for k, x in PENDULUM.items()}
    lagrange, kane = mj.from_sympy(pendulum_by_lagrange()), mj.from_sympy(pendulum_by_kane())
    y = lagrange.state({"x": 0.5, "y": -0.5, "x'": 1.0}, args)
    expected = motion(hand, 0.0, y, args)
    assert_close(motion(lagrange, 0.0, y, args), expected)
    assert_close(motion(kane, 0.0, y, args)[0], expected[0])
    assert kane.mechanics is None


def test_kanes_dependent_numbers_are_solved_for_and_the_others_stay():
    model = mj.from_sympy(pendulum_by_kane())
    x, u = (model.model.q[0], model.model.u[0])
    height = lambda length: model.state({x: 0.3, u: 2.0, "y": -1.0}, dict(PENDULUM, length=length))
    (q, v), L = height(0.8), 0.8
    y = -np.sqrt(L**2 - 0.3**2)
    assert_close((q, v), ([0.3, y], [2.0, -0.3 * 2.0 / y]), 1e-14)
    assert (q[0], v[0]) == (0.3, 2.0)
    slope = jax.grad(lambda L: height(L)[0][1])
    assert_close(slope(L), L / y)
    assert_close(jax.grad(slope)(L), 1 / y - L**2 / y**3)
    assert_close(jax.vmap(height)(jnp.array([0.8, 0.9]))[0][0], q)


@pytest.fixture(scope="module")
def disc():
    return mj.from_sympy(disc_by_kane()), mj.problems.rolling_disc()


def to_gallery(y):
    """Kane's speeds are sorted: independent ones first."""
    q, u = y
    return q, jnp.stack([u[..., 2], u[..., 3], u[..., 0], u[..., 1]], axis=-1)


def test_a_rolling_disc_by_kanes_method_is_that_of_the_gallery_and_so_are_its_gradients(disc):
    model, gallery = disc
    hook = mj.Projected(dfx.Dopri8(), model.constraint)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def end(args):
        y0 = model.state({"heading": 0.4, "turning": 1.5, "spin": 2.0}, args)
        sol = mj.diffeqsolve(model.terms, hook, 0.0, 2.0, 0.1, y0, args)
        q, u = y = jax.tree.map(lambda x: x[-1], sol.ys)
        return q[0] + 2 * q[1] + 3 * u[1], y

    (_, y), gradient = end(gallery.args)  # a named tuple
    assert_close(to_gallery(y), gallery.reference(2.0), 1e-9)
    assert mj.constraint_violation(model.constraint, 2.0, y, gallery.args) < 1e-15
    h, values = 1e-4, np.array(gallery.args)
    at = lambda values: float(end(type(gallery.args)(*values))[0][0])
    differences = [
        (8 * (at(values + e) - at(values - e)) - at(values + 2 * e) + at(values - 2 * e)) / (12 * h)
        for e in h * np.eye(len(values))
    ]
    np.testing.assert_allclose(np.array(gradient), differences, rtol=1e-7, atol=1e-8)
    # All but the steering inertia matter.
    assert np.count_nonzero(np.abs(differences) > 1e-3) == len(values) - 1


def test_kinematic_equations_that_are_not_solved(disc):
    model, gallery = disc
    y = jnp.array([0.1, 0.2, 0.4, 0.7]), jnp.array([1.5, 2.0, 0.3, 0.4])
    implicit = mj.from_sympy(disc_by_kane(explicit=False))
    assert_close(motion(implicit, 0.0, y, gallery.args), motion(model, 0.0, y, gallery.args))


def test_second_derivatives_and_batches_of_the_field(disc):
    model, gallery = disc
    y = jnp.array([0.1, 0.2, 0.4, 0.7]), jnp.array([1.5, 2.0, 0.3, 0.4])
    spin = lambda R, y=y: model.terms.vf(0.0, y, gallery.args._replace(radius=R))[1][1]
    R, m, J, pull = 0.5, 1.0, 0.125, 9.81 * np.sin(0.3) * np.cos(0.4)
    # On the manifold or off, spin' = m R g sin(slope) cos(heading) / (J + m R^2).
    total = J + m * R**2
    value, curvature = jax.jit(lambda R: (spin(R), jax.hessian(spin)(R)))(R)
    assert_close(value, R * pull / total)
    assert_close(curvature, pull * (2 * R**3 - 6 * R * J) / total**3)
    many = jax.jit(jax.vmap(spin, (None, 0)))(R, jax.tree.map(lambda x: jnp.stack([x, x + 1]), y))
    assert_close(many[0], value)


def test_inputs_may_move_what_the_constraints_hold():
    """A pendulum whose pivot moves, by Lagrange's method with the input `s(t)` and its derivatives."""
    x, y, s = me.dynamicsymbols("x y s")
    v = [c.diff() for c in (x, y)]
    rod = (x - s) ** 2 + y**2 - 1
    method = me.LagrangesMethod((v[0] ** 2 + v[1] ** 2) / 2 - 9.81 * y, [x, y], hol_coneqs=[rod])
    method.form_lagranges_equations()
    t = me.dynamicsymbols._t
    moves = {
        s: lambda t, y, args: args["size"] * jnp.sin(t),
        s.diff(t): lambda t, y, args: args["size"] * jnp.cos(t),
        s.diff(t, 2): lambda t, y, args: -args["size"] * jnp.sin(t),
    }
    model, args = mj.from_sympy(method, inputs=moves), {"size": jnp.asarray(0.3)}
    held = lambda t, q, p: (q[0] - p["size"] * jnp.sin(t)) ** 2 + q[1] ** 2 - 1
    hand = mj.MechanicalSystem(1.0, held, lambda t, q, v, p: jnp.array([0.0, -9.81]))
    state = model.state({x: 0.5, y: -0.8, x.diff(): 1.0}, args, t=0.4)
    assert model.mechanics is None
    field, residual, _ = motion(model, 0.4, state, args)
    assert_close(field, motion(hand, 0.4, state, args)[0], 1e-11)
    assert_close(residual, [0.0, 0.0], 1e-14)


def test_without_constraints_the_hook_is_the_solver_alone():
    q, (g, L) = me.dynamicsymbols("q"), sm.symbols("g L")
    method = me.LagrangesMethod(L**2 * q.diff() ** 2 / 2 + g * L * sm.cos(q), [q])
    method.form_lagranges_equations()
    model, args = mj.from_sympy(method), {"g": 9.81, "L": 2}
    y = model.state({q: 0.3}, args)
    hook = mj.Projected(dfx.Euler(), model.constraint)
    end = mj.diffeqsolve(model.terms, hook, 0.0, 0.1, 0.1, y, args).ys
    assert_close(end, ([[0.3]], [[-0.981 / 2 * np.sin(0.3)]]))


def test_expressions_are_functions(disc):
    model, gallery = disc
    heading, spin = model.model.q[2], model.model.u[1]
    radius = sm.Symbol("radius")
    y = (np.arange(4.0), np.arange(4.0))
    vector = model.function(sm.Matrix([radius * spin, sm.cos(heading)]))
    assert_close(vector(0.0, y, gallery.args), [0.5, np.cos(2.0)])
    assert model.function(spin**2)(0.0, y, gallery.args).shape == ()
    assert model.function(sm.eye(2))(0.0, y, gallery.args).shape == (2, 2)
    with refused(ValueError, "`expression` contains Derivative(heading(t), t), which is neither"):
        model.function(heading.diff())


def test_special_functions_and_their_derivatives():
    """Against `mpmath`."""
    x = me.dynamicsymbols("x")
    method = me.LagrangesMethod(x.diff() ** 2 / 2 - sm.erf(x), [x])
    method.form_lagranges_equations()
    model, y = mj.from_sympy(method), (np.array([0.7]), np.zeros(1))
    assert_close(model.terms.vf(0.0, y, {})[1], [-2 / np.sqrt(np.pi) * np.exp(-0.49)])
    functions = [sm.erf, sm.erfc, sm.erfinv, sm.gamma, sm.loggamma, sm.factorial, sm.Ei]
    values = [f(x) for f in functions] + [f(x).diff(x) for f in functions]
    expected = [float(value.subs(x, sm.Float("0.7", 30)).evalf()) for value in values]
    assert_close(model.function(sm.Matrix(values))(0.0, y, {}), expected)
    below = np.array([-1.3]), np.zeros(1)
    assert_close(
        model.function(sm.factorial(x))(0.0, below, {}), float(sm.gamma(sm.Float("-0.3", 30)))
    )
    with refused(ValueError, "contain `besselj`, `zeta`, for which there is no function of JAX"):
        model.function(sm.besselj(0, x) + sm.zeta(x))


def test_single_precision_stays_single(disc):
    model, gallery = disc
    y = jax.tree.map(jnp.float32, (jnp.arange(4.0), jnp.arange(4.0)))
    args = {name: jnp.float32(x) for name, x in gallery.args._asdict().items()}
    both = jax.eval_shape(
        lambda y: (model.terms.vf(0.0, y, args), model.constraint(0.0, y, args)), y
    )
    assert {x.dtype for x in jax.tree.leaves(both)} == {jnp.dtype(jnp.float32)}


def test_a_singular_mass_matrix_gives_nan():
    """Of rank one to rounding, where an elimination finds finite numbers."""
    x, y = me.dynamicsymbols("x y")
    a, b, c = sm.symbols("a b c")
    kinetic = (a * x.diff() ** 2 + b * y.diff() ** 2) / 2 + c * x.diff() * y.diff()
    method = me.LagrangesMethod(kinetic - x, [x, y])
    method.form_lagranges_equations()
    field, state = jax.jit(mj.from_sympy(method).terms.vf), (jnp.ones(2), jnp.ones(2))
    assert jnp.isnan(field(0.0, state, dict(a=0.1, b=0.3, c=np.sqrt(0.03)))[1]).all()
    assert_close(field(0.0, state, dict(a=0.1, b=0.3, c=0.0))[1], [-10.0, 0.0])


def refused(error, message):
    return pytest.raises(error, match=re.escape(message))


def test_methods_that_cannot_be_used():
    x, y, f = me.dynamicsymbols("x y f")
    m = sm.Symbol("m")
    unformed = me.LagrangesMethod(m * x.diff() ** 2, [x])
    with refused(ValueError, "Call `method.form_lagranges_equations()` before"):
        mj.from_sympy(unformed)
    N, P = me.ReferenceFrame("N"), me.Point("P")
    u, v = me.dynamicsymbols("u v")
    P.set_vel(N, u * N.x)
    kane = me.KanesMethod(N, [x], [u], [x.diff() - u])
    with refused(ValueError, "Call `method.kanes_equations(bodies, loads)` before"):
        mj.from_sympy(kane)
    with refused(TypeError, "`method` must be a `KanesMethod` or a `LagrangesMethod`"):
        mj.from_sympy(kane.mass_matrix_kin)
    held = me.KanesMethod(
        N,
        [x],
        [u, v],
        [x.diff() - u, y.diff() - v],
        q_dependent=[y],
        configuration_constraints=[x - y],
    )
    held.kanes_equations([me.Particle("p", P, m)], [(P, N.x)])
    with refused(ValueError, "1 `configuration_constraints`, but 0 `velocity_constraints`"):
        mj.from_sympy(held)

    def formed(lagrangian):
        method = me.LagrangesMethod(lagrangian, [x])
        method.form_lagranges_equations()
        return method

    kinetic = m * x.diff() ** 2
    with refused(ValueError, "contain f(t), which is neither a coordinate nor a speed"):
        mj.from_sympy(formed(kinetic + f * x))
    with refused(ValueError, "`inputs` has y(t), which the equations do not contain"):
        mj.from_sympy(formed(kinetic), inputs={y: lambda t, y, args: t})
    with refused(TypeError, "`inputs[f(t)]` must be a callable `x(t, y, args)`"):
        mj.from_sympy(formed(kinetic + f * x), inputs={f: 1.0})
    with refused(ValueError, "several symbols of the name m"):
        mj.from_sympy(formed(kinetic + sm.Symbol("m", positive=True) * x))
    with refused(ValueError, "a function without a definition"):
        mj.from_sympy(formed(kinetic + sm.Function("h")(x)))


def test_values_that_cannot_be_used(disc):
    model, gallery = disc
    args, y = gallery.args._asdict(), (jnp.zeros(4), jnp.zeros(4))
    args.pop("gravity")
    with refused(ValueError, "`args` has no value for gravity"):
        model.terms.vf(0.0, y, args)
    with refused(ValueError, "`values` has no number for gravity"):
        model.args(args)
    with refused(ValueError, "do not contain k"):
        model.args({sm.Symbol("k"): 1.0, **args})
    with refused(ValueError, "`args` for gravity must be one number"):
        model.terms.vf(0.0, y, dict(args, gravity=jnp.ones(3)))
    with refused(ValueError, "`y` must be the pair `(q, u)`"):
        model.terms.vf(0.0, (jnp.zeros(4), jnp.zeros(3)), gallery.args)
    with refused(ValueError, "`values` has height, which is neither"):
        model.state({"height": 1.0}, gallery.args)
    assert model.args({sm.Symbol("gravity"): 9.81, **args}).keys() == gallery.args._asdict().keys()
    with refused(eqx.EquinoxRuntimeError, "`y` could not be made consistent"):
        mj.from_sympy(pendulum_by_kane()).state({"x": 2.0, "y": 1.0}, PENDULUM)


def test_sympy_is_an_extra(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with refused(ImportError, "`mj.from_sympy` needs sympy, which is not installed"):
        mj.from_sympy(None)


@pytest.mark.slow
def test_the_rattleback_and_the_bicycle_are_the_published_ones():
    from benchmarks.sympy_models import __main__ as program, bicycle, rattleback

    start = lambda model, args: model.state(rattleback.START, args)
    motion = program.move(rattleback.kanes_method, rattleback.PARAMETERS, start)
    results = program.of_rattleback(motion)
    assert results["difference from the published equations"] < 1e-4
    assert motion.column("w3")[0] == -5.0
    assert motion.column("w3")[-1] > 1.0
    assert motion.violation < 1e-15
    assert results["largest gain of energy between saved values, J"] < 0
    leaning = lambda model, args: bicycle.straight_ahead(model, args, 5.0, u_lean=0.3)
    motion = program.move(bicycle.kanes_method, bicycle.PARAMETERS, leaning)
    found = bicycle.eigenvalues(motion.model, motion.args, program.SPEEDS)
    results = program.of_bicycle(motion, found)
    assert results["largest difference from the published eigenvalues, 1/s"] < 1e-11
    on_manifold = motion.model.constraint, motion.times, motion.states, motion.args
    assert mj.constraint_violation(*on_manifold) < 1e-15
    assert motion.violation < 4e-15  # m/s; the terms are 5 m/s, in units of 9e-16
    assert results["relative drift of the energy"] < 1e-7
    assert abs(results["lean at the end, rad"]) < 0.01
