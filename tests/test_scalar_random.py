"""Scalar form of random functions: five hundred compositions of JAX's operations.

Equal to `jax.vmap` wherever values are infinite or undefined, too. There is one exception, by
design: a zero that is known while tracing makes a product zero, whatever the other factor. The
first functions have no such zeros, so that nothing is excepted; the second, derivatives with zeros in
their tangents and constants, stay finite, so that it makes no difference.
"""

import functools

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from jax import lax

from manifold_jax._jaxpr.lane_arrays import Lanes
from manifold_jax._jaxpr.lane_interpreter import call_in_lanes
from manifold_jax._jaxpr.lane_value import LaneValue


SIZE = 6
LARGEST = 12  # numbers of an array
LENGTH = 8  # operations of a function
SMOOTH = (
    jnp.sin,
    jnp.tanh,
    jnp.arctan,
    jax.nn.softplus,
    lambda x: x**3,
    lambda x: x / (2 + x * x),
    lambda x: jnp.exp(-x * x),
    lambda x: jnp.log1p(x**2),
    jax.checkpoint(lambda x: jnp.sqrt(1 + jnp.square(x))),
    jax.jit(lambda x: jnp.cos(x) * 0.5),
)
PARTIAL = (
    jnp.log,
    jnp.sqrt,
    jnp.exp,
    lambda x: 1 / x,
    lambda x: x / (x - x),
    lambda x: x**-2,
    jnp.floor,
    jnp.sign,
    jnp.abs,
    jax.nn.relu,
    jnp.expm1,
    lax.rsqrt,
)


class Maker:
    """Draws operations and applies them to the values there are: lists of floating-point arrays and
    of integers, both with small shapes."""

    def __init__(self, seed, is_finite, x, n):
        self.random = np.random.default_rng(seed)
        self.is_finite = is_finite
        self.floats, self.integers = [x], [n]
        self.functions = SMOOTH if is_finite else SMOOTH + PARTIAL

    def pick(self, items):
        return items[self.random.integers(len(items))]

    def array(self):
        return self.pick(self.floats[-4:])

    def vector(self):
        return self.array().ravel()

    def integer(self):
        return self.pick(self.integers[-3:])

    def like(self, x):
        """Another array of the same shape, or a constant one, or one number."""
        same = self.pick([y for y in self.floats if y.shape == x.shape])
        return self.pick(
            [same, self.constant(x.shape), jnp.broadcast_to(self.vector()[0], x.shape)]
        )

    def constant(self, shape):
        values = self.random.normal(size=shape) + 0.1
        whole = self.random.random(shape)
        values = np.where(whole < 0.2, 1.0, np.where(whole > 0.9, -1.0, values))
        if self.is_finite:
            values = np.where((0.2 < whole) & (whole < 0.4), 0.0, values)
        return jnp.asarray(values)

    def make(self, length):
        operations = [getattr(self, name) for name in dir(self) if name.startswith("op_")]
        for _ in range(length):
            self.pick(operations)()
            self.floats[-1] = jnp.atleast_1d(self.floats[-1])
            if self.floats[-1].size > LARGEST:
                self.floats[-1] = self.floats[-1].ravel()[:LARGEST]
            if self.is_finite:
                self.floats[-1] = 3 * jnp.tanh(self.floats[-1])
        return self.floats[-2:], self.integers[-1]

    def op_function(self):
        self.floats.append(self.pick(self.functions)(self.array()))

    def op_arithmetic(self):
        x = self.array()
        y = self.like(x)
        operations = [jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum]
        operations += [jnp.arctan2, lambda x, y: jnp.where(x > y, x, y * 2)]
        if not self.is_finite:
            operations += [jnp.divide, lax.rem, jnp.hypot, lax.nextafter]
        else:
            operations.remove(jnp.arctan2)  # has no derivative at the origin
        self.floats.append(self.pick(operations)(*self.pick([(x, y), (y, x)])))

    def op_constant(self):
        x = self.array()
        operation = self.pick([jnp.add, jnp.subtract, jnp.multiply, jnp.minimum])
        self.floats.append(operation(self.constant(x.shape), x))

    def op_product(self):
        x, y = self.vector()[:3], self.vector()[:4]
        matrix = self.constant((x.size, int(self.random.integers(1, 4))))
        batch = self.constant((2, x.size, 2))
        products = [
            lambda: x @ matrix,
            lambda: matrix.T @ x,
            lambda: jnp.outer(x, y),
            lambda: jnp.einsum("i,kij->kj", x, batch),
            lambda: jnp.vdot(x, x),
            lambda: jnp.outer(x, x) @ matrix,
            lambda: jnp.einsum("i,j,ij->i", x, x, jnp.outer(x, x)),
        ]
        self.floats.append(self.pick(products)())

    def op_move(self):
        x, y = self.array(), self.vector()
        where = self.random.integers(0, y.size, size=int(self.random.integers(1, 5)))
        moves = [
            lambda: x[::-1],
            lambda: x.T,
            lambda: x.reshape(-1, 1),
            lambda: y[::2],
            lambda: y[where],
            lambda: y[jnp.asarray(where)].reshape(1, -1),
            lambda: jnp.roll(y, 1),
            lambda: jnp.concatenate([y, self.vector()]),
            lambda: jnp.pad(x, 1, constant_values=1.5),
            lambda: jnp.stack([y, 2 * y], axis=-1),
            lambda: jnp.tile(y, 2),
            lambda: jnp.split(jnp.concatenate([y, y]), 2)[1],
            lambda: jnp.broadcast_to(y[0], (2, 2)),
            lambda: lax.dynamic_slice(y, (int(where[0]),), (1,)),
            lambda: y.at[int(where[0])].set(self.vector()[0]),
            lambda: y.at[where[:1]].multiply(self.vector()[0], unique_indices=True),
            lambda: y.at[where].add(1.5),
        ]
        if not self.is_finite:
            moves.append(lambda: jnp.take(y, jnp.asarray([0, y.size])))  # from nowhere
        self.floats.append(self.pick(moves)())

    def op_index(self):
        y, n = self.vector(), self.integer()
        where = jnp.abs(n) % y.size
        several = (jnp.stack([n, n + 1, 2 * n]) % y.size).astype(int)
        uses = [
            lambda: y[where],
            lambda: y[several],
            lambda: lax.dynamic_slice(y, (where,), (1,)),
            lambda: y.at[where].set(1.5),
            lambda: y.at[several].add(0.5),
            lambda: jnp.where(jnp.arange(y.size) == where, 2.0, y),
            lambda: jnp.take(y, n, mode="clip"),
        ]
        self.floats.append(self.pick(uses)())

    def op_reduce(self):
        x = self.array()
        y = x.ravel()
        axis = int(self.random.integers(x.ndim))
        reductions = [
            lambda: jnp.sum(x, axis=axis),
            lambda: jnp.prod(x, axis=axis),
            lambda: jnp.mean(x),
            lambda: jnp.cumsum(y),
            lambda: jnp.sum(y * y) + 1.0,
        ]
        if not self.is_finite:  # at equal values which derivative is taken is a choice
            reductions += [
                lambda: jnp.max(x, axis=axis),
                lambda: jnp.min(x),
                lambda: jnp.sort(y),
                lambda: jnp.linalg.norm(y),
            ]
        self.floats.append(self.pick(reductions)())

    def op_integer(self):
        x, n = self.vector(), self.integer()
        whole = [
            lambda: n + 1,
            lambda: 3 * n - 2,
            lambda: n // 2,
            lambda: n % 3,
            lambda: jnp.clip(n, 0, 2),
            lambda: n ^ 5,
            lambda: jnp.argmax(x).astype(n.dtype),
            lambda: jnp.sum(x > 0.5).astype(n.dtype),
            lambda: jnp.where(jnp.any(jnp.isnan(x)), 7, n),
            lambda: jnp.all(jnp.isfinite(x)).astype(n.dtype),
            lambda: (~(x[0] > 1) | (n > 0)).astype(n.dtype),
        ]
        self.integers.append(self.pick(whole)())
        if self.random.random() < 0.3:
            self.floats.append(self.integers[-1].astype(x.dtype) + 0.5)

    def op_branch(self):
        x, n = self.array(), self.integer()
        first, second, third = (self.pick(self.functions) for _ in range(3))
        constant = self.constant(x.shape)
        branches = [
            lambda: lax.cond(n > 1, first, second, x),
            lambda: lax.cond(x.ravel()[0] > 0.2, lambda x: x + constant, second, x),
            lambda: lax.switch(n, [first, second, third], x),
            lambda: lax.cond(
                n > 0, lambda x: lax.cond(x.ravel()[0] < 0, first, third, x), second, x
            ),
            lambda: lax.cond(True, first, second, x),
        ]
        self.floats.append(self.pick(branches)())

    def op_loop(self):
        x, n = self.array(), self.integer()
        function, row = self.pick(self.functions), self.vector()[:1]

        def step(carry, y):
            y = function(y)
            return jnp.tanh(carry + y.sum()), y * carry

        loops = [
            lambda: lax.scan(step, row, x)[1],
            lambda: lax.scan(step, row, x, reverse=True)[1],
            lambda: lax.scan(step, row, x)[0],
            lambda: lax.scan(lambda c, _: (jnp.sin(c) + 0.5, c[0]), row, length=20)[1][::4],
            lambda: lax.fori_loop(0, 3, lambda i, c: jnp.sin(c) + i, row),
            lambda: lax.scan(lambda c, i: (c.at[i].mul(2.0), i), x.ravel(), jnp.arange(x.size))[0],
            lambda: lax.while_loop(
                lambda c: c[0] < n % 5, lambda c: (c[0] + 1, jnp.cos(c[1])), (0 * n, row)
            )[1],
        ]
        self.floats.append(self.pick(loops)())


def values(seed, x, n):
    return Maker(seed, False, x, n).make(LENGTH)


def derivatives(seed, x, n):
    """In a direction with a known zero, and one of its own in every lane."""
    function = lambda x: Maker(seed, True, x, n).make(LENGTH)[0]
    known = jnp.asarray([1.0, 0.0, -0.5, 0.0])
    along = lambda v: jax.jvp(function, (x,), (v,))
    return along(known), jax.jvp(lambda x: along(known)[1], (x,), (jnp.sin(x),))[1]


def lanes_and_vmap(function, x, n):
    def run(x, n):
        lanes = Lanes(SIZE, 100_000)
        whole = (LaneValue.of_whole(jnp.moveaxis(a, 0, -1)) for a in (x, n))
        out = call_in_lanes(lanes, function, *whole)
        return jtu.tree_map(lambda v: jnp.moveaxis(v.whole(lanes), -1, 0), out)

    return jax.jit(run)(x, n), jax.jit(jax.vmap(function))(x, n)


def check(function, x, n):
    ours, theirs = lanes_and_vmap(function, x, n)
    for a, b in zip(jtu.tree_leaves(ours), jtu.tree_leaves(theirs), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        # Rounding of sums in another order, made larger by what follows.
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def inputs(seed, special):
    random = np.random.default_rng(10_000 + seed)
    x = random.normal(size=(SIZE, 4)) * 2
    if special:
        x[1, 2], x[2, 0], x[3, 3], x[3, 1], x[4] = np.nan, np.inf, -np.inf, np.inf, np.inf
    return jnp.asarray(x), jnp.asarray(random.integers(-3, 6, SIZE))


def groups(count, size):
    """The first by default."""
    return [
        pytest.param(range(k, k + size), id=f"{k}", marks=[pytest.mark.slow] * (k > 0))
        for k in range(0, count, size)
    ]


@pytest.mark.parametrize("seeds", groups(120, 30))
def test_values(seeds):
    for seed in seeds:
        try:
            check(functools.partial(values, seed), *inputs(seed, True))
        except Exception as error:
            raise AssertionError(f"function {seed}") from error


@pytest.mark.parametrize("seeds", groups(80, 10))
def test_derivatives(seeds):
    for seed in seeds:
        try:
            check(functools.partial(derivatives, seed), *inputs(seed, False))
        except Exception as error:
            raise AssertionError(f"function {seed}") from error


def test_known_zeros_are_exact():
    """The exception: also where the other factor is not finite."""
    x, n = inputs(0, True)
    c = jnp.asarray([2.0, 0.0, -1.0, 0.5])
    ours, theirs = lanes_and_vmap(lambda x, n: (jnp.diag(c) @ x, c * x), x, n)
    expected = np.where(c[None] == 0, 0.0, c[None] * x)
    for product in ours:
        np.testing.assert_array_equal(product, expected)
    assert np.isnan(theirs[0]).sum() > np.isnan(expected).sum()
