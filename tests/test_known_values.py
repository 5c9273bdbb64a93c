"""Values of primitives that NumPy computes are those of JAX, to the last bit and with the same types."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from manifold_jax._jaxpr.known_values import evaluated
from manifold_jax._jaxpr.trace import called, walk


X = np.random.default_rng(0).normal(size=(2, 3))
N = np.arange(-3, 3).reshape(2, 3)
ODD = np.array([-1.7, 2.9, np.inf, np.nan, -0.0])
to = lambda dtype: functools.partial(lax.convert_element_type, new_dtype=dtype)
CASES = {
    "pad": (lambda x: lax.pad(x, 7.0, [(1, -1, 2), (-1, 2, 0)]), X),
    "pad with more cut off": (lambda x: lax.pad(x, 7.0, [(-1, 3, 0), (2, -4, 1)]), X),
    "pad nothing": (lambda x: lax.pad(x, 7.0, [(1, 2, 3), (0, 0, 0)]), X[:0]),
    "iota": (lambda x: x + lax.broadcasted_iota(np.int64, (2, 3), 1), N),
    "split": (lambda x: lax.split(x, (1, 2), 1), X),
    "stack": (lambda x: jnp.stack([x, x + 1], 1), X),
    "unstack": (lambda x: jnp.unstack(x, axis=1), X),
    "unstack a vector": (jnp.unstack, X[0]),
    "concatenate": (lambda x: lax.concatenate([x, x], 1), X),
    "reverse": (lambda x: lax.rev(x, (0,)), X),
    "transpose": (lambda x: lax.transpose(x, (1, 0)), X),
    "broadcast": (lambda x: lax.broadcast_in_dim(x, (2, 4, 3), (0, 2)), X),
    "select": (lambda x: lax.select(x > 0, x, 2 * x), X),
    "select by a scalar": (lambda x: lax.select(x[0, 0] > 5, x, 2 * x), X),
    "select among three": (lambda n: lax.select_n(abs(n) % 3, n, 2 * n, 3 * n), N),
    "to integers": (to(np.int32), ODD),
    "to booleans": (to(np.bool_), N),
    "from integers": (to(np.float32), N),
    "from booleans": (to(np.float64), X > 0),
    "to single precision": (to(np.float32), X),
    "beyond single precision": (to(np.float32), np.array([1e300, -1e-300])),
    "complex numbers": (lambda z: z * z / (z + z), X + 2j * X[::-1]),
    "integers to bfloat16": (to(jnp.bfloat16), 257 * N),
    "to bfloat16": (to(jnp.bfloat16), X),
    "from bfloat16": (lambda x: abs(x) + x, X.astype(jnp.bfloat16)),
    "integers divided": (lambda n: lax.div(n, np.full((2, 3), 2)), N),
    "division by zero": (lambda x: lax.div(x, x - x), ODD),
    "roots": (lax.sqrt, ODD),
    "squares": (lax.square, X),
    "absolute values": (abs, ODD),
    "finite": (lax.is_finite, ODD),
    "logic": (lambda x: ~(x > 0) | (x < 1), X),
    "sums": (lambda x: lax.cumsum(x, 1), X),
}


def by_numpy(function, x):
    def apply(equation, values):
        inner = called(equation)
        if inner is not None:
            return walk(inner, values, np.asarray, apply)
        return evaluated(equation.primitive, equation.params, values)

    return walk(jax.make_jaxpr(function)(x), [x], np.asarray, apply)


@pytest.mark.parametrize("name", CASES)
def test_they_are_those_of_jax(name):
    function, x = CASES[name]
    expected = jax.tree.leaves(jax.jit(function)(x))
    for ours, theirs in zip(by_numpy(function, x), expected, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


def test_no_program_is_compiled(monkeypatch):
    """What reading a function takes, with operands of NumPy, is done by NumPy."""
    from jax._src import compiler

    def refuse(*args, **kwargs):
        raise AssertionError("compiled")

    closed = [jax.make_jaxpr(CASES[name][0])(CASES[name][1]) for name in ("pad", "stack", "select")]
    monkeypatch.setattr(compiler, "compile_or_get_cached", refuse)
    apply = lambda equation, values: evaluated(equation.primitive, equation.params, values)
    for jaxpr in closed:
        walk(jaxpr, [X], np.asarray, apply)
