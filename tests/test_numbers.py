"""Python's numbers among the arguments: other values are the same program."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


START = jnp.array([0.6, 0.8])


class Counted:
    """Calls of a function of the user while it is traced."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, t, y, args):
        self.calls += 1
        return self.function(t, y, args)


def field(t, y, args):
    return args["rate"] * y[0] ** args["power"] * jnp.stack([-y[1], y[0]])


def circle(t, y, args):
    return y @ y - args["radius"] ** 2


def arguments(rate, number=float):
    return {"rate": number(rate), "radius": number(1.0), "power": 2}


@pytest.mark.parametrize("hook", [True, False])
def test_solves_of_other_numbers_are_not_compiled_again(hook):
    counted = Counted(field)
    solver = mj.Projected(dfx.Heun(), mj.Constraint(circle)) if hook else dfx.Heun()
    solve = lambda rate, *times, number=float: mj.diffeqsolve(
        dfx.ODETerm(counted), solver, *times, START, arguments(rate, number)
    )
    first = solve(0.7, 0.0, 1.0, 0.1)
    calls = counted.calls
    assert calls > 0
    others = [solve(0.9, 0.0, 1.0, 0.1), solve(0.7, 0.1, 2.0, 0.2), solve(0.7, 0, 2, 1)]
    assert counted.calls == calls
    same = solve(0.9, 0.0, 1.0, 0.1, number=jnp.asarray)
    np.testing.assert_allclose(others[0].ys, same.ys, rtol=0, atol=1e-15)
    assert not np.allclose(others[0].ys, first.ys)
    assert others[2].t1 == 2.0


def test_ensembles_of_other_numbers_are_not_compiled_again():
    counted, calls = Counted(field), []
    for rate, t1 in ((0.7, 1.0), (0.9, 2.0)):
        mj.solve_ensemble(
            dfx.ODETerm(counted),
            dfx.Heun(),
            0.0,
            t1,
            0.1,
            jnp.stack([START, START]),
            arguments(rate),
            args_axes=None,
        )
        calls.append(counted.calls)
    assert calls[0] == calls[1]


@pytest.mark.parametrize("function", [mj.project, mj.consistent_state, mj.constraint_violation])
def test_points_of_other_numbers_are_not_compiled_again(function):
    counted = Counted(lambda t, y, args: y["x"] ** 2 + y["z"] ** 2 - args)
    constraint = mj.Constraint(counted)
    call = lambda x, args: function(constraint, 0.0, {"x": x, "z": 0.5}, args)
    call(0.8, 1.0)
    calls = counted.calls
    call(0.9, 1.1)
    assert counted.calls == calls


def test_reduced_systems_of_other_numbers_are_not_compiled_again():
    counted = 0

    def pendulum(t, x, xdot, args):
        nonlocal counted
        counted += 1
        q, v, tension = x
        force = -tension * q - jnp.stack([0.0, 1.0]) * args
        return xdot[0] - v, xdot[1] - force, q @ q - 1.0

    example = jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6]), jnp.asarray(1.0)
    dae = mj.reduce_dae(pendulum, example, 9.81)
    calls = []
    for g, tension in ((9.81, 1 + 0.8 * 9.81), (1.62, 1 + 0.8 * 1.62)):
        z, _ = dae.consistent_state(0.0, example, g)
        x, _ = dae.outputs(0.0, z, g)
        np.testing.assert_allclose(x[2], tension, rtol=1e-12)
        # Compiled, and differentiated, as a whole.
        several = jax.vmap(dae.outputs, in_axes=(None, 0, None))(0.0, jnp.stack([z, z]), g)
        np.testing.assert_allclose(several[0][2], tension, rtol=1e-12)
        trajectories = dae.outputs(jnp.zeros((2, 3)), jnp.broadcast_to(z, (2, 3, 4)), g)
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1, 2], b), trajectories[0], x)
        assert trajectories[1][0].shape == (2, 3, 2)
        calls.append(counted)
    assert calls[0] == calls[1]
    slope = jax.grad(lambda g: dae.outputs(0.0, z, g)[0][2])(2.0)
    np.testing.assert_allclose(slope, 0.8, rtol=1e-12)


def test_the_type_of_a_number_is_that_of_what_it_meets():
    """Not that of numbers of 64 bits in a solve in single precision."""
    single = jnp.asarray(START, jnp.float32)
    seen = []

    def typed(t, y, args):
        seen.append(jnp.result_type(args["rate"] * y))
        return args["rate"] * jnp.stack([-y[1], y[0]])

    times = (jnp.asarray(t, jnp.float32) for t in (0.0, 1.0, 0.1))
    sol = mj.diffeqsolve(dfx.ODETerm(typed), dfx.Heun(), *times, single, arguments(0.7))
    assert sol.ys.dtype == jnp.float32
    assert set(seen) == {jnp.dtype(jnp.float32)}


def test_under_jit_numbers_are_constants_of_that_program():
    """They cost no run time there, and nothing has to be checked while it runs."""
    terms = dfx.ODETerm(lambda t, y, args: args * y)
    solve = lambda y0: mj.diffeqsolve(terms, dfx.Heun(), 0.0, 1.0, 0.1, y0, -0.5, throw=False).ys
    assert "callback" not in str(jax.make_jaxpr(solve)(START))


def test_whole_numbers_stay_what_they_are():
    shape = lambda t, y, args: -y * (jnp.ones(args["size"]).sum() if args["on"] else 1.0)
    args = {"size": 3, "on": True}
    sol = eqx.filter_jit(mj.diffeqsolve)(dfx.ODETerm(shape), dfx.Heun(), 0, 1, 0.1, START, args)
    assert sol.result == dfx.RESULTS.successful
    assert mj.diffeqsolve(dfx.ODETerm(shape), dfx.Heun(), 0, 1, 0.1, START, args).t1 == 1.0
