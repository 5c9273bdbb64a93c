"""Every derivative rule of the library's own, differentiated once and twice, in all orders of modes,
alone, compiled, inside of loops and in batches, next to finite differences."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from variants import variants

import manifold_jax as mj
from manifold_jax._applications.following import kernel
from manifold_jax._base.closure import convert_closure
from manifold_jax._base.derivative_rule import apply_linear, ForwardRule
from manifold_jax._base.known_value import known_value
from manifold_jax._linalg.dense import factorize, factorize_once, pseudo_invert
from manifold_jax._linalg.newton import root_of_step
from manifold_jax._linalg.pivoted import (
    factorize_by_reduction,
    factorize_equilibrated,
    factorize_pivoted,
)
from manifold_jax._solver.step.explicit import derivative_once


def matrix(a, n):
    """Symmetric and positive definite."""
    x = jnp.arange(n * n, dtype=float).reshape(n, n)
    A = jnp.sin(9 * x * a / n**2) + 0.3 * x / n**2
    return A @ A.T / n + jnp.eye(n) * (1 + a**2)


def vector(a, n):
    return jnp.cos(a * jnp.arange(1.0, n + 1))


def total(x):
    return jnp.sum(x * jnp.sin(jnp.arange(1.0, x.size + 1)))


def solved(factorized, n):
    return lambda a: total(factorized(matrix(a, n)).solve(vector(a, n)))


def pseudo_inverse(a):
    """Of the third equation twice."""
    A = matrix(a, 3)
    rows = jnp.array([0, 1, 2, 2])
    return total(pseudo_invert(A[rows][:, rows]).solve(vector(a, 3)[rows]))


def cube_root(a):
    step = convert_closure(lambda x: -(x**3 - a) / (3 * x**2), a)
    return root_of_step(step, jax.lax.stop_gradient(a) ** (1 / 3)) ** 2


def known(a):
    f = lambda x: jnp.sin(a * x) * x
    return known_value(f, f(vector(a, 3)), vector(a, 3))


def planar(t, q, a):
    return q @ q - a["length"] ** 2


def pushed(t, q, v, a):
    return jnp.stack([0.3 * a["push"] * q[1], -a["gravity"] - 0.1 * v[1] ** 2])


PARAMETERS = {"length": 1.0, "gravity": 9.81, "push": 0.5, "mass": 1.3}
STATE = jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6])
SYSTEM = mj.MechanicalSystem(lambda q, a: a["mass"] * (1 + q[0] ** 2), planar, pushed)
TWICE = lambda t, y, a: jnp.stack([y @ y - a, 2 * (y @ y) - 2 * a])


def with_all(a):
    return {
        name: value * (1 + (a - 1) / (k + 1)) for k, (name, value) in enumerate(PARAMETERS.items())
    }


def swinging(t, x, xdot, a):
    q, v, force = x["q"], x["v"], x["force"]
    pull = -force * q - jnp.stack([0 * a, 9.81 * a])
    return xdot["q"] - v, xdot["v"] - pull, q @ q - 1


GUESS = {"q": STATE[0], "v": STATE[1], "force": jnp.asarray(1.0)}
DAE = mj.reduce_dae(swinging, GUESS, jnp.asarray(1.0))
DAE1 = mj.reduce_dae(swinging, GUESS, jnp.asarray(1.0), form="index-1")
Z = jnp.array([0.6, -0.8, 0.8, 0.6])
MASS_TERM = mj.MassMatrixTerm(
    lambda t, y, a: jnp.stack([-a * y[1] * y[0], y[1] ** 3 - a * y[0] - 1]), jnp.array([1.0, 0.0])
)


def moved(a):
    return Z + (a - 1) * jnp.array([0.9, 0.4, -0.7, 0.8])


def corrected(constraint, y, far):
    correct = mj.consistent_state if far else mj.project
    return lambda a: total(jax.tree.leaves(correct(constraint, 0.0, y, a)[0])[0])


CURVED = mj.Constraint(lambda t, y, a: jnp.stack([y @ y - a, y[0] * y[1] * a - 0.3]))
POINT = jnp.array([0.7, 0.5, 0.6])


RULES = {
    "elimination without exchanges": solved(factorize, 3),
    "elimination in loops": solved(factorize, 7),
    "of the library": solved(factorize, 10),
    "inverse": solved(factorize_once, 4),
    "elimination with exchanges": solved(factorize_by_reduction, 4),
    "pivoted, few": solved(factorize_equilibrated, 3),
    "pivoted, many": solved(factorize_equilibrated, 10),
    "stages of Rosenbrock methods": solved(factorize_pivoted, 3),
    "pseudo-inverse": pseudo_inverse,
    "derivative_once": lambda a: total(derivative_once(vector(a, 3) ** 2, vector(a, 3))),
    "root of a step": cube_root,
    "known value": lambda a: total(known(a)),
    "tangent of a curve": lambda a: total(kernel(matrix(a, 3)[:2])),
    "correction": corrected(CURVED, POINT, False),
    "consistent state": corrected(CURVED, POINT, True),
    "redundant correction": corrected(mj.Constraint(TWICE, redundant=True), POINT, False),
    "mechanical correction": lambda a: total(
        mj.consistent_state(SYSTEM.constraint, 0.0, (moved(a)[:2], STATE[1]), with_all(a))[0][1]
    ),
    "accelerations": lambda a: total(SYSTEM.accelerations(0.0, STATE, with_all(a))),
    "reduced DAE": lambda a: total(DAE.terms.vf(0.0, moved(a), a)),
    "start of a reduced DAE": lambda a: total(
        DAE.consistent_state(0.0, {**GUESS, "q": moved(a)[:2]}, a)[0]
    ),
    "start of index 1": lambda a: total(
        DAE1.consistent_state(0.0, {**GUESS, "q": moved(a)[:2]}, a)[0]
    ),
    "start with a mass matrix": lambda a: total(
        MASS_TERM.consistent_state(0.0, jnp.array([1.0, 1.2]), a)[0]
    ),
}


def alone(f):
    return f


def in_scan(f):
    step = lambda c, _: (c + 0.1 * jnp.sin(f(c)), None)
    return lambda a: jax.lax.scan(step, a, None, length=2)[0]


def in_batch(f):
    return lambda a: jnp.sum(jax.vmap(f)(jnp.stack([a, 1.01 * a])))


def in_while_loop(f):
    """Which has forward mode alone."""
    step = lambda c: (c[0] + 1, c[1] + 0.1 * jnp.sin(f(c[1])))
    return lambda a: jax.lax.while_loop(lambda c: c[0] < 2, step, (0, a))[1]


def forwards(f):
    return lambda a: jax.jvp(f, (a,), (jnp.ones_like(a),))[1]


def check(f, at, compiled=True, reverse=True):
    """First and second derivatives in every order of modes against differences of sixth order."""
    first = {"forward": forwards(f)} | ({"reverse": jax.grad(f)} if reverse else {})
    second = {"forward, forward": forwards(forwards(f))}
    if reverse:
        second |= {
            "forward, reverse": forwards(jax.grad(f)),
            "reverse, forward": jax.grad(forwards(f)),
            "reverse, reverse": jax.grad(jax.grad(f)),
        }
    every = lambda a: {name: derivative(a) for name, derivative in (first | second).items()}
    both = lambda a: jnp.stack([f(a), forwards(f)(a)])
    run = jax.jit if compiled else lambda f: f
    slope, bend = differences(run(both), at)
    found = run(every)(at)
    for name in first:
        np.testing.assert_allclose(found[name], slope, rtol=1e-8, atol=1e-9, err_msg=name)
    for name in second:
        np.testing.assert_allclose(found[name], bend, rtol=1e-7, atol=1e-8, err_msg=name)
    assert abs(slope) > 1e-5
    return abs(bend)


def differences(f, at, h=2e-3):
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    return sum(w * (f(at + k * h) - f(at - k * h)) for k, w in weights.items()) / h


WHERE = {"alone": alone, "in scan": in_scan, "in a batch": in_batch}
AT = jnp.asarray(1.05)


# Rules whose programs take seconds to compile.
LARGE = {
    "start of index 1",
    "start of a reduced DAE",
    "start with a mass matrix",
    "mechanical correction",
    "redundant correction",
}
# In a scan, where JAX loses most, and in turn alone or in a batch.
PAIRS = [(rule, "in scan") for rule in RULES]
PAIRS += [
    (rule, ("alone", "in a batch")[i % 2]) for i, rule in enumerate(RULES) if rule not in LARGE
]


@pytest.mark.parametrize(
    ("rule", "where"),
    variants(PAIRS, lambda pair: pair[1] == "in scan" and pair[0] not in LARGE),
)
def test_every_rule(rule, where):
    assert check(WHERE[where](RULES[rule]), AT) > 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("rule", [rule for rule in RULES if rule not in LARGE])
def test_every_rule_in_a_while_loop(rule):
    check(in_while_loop(RULES[rule]), AT, reverse=False)


@pytest.mark.parametrize(
    "rule", variants(["root of a step", "inverse", "reduced DAE", "pseudo-inverse"], ["inverse"])
)
def test_rules_that_are_not_compiled(rule):
    check(RULES[rule], AT, compiled=False)


def test_a_rule_is_kept_in_loops():
    """What `jax.custom_jvp` loses: a function whose derivative is not that of its operations."""

    @ForwardRule
    def function(x):
        return jax.lax.stop_gradient(x) ** 3

    @function.define_jvp
    def rule(value, primals, tangents):
        del value
        return 3 * primals[0] ** 2 * tangents[0]

    check(in_scan(function), jnp.asarray(0.7))
    gradient = jax.grad(in_scan(function))
    batched = jax.jit(jax.vmap(gradient))(jnp.array([0.7, 0.8]))
    np.testing.assert_allclose(batched[0], jax.jit(gradient)(0.7), rtol=1e-14)


def rigid(t, y, a):
    return jnp.stack([a * y[1] * y[2], -1.1 * y[0] * y[2], (1.1 - a) * y[0] * y[1]])


SPHERE = mj.Constraint(lambda t, y, a: y @ y - (1 + 0.1 * jnp.sin(a)))
ROD = mj.MechanicalSystem(1.0, lambda t, q, a: q @ q - a, lambda t, q, v, a: jnp.stack([0 * a, -a]))
SOLVES = {
    "projected": (
        dfx.ODETerm(rigid),
        mj.Projected(dfx.Tsit5(), SPHERE),
        jnp.array([0.9, 0.5, 0.1]),
    ),
    "mechanism": (ROD.terms, mj.Projected(dfx.Heun(), ROD.constraint), STATE),
    "reduced": (DAE.terms, mj.Projected(dfx.Tsit5(), DAE.constraint), Z),
    "reduced, alone": (DAE.terms, dfx.Tsit5(), Z),
    "implicit": (
        dfx.ODETerm(rigid),
        mj.Projected(dfx.Kvaerno3(), SPHERE),
        jnp.array([0.9, 0.5, 0.1]),
    ),
    "index 1": (MASS_TERM, mj.Rodas5P(), jnp.array([1.0, 1.2])),
}


def end_of(name, adjoint=None):
    terms, solver, y0 = SOLVES[name]
    tight = dict(rtol=1e-10, atol=1e-10, norm=optx.max_norm)
    if name == "implicit":
        stages = dfx.VeryChord(**tight)
        solver = eqx.tree_at(lambda s: s.inner.root_finder, solver, stages)

    def end(a):
        start = jax.tree.map(lambda leaf: leaf * (1 + 0.1 * (a - 1)), y0)
        saveat = dfx.SaveAt(ts=jnp.array([0.13, 0.3]))
        options = dict(adjoint=adjoint) if adjoint is not None else {}
        sol = mj.diffeqsolve(terms, solver, 0.0, 0.3, 0.1, start, a, saveat=saveat, **options)
        return total(jax.tree.leaves(sol.ys)[0].reshape(-1))

    return end


@pytest.mark.parametrize("name", variants(SOLVES, ["mechanism"]))
def test_solves(name):
    """Both modes of the default adjoint, and forward mode of both."""
    end = end_of(name)
    both = jax.jit(lambda a: jnp.stack(jax.value_and_grad(end)(a)))
    slope, bend = differences(both, AT)
    for derivative in (both(AT)[1], jax.jit(forwards(end))(AT)):
        np.testing.assert_allclose(derivative, slope, rtol=1e-8)
    for derivative in (forwards(jax.grad(end)), forwards(forwards(end))):
        np.testing.assert_allclose(jax.jit(derivative)(AT), bend, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_reverse_over_reverse_of_a_solve():
    """With outputs between the steps."""
    end = end_of("projected", dfx.DirectAdjoint())
    bend = differences(jax.jit(jax.grad(end)), AT)
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(end)))(AT), bend, rtol=1e-8)


def test_a_boundary_value_by_optimistix():
    """Newton's method asks for forward mode, the derivative of its root for both."""
    end = end_of("projected")
    goal, slope = jax.jit(lambda a: jax.jvp(end, (a,), (jnp.ones_like(a),)))(AT)

    def found(x):
        newton = optx.Newton(rtol=1e-12, atol=1e-12)
        return optx.root_find(lambda a, x: end(a) - x, newton, AT + 0.05, x).value

    value, reverse = jax.jit(jax.value_and_grad(found))(goal)
    np.testing.assert_allclose(value, AT, rtol=1e-10)
    np.testing.assert_allclose(reverse, 1 / slope, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(forwards(found))(goal), 1 / slope, rtol=1e-9)


def test_the_loop_of_a_user():
    """Euler's method in a scan, of which JAX's own rules lose the second derivative altogether."""
    step = lambda z, a: z + 0.02 * DAE.terms.vf(0.0, z, a)
    end = lambda a: jax.lax.scan(lambda z, _: (step(z, a), None), Z, None, length=5)[0][2]
    assert check(end, AT) > 1e-6


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
@pytest.mark.parametrize("derivative", [lambda f: f, jax.grad, jax.hessian])
def test_a_rule_around_operations_for_tracing_alone(derivative, wrap):
    """`jnp.triu_indices` has some from JAX 0.12 on, which are replaced before a program is compiled."""
    squares = lambda x: jnp.sum(jnp.outer(x, x)[jnp.triu_indices(3)] ** 2)
    ruled = ForwardRule(squares)
    ruled.define_jvp(lambda values, primals, tangents: jax.jvp(squares, primals, tangents)[1])
    x = jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(wrap(derivative(ruled))(x), derivative(squares)(x), rtol=1e-14)


@ForwardRule
def without_cotangents(x):
    return x


@without_cotangents.define_jvp
def _(value, primals, tangents):
    forward = lambda primals, tangents: jnp.zeros_like(value)
    return apply_linear(forward, lambda primals, bar: (None,), value, primals, tangents)


def test_nothing_is_compiled_for_a_known_value_without_effect():
    """The function is there for its derivative only, and that for cotangents only."""

    def value(a, is_used):
        known = known_value(jnp.sin, jnp.asarray(0.25), a)
        return a**2 + (known if is_used else without_cotangents(known))

    derivative = lambda is_used: str(jax.make_jaxpr(jax.grad(lambda a: value(a, is_used)))(0.3))
    assert "cos" in derivative(True)
    assert "cos" not in derivative(False)
