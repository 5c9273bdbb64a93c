"""Gradients through projected solves: all modes agree, and agree with differences."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import outside
import pytest

import manifold_jax as mj


ADJOINTS = {
    "reverse": dfx.RecursiveCheckpointAdjoint(),
    "forward": dfx.ForwardMode(),
    "direct": dfx.DirectAdjoint(),
}


class Circle(eqx.Module):
    """Position and velocity of a pendulum, its length as a leaf."""

    length: jax.Array

    def __call__(self, t, y, args):
        q, v = y
        return jnp.stack([q @ q - self.length**2, q @ v])


def pendulum_end(theta, adjoint, where, controller, saveat=None):
    """State of the pendulum as a function of (gravity, length, angle, rate).

    The length is inside the constraint: through `args`, a module leaf, or a closure.
    """
    gravity, length, angle, rate = theta
    direction = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    tangent = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    y0 = (length * direction, length * rate * tangent)
    if where == "args":
        constraint = mj.Constraint(lambda t, y, a: (y[0] @ y[0] - a[1] ** 2, y[0] @ y[1]))
    elif where == "leaf":
        constraint = mj.Constraint(Circle(length))
    else:
        constraint = mj.Constraint(lambda t, y, a: (y[0] @ y[0] - length**2, y[0] @ y[1]))
    field = mj.problems.pendulum().terms
    args = mj.problems.pendulum().args._replace(gravity=gravity, length=length)
    args = args if where != "args" else (gravity, length)
    terms = field if where != "args" else dfx.ODETerm(tuple_field)
    sol = mj.diffeqsolve(
        terms,
        mj.Projected(dfx.Bosh3(), constraint),
        0.0,
        1.3,
        None,
        y0,
        args,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=64,
        saveat=dfx.SaveAt(t1=True) if saveat is None else saveat,
    )
    return sol


def tuple_field(t, y, a):
    q, v = y
    mu = (v @ v - a[0] * q[1]) / (q @ q)
    return v, jnp.stack([-mu * q[0], -a[0] - mu * q[1]])


THETA = jnp.array([9.81, 0.9, 0.7, 0.4])
WEIGHTS = jnp.array([1.0, -0.5, 0.3, 0.2])
STEPS = dfx.StepTo(ts=jnp.linspace(0.0, 1.3, 41))


def objective(theta, adjoint, where, controller=STEPS):
    return jfu.ravel_pytree(pendulum_end(theta, adjoint, where, controller).ys)[0] @ WEIGHTS


def differences(f, x, step):
    """Fourth-order central differences (Richardson)."""

    def central(h):
        return jnp.stack([(f(x + h * e) - f(x - h * e)) / (2 * h) for e in jnp.eye(len(x))])

    return (4 * central(step) - central(2 * step)) / 3


@pytest.mark.parametrize("where", ["args", "leaf", "closure"])
def test_modes_agree_and_equal_differences(where):
    run = jax.jit(jax.value_and_grad(lambda x: objective(x, ADJOINTS["reverse"], where)))
    reverse = run(THETA)[1]
    forward = jax.jit(jax.jacfwd(objective), static_argnums=(1, 2))(
        THETA, ADJOINTS["forward"], where
    )
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    expected = differences(lambda theta: run(theta)[0], THETA, 1e-3)
    np.testing.assert_allclose(forward, expected, rtol=1e-7)


def test_hessian_vector_product():
    """Forward over forward, and forward over reverse through DirectAdjoint."""
    direction = jnp.array([0.3, -0.2, 0.5, 0.1])

    def hvp(adjoint, gradient):
        g = lambda theta: gradient(lambda theta: objective(theta, adjoint, "args"))(theta)
        return jax.jit(lambda theta: jax.jvp(g, (theta,), (direction,))[1])(THETA)

    forward = hvp(ADJOINTS["forward"], jax.jacfwd)
    direct = hvp(ADJOINTS["direct"], jax.grad)
    np.testing.assert_allclose(forward, direct, rtol=1e-10)
    gradient = jax.jit(jax.jacfwd(lambda theta: objective(theta, ADJOINTS["forward"], "args")))
    h = 1e-3
    along = lambda h: (gradient(THETA + h * direction) - gradient(THETA - h * direction)) / (2 * h)
    np.testing.assert_allclose(forward, (4 * along(h) - along(2 * h)) / 3, rtol=1e-7)


def test_sensitivities_are_tangent():
    """G(y) dy + g_a da = 0 at every saved value, interpolated ones included."""
    saveat = dfx.SaveAt(ts=jnp.linspace(0.05, 1.25, 23))

    def trajectory(theta):
        return pendulum_end(theta, ADJOINTS["forward"], "args", STEPS, saveat).ys

    twice = lambda theta: (trajectory(theta),) * 2
    (dq, dv), (q, v) = jax.jit(jax.jacfwd(twice, has_aux=True))(THETA)
    length = np.array([0.0, 2 * THETA[1], 0.0, 0.0])
    np.testing.assert_allclose(2 * np.einsum("ti,tip->tp", q, dq) - length, 0, atol=1e-12)
    velocity = np.einsum("ti,tip->tp", v, dq) + np.einsum("ti,tip->tp", q, dv)
    np.testing.assert_allclose(velocity, 0, atol=1e-11)


def test_outside_problem_time_dependent():
    """A parameter of f and g, in a time-dependent pytree problem, forwards and backwards."""

    def solve(omega, adjoint, span, y0):
        sol = mj.diffeqsolve(
            outside.terms(),
            mj.Projected(dfx.Bosh3(), outside.constraint()),
            span[0],
            span[1],
            None,
            y0,
            outside.parameters(omega),
            stepsize_controller=dfx.StepTo(ts=jnp.linspace(*span, 61)),
            adjoint=adjoint,
            max_steps=64,
            consistent="project",
        )
        return jfu.ravel_pytree(sol.ys)[0] @ jnp.array([1.0, 2.0, -1.0])

    omega = jnp.asarray(outside.OMEGA)
    run = jax.jit(lambda w, *rest: jax.value_and_grad(solve)(w, ADJOINTS["reverse"], *rest))
    by_forward = jax.jit(lambda w, *rest: jax.jacfwd(solve)(w, ADJOINTS["forward"], *rest))
    for span in ((outside.T0, 2.2), (2.2, outside.T0)):
        start = jax.tree.map(jnp.asarray, outside.exact(span[0]))
        reverse, forward = run(omega, span, start)[1], by_forward(omega, span, start)
        np.testing.assert_allclose(reverse, forward, rtol=1e-10)
        expected = differences(lambda w, s=span, y=start: run(w, s, y)[0], omega, 1e-3)
        np.testing.assert_allclose(forward, expected, rtol=1e-7)


def test_gradient_of_an_inconsistent_start():
    """The start is moved by 0.2 and differentiated through that move."""
    problem = mj.problems.pendulum()

    def end(y0, adjoint):
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Bosh3(), problem.constraint),
            0.0,
            1.0,
            None,
            y0,
            problem.args,
            stepsize_controller=dfx.StepTo(ts=jnp.linspace(0.0, 1.0, 31)),
            adjoint=adjoint,
            max_steps=32,
        )
        return jfu.ravel_pytree(sol.ys)[0] @ WEIGHTS

    flat, unravel = jfu.ravel_pytree((jnp.array([1.1, 0.2]), jnp.array([0.3, 0.1])))
    run = jax.jit(jax.value_and_grad(lambda x: end(unravel(x), ADJOINTS["reverse"])))
    reverse = run(flat)[1]
    forward = jax.jit(lambda x: jax.jacfwd(lambda x: end(unravel(x), ADJOINTS["forward"]))(x))(flat)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(forward, differences(lambda x: run(x)[0], flat, 1e-3), rtol=1e-7)
