"""RATTLE where masses depend on positions or forces on velocities: bodies in space, linkages, friction."""

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
from differences import slopes_by_differences
from scipy.spatial.transform import Rotation

import manifold_jax as mj
from manifold_jax.multibody import Assembly, Body, GROUND, Revolute, Spherical


# A top without symmetry.
TOP = mj.problems.heavy_top(inertia=(0.5, 0.7, 0.3), center=(0.1, 0.2, 0.5))


def at_end(sol):
    return jax.tree.map(lambda leaf: leaf[-1], sol.ys)


def solve(problem, order, t1, steps, args=None, **options):
    args = problem.args if args is None else args
    options = {"max_steps": steps + 1, "y0": problem.y0, "t0": 0.0} | options
    y0, t0 = options.pop("y0"), options.pop("t0")
    solver = mj.rattle(problem.system, order=order)
    return mj.diffeqsolve(problem.terms, solver, t0, t1, (t1 - t0) / steps, y0, args, **options)


@pytest.mark.parametrize(
    ("problem", "order", "steps"),
    [
        (TOP, 2, 200),
        pytest.param(TOP, 6, 50, marks=pytest.mark.slow),
        pytest.param(mj.problems.slider_crank(), 2, 200, marks=pytest.mark.slow),
    ],
)
def test_order(problem, order, steps):
    """Against independent solutions. The slider-crank has friction."""
    exact, errors = problem.reference(1.0), []
    for number in (steps, 2 * steps):
        sol = solve(problem, order, 1.0, number)
        ours = at_end(sol)
        assert mj.constraint_violation(problem.constraint, 1.0, ours, problem.args) < 1e-15
        assert sol.stats["largest_correction"] < 1e-14
        errors.append(max(np.max(np.abs(a - b)) for a, b in zip(ours, exact, strict=True)))
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2


def symplectic_form(momentum, y, vectors):
    """Return `dp(u) dq(w) - dp(w) dq(u)` for pairs of tangent vectors, the columns of `vectors`."""
    flat, unravel = jfu.ravel_pytree(y)
    both = lambda z: (momentum(*unravel(z)), jfu.ravel_pytree(unravel(z)[0])[0])
    dp, dq = (np.asarray(jac) @ vectors for jac in jax.jacfwd(both)(flat))
    return dp.T @ dq - dq.T @ dp


def tangent_vectors(constraint, y, args):
    """Return an orthonormal basis of the tangent space of the manifold, as columns."""
    flat, unravel = jfu.ravel_pytree(y)
    residual = lambda z: jfu.ravel_pytree(constraint(0.0, unravel(z), args))[0]
    G = np.asarray(jax.jacfwd(residual)(flat))
    return np.linalg.svd(G)[2][np.linalg.matrix_rank(G) :].T


def check_symplectic(system, momentum, y0, args, h):
    """One step maps the form onto itself; a step of another method of second order does not."""
    start, unravel = jfu.ravel_pytree(y0)
    vectors = tangent_vectors(system.constraint, y0, args)
    before, changes = symplectic_form(momentum, y0, vectors), []
    for solver in (mj.rattle(system), mj.Projected(dfx.Heun(), system.constraint)):

        def step(z, solver=solver):
            parts = system.terms, 0.0, h, unravel(z), args
            y1, *_ = solver.step(*parts, solver.init(*parts), made_jump=False)
            return jfu.ravel_pytree(y1)[0]

        step = jax.jit(step)
        moved = np.asarray(jax.jacfwd(step)(start)) @ vectors
        after = symplectic_form(momentum, unravel(step(start)), moved)
        changes.append(np.max(np.abs(after - before)) / np.max(np.abs(before)))
    assert changes[0] < 1e-13 < 1e-5 < changes[1]


def test_it_is_symplectic():
    """A top, whose mass matrix is singular."""
    mass = lambda q: TOP.system.mass_matrix(0.0, q, None, TOP.args)
    check_symplectic(TOP.system, lambda q, v: mass(q) @ v, TOP.y0, TOP.args, 0.02)


def chain():
    """Two bodies in space on a ball joint and a hinge."""
    bodies = [
        Body("upper", 1.0, (0.1, 0.3, 0.35), position=(0.5, 0.0, 0.0)),
        Body("lower", 2.0, (0.2, 0.1, 0.15), position=(1.0, 0.4, 0.2)),
    ]
    joints = [
        Spherical(GROUND, "upper", at=(0.0, 0.0, 0.0)),
        Revolute("upper", "lower", at=(1.0, 0.0, 0.0), axis=(0.0, 1.0, 1.0)),
    ]
    assembly = Assembly(bodies, joints, gravity=(0.0, 0.0, -9.81))
    spin = np.array([0.5, 1.0, 3.0])
    velocities = {body.name: np.cross(spin, body.position) for body in bodies}
    y0 = assembly.state(velocities=velocities, angular_velocities=dict.fromkeys(velocities, spin))
    return assembly, y0


@pytest.mark.slow
def test_bodies_with_joints_are_symplectic():
    assembly, y0 = chain()

    def momentum(q, v):
        matrix = assembly.system.mass_matrix(0.0, q, v, None).matrix
        return jnp.einsum("bij,bj->bi", matrix, v.coordinates).reshape(-1)

    check_symplectic(assembly.system, momentum, y0, None, 0.02)


def test_a_free_body():
    """Its angular momentum in space stays, to round-off, and there and back it is where it was."""
    body = Body("box", 2.0, (0.2, 0.5, 0.6))
    free = Assembly([body], [], gravity=(0.0, 0.0, 0.0))
    system, spin = free.system, np.array([0.3, 4.0, 0.5])
    y0 = free.state(velocities={"box": (0.1, 0.2, 0.3)}, angular_velocities={"box": spin})

    def run(t0, t1, y0):
        options = dict(saveat=dfx.SaveAt(steps=True), max_steps=1000)
        step = (t1 - t0) / 1000
        return mj.diffeqsolve(system.terms, mj.rattle(system), t0, t1, step, y0, **options)

    sol = run(0.0, 20.0, y0)
    q, v = jax.tree.map(np.asarray, sol.ys)
    a, b, c, d = np.moveaxis(q.orientation[:, 0], -1, 0)
    G = np.moveaxis(np.array([[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]), -1, 0)
    local = 2 * np.einsum("tij,tj->ti", G, v.orientation[:, 0]) * [0.2, 0.5, 0.6]
    momentum = Rotation.from_quat(q.orientation[:, 0], scalar_first=True).apply(local)
    np.testing.assert_allclose(momentum, momentum[:1] * np.ones((1000, 1)), rtol=0, atol=3e-14)
    energy = np.asarray(sum(free.energy(sol.ys)))
    error = np.max(np.abs(energy - energy[0]))  # 8e-4, without a trend
    assert abs(np.mean(energy[:500]) - np.mean(energy[500:])) < 0.01 * error
    back = run(20.0, 0.0, at_end(sol))
    for ours, start in zip(at_end(back), y0, strict=True):
        np.testing.assert_allclose(ours.coordinates, start.coordinates, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_gradients():
    """In both modes, and against differences: each parameter, in masses, inertia and forces."""
    end = lambda args: at_end(solve(TOP, 2, 0.4, 16, args))[0][1]
    args = TOP.args._replace(mass=jnp.asarray(1.0), gravity=jnp.asarray(9.81))
    reverse, forward = jax.jit(jax.grad(end))(args), jax.jit(jax.jacfwd(end))(args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), reverse, forward)
    value = jax.jit(end)
    for name in args._fields:
        slopes = slopes_by_differences(value, args, name)
        np.testing.assert_allclose(np.ravel(getattr(reverse, name)), slopes, rtol=1e-7, atol=1e-10)


@pytest.mark.slow
def test_a_batch_is_one_by_one():
    """The last of three turns too fast for its steps, which have no solution; the others do not notice."""
    q0, v0 = TOP.y0
    starts = jnp.stack([q0, q0, q0]), jnp.stack([v0, 0.5 * v0, 100 * v0])

    def one(y0):
        sol = solve(TOP, 2, 0.5, 32, y0=y0, throw=False)
        return at_end(sol), sol.result == dfx.RESULTS.successful

    together, solved = jax.jit(jax.vmap(one))(starts)
    parts = TOP.terms, mj.rattle(TOP.system), 0.0, 0.5, 0.5 / 32, starts, TOP.args
    ensemble = mj.solve_ensemble(*parts, args_axes=None, max_steps=33)
    assert solved.tolist() == [True, True, False] == (~ensemble.failed).tolist()
    for i in range(2):
        alone, _ = one(jax.tree.map(lambda x, i=i: x[i], starts))
        for a, b, c in zip(together, alone, ensemble.ys, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=0, atol=1e-13)
            np.testing.assert_allclose(c[i, -1], b, rtol=0, atol=1e-13)


def test_what_it_refuses():
    """Equations that may depend on each other."""
    system = mj.MechanicalSystem(
        TOP.system.mass_matrix.function, TOP.system.holonomic, TOP.system.force, redundant=True
    )
    with pytest.raises(ValueError, match="`rattle` needs independent ones then"):
        mj.diffeqsolve(system.terms, mj.rattle(system), 0.0, 1.0, 0.1, TOP.y0, TOP.args)
