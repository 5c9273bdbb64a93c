"""Scalar form: a function evaluated number by number is the function of arrays, in every lane."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax._jaxpr.lane_arrays import Lanes, NotScalarError
from manifold_jax._jaxpr.lane_interpreter import call_in_lanes
from manifold_jax._jaxpr.lane_value import LaneValue


SIZE = 5


def in_lanes(function, *args, limit=100_000):
    """Of arguments with the lanes in front; and what there was no rule for."""
    lanes = Lanes(SIZE, limit)

    def run(*args):
        values = jtu.tree_map(lambda x: LaneValue.of_whole(jnp.moveaxis(x, 0, -1)), args)
        out = call_in_lanes(lanes, function, *values)
        return jtu.tree_map(lambda v: jnp.moveaxis(v.whole(lanes), -1, 0), out)

    return jax.jit(run)(*args), lanes


def bounded_loop(x):
    more = lambda s: (s[0] < 20) & (s[1] < 30.0)
    return jax.lax.while_loop(more, lambda s: (s[0] + 1, s[1] * 1.5 + x[0]), (0, x[1]))


def loop_over_rows(x):
    def body(carry, row):
        buffer, i = carry
        return (buffer.at[i].set(row @ buffer), i + 1), row[0]

    A = jnp.arange(9.0).reshape(3, 3)
    return jax.lax.scan(body, (x[:3], 0), A, reverse=True)


@jax.custom_jvp
def marked(x):
    return 2.0 * x


marked.defjvp(lambda primals, tangents: (marked(*primals), tangents[0]))


FUNCTIONS = {
    "arithmetic": lambda x: jnp.sin(x) / (2 + x**2) - jnp.maximum(x, 0.3) ** 3 + 0 * x,
    "not finite": lambda x: jnp.log(x) + jnp.where(x > 0, 1 / (x - x), x),
    "products": lambda x: (jnp.outer(x, x) @ x, jnp.einsum("ij,kj->ik", jnp.eye(4), x[None] * 2)),
    "moves": lambda x: (x[::-1], jnp.pad(x, 1)[jnp.array([0, 3])], x.reshape(2, 2).T.ravel()),
    "columns first": lambda x: x.reshape(2, 2).ravel(order="F"),
    "updates": lambda x: x.at[1].set(7.0).at[jnp.array([0, 2])].set(x[1:3]),
    "added to": lambda x: x.at[jnp.array([0, 0])].add(1.0),  # no rule
    "indices of their own": lambda x: x[jnp.argmax(x)],  # no rule
    "filled in": lambda x: x.at[jnp.array([0, 9])].get(mode="fill", fill_value=2.0),  # no rule
    "reductions": lambda x: (x.sum(), x.max(), x.prod(), jnp.all(x > 0), jnp.any(x > 1)),
    "branches": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, lambda x: -x, x),
    "several branches": lambda x: jax.lax.switch(
        jnp.int32(x[0] > 0) + jnp.int32(x[1] > 0), [lambda x: x, jnp.cos, lambda x: x * x], x
    ),
    "loop": bounded_loop,
    "loop over rows": loop_over_rows,
    "long loop": lambda x: jax.lax.scan(lambda c, _: (c * 0.9, c[0]), x, None, length=40),
    "solve": lambda x: jnp.linalg.solve(jnp.eye(4) * 3 + jnp.outer(x, x), x),
    "calls": lambda x: jax.jit(marked)(x) + jax.checkpoint(jnp.exp)(x),
    "derivatives": lambda x: (jax.jacfwd(jnp.cumsum)(x), jax.hessian(lambda x: (x**3).sum())(x)),
    "constants only": lambda x: jnp.linspace(0.0, 1.0, 3),
    "numbers": lambda x: (x > 0, jnp.int32(x[0] > 0) + 2, jnp.isfinite(x)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions(name):
    x = jnp.asarray(np.random.default_rng(1).normal(size=(SIZE, 4)))
    out, lanes = in_lanes(FUNCTIONS[name], x)
    expected = jax.jit(jax.vmap(FUNCTIONS[name]))(x)
    assert jtu.tree_structure(out) == jtu.tree_structure(expected)
    for a, b in zip(jtu.tree_leaves(out), jtu.tree_leaves(expected), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    known = {"added to", "indices of their own", "filled in", "long loop", "solve", "derivatives"}
    assert bool(lanes.whole) == (name in known), lanes.whole


@pytest.mark.parametrize("name", ["double_pendulum", "slider_crank", "rigid_body", "kepler"])
def test_problems(name):
    """Field and correction, with every operation in scalar form."""
    problem = getattr(mj.problems, name)()
    args = jtu.tree_map(jnp.asarray, problem.args)
    random = np.random.default_rng(0)
    near = lambda x: jnp.asarray(np.asarray(x) + 1e-3 * random.normal(size=(SIZE, *np.shape(x))))
    starts = jtu.tree_map(near, problem.y0)

    def function(y):
        field = problem.terms.vf(0.1, y, args)
        return field, problem.constraint.correct(mj.NewtonProjection(), 0.1, y, args)[0]

    out, lanes = in_lanes(function, starts)
    assert not lanes.whole
    for a, b in zip(
        jtu.tree_leaves(out), jtu.tree_leaves(jax.jit(jax.vmap(function))(starts)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_structure_is_folded():
    """Zeros and ones that are known, and what has been computed before, take no operation."""
    x = jnp.ones((SIZE, 4))
    identity = lambda x: jax.jacfwd(lambda x: x)(x) @ x + 0.0
    assert in_lanes(identity, x)[1].operations == 0
    twice = lambda x: jnp.sin(x[0]) * jnp.sin(x[0])
    assert in_lanes(twice, x)[1].operations == 2


def test_a_limit():
    with pytest.raises(NotScalarError, match="more than 3 operations"):
        in_lanes(jnp.sin, jnp.ones((SIZE, 4)), limit=3)


def test_sines_are_computed_once():
    """XLA thinks them cheap, and would compute them anew for every number that depends on them."""

    def function(x):
        s = jnp.sin(x[0])
        return jnp.stack([jnp.exp(k * s) for k in range(1, 6)])

    def run(x):
        lanes = Lanes(SIZE, 100)
        with lanes.inside(x[0]):
            out = call_in_lanes(lanes, function, LaneValue.of_whole(x))
            return out.columns(lanes)

    program = jax.jit(run).lower(jnp.ones((1, SIZE))).compile().as_text()
    assert program.count(" sine(") == 1
