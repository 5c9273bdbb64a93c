"""What a solve is traced and compiled for: each function of the user's once, however often it is evaluated."""

import collections

import diffrax as dfx
import equinox.internal as eqxi
import hypothesis.strategies as st
import jax
import jax.extend.core as jax_core
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import _integrate
from hypothesis import given, settings

import manifold_jax as mj
from manifold_jax._base import compat


def counted(function, counts, name):
    def wrapped(*args):
        counts[name] += 1
        return function(*args)

    return wrapped


def end(system, y0, t1):
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Tsit5(), system.constraint),
        0.0,
        t1,
        None,
        y0,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 3)),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
    )
    return sol.ys[0][-1, 0]


def test_functions_of_a_system_are_traced_once():
    """A gradient evaluates them at the start, in stages, at ends of steps and between them, forward and back."""
    counts = collections.Counter()
    pendulum = mj.problems.pendulum()
    y0 = pendulum.y0
    system = mj.MechanicalSystem(
        1.0,
        counted(lambda t, q, args: q @ q - y0[0] @ y0[0], counts, "phi"),
        counted(lambda t, q, v, args: jnp.array([0.0, -1.0]) - v, counts, "force"),
    )
    # As users have it: Diffrax sets it for itself, and what is traced under another setting is traced again.
    with jax.numpy_dtype_promotion("standard"):
        jax.jit(jax.grad(lambda t1: end(system, y0, t1))).trace(1.0)
    assert counts == {"phi": 1, "force": 1}


def count(jaxpr, name):
    """The number of operations of this name in a traced function, inner functions included."""
    inner = (f for e in jaxpr.eqns for f in jax_core.jaxprs_in_params(e.params))
    return sum(e.primitive.name == name for e in jaxpr.eqns) + sum(count(f, name) for f in inner)


def test_the_end_of_a_solve_is_no_chain_of_operations():
    """Diffrax writes a hundred of them; if this fails it is written otherwise, see `_base/compat.py`."""
    problem = mj.problems.pendulum()
    solve = lambda module, t1: module.diffeqsolve(
        problem.terms, dfx.Tsit5(), 0.0, t1, 0.1, problem.y0, problem.args
    )
    counts = {
        module: count(jax.make_jaxpr(lambda t1, m=module: solve(m, t1).ys)(1.0).jaxpr, "nextafter")
        for module in (dfx, mj)
    }
    assert counts[dfx] >= 100
    assert counts[mj] < 5


@jax.jit
def floor_of_diffrax(t1):
    for _ in range(100):
        t1 = eqxi.prevbefore(t1)
    return t1


@given(
    mantissa=st.floats(0.501, 0.999),
    exponent=st.integers(-30, 30),
    sign=st.sampled_from([1.0, -1.0]),
    units=st.integers(-3, 300),
    keep=st.booleans(),
)
@settings(deadline=None, max_examples=50)
def test_steps_end_where_those_of_diffrax_do(mantissa, exponent, sign, units, keep):
    t1 = sign * mantissa * 2.0**exponent
    tnext = t1 - units * np.spacing(abs(t1))
    given = 0.5 * t1 - 1.0, tnext, t1
    theirs = _integrate._clip_to_end(*given, floor_of_diffrax(t1), keep)
    assert compat._clip_to_end(*given, t1, keep) == theirs


@pytest.mark.parametrize(
    ("t1", "tnext", "end"), [(0.0, -1e-300, -1e-300), (0.0, 0.0, 0.0), (np.inf, 3.0, 3.0)]
)
def test_ends_without_digits(t1, tnext, end):
    """At zero the unit of rounding is the smallest number; a solve until an event has no end."""
    assert compat._clip_to_end(-1.0, tnext, t1, t1, True) == end


def test_a_term_of_ones_own_keeps_its_field():
    class Slowed(dfx.ODETerm):
        def vf(self, t, y, args):
            return 0.5 * self.vector_field(t, y, args)

    sol = mj.diffeqsolve(Slowed(lambda t, y, args: -y), dfx.Tsit5(), 0.0, 1.0, 0.1, jnp.ones(1))
    np.testing.assert_allclose(sol.ys[0, 0], np.exp(-0.5), rtol=1e-6)
