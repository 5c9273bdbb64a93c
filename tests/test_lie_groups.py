"""Charts of Lie groups: exact maps, the order of the solver, published motions."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from variants import variants

import manifold_jax as mj
from manifold_jax.problems.heavy_top import BENCHMARK, BENCHMARK_QUATERNION


def hat(w):
    """The matrix of `w x`."""
    return np.cross(np.eye(3), np.asarray(w))


TURN = scipy.linalg.expm(hat([0.3, -0.7, 0.4]))
PLACE = np.block([[TURN, np.array([[0.5], [-1.0], [2.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
GROUPS = {
    "so3": (mj.SO3(), jnp.asarray(TURN), mj.Stiefel()),
    "quaternion": (mj.UnitQuaternion(), jnp.array([0.5, 0.5, -0.5, 0.5]), mj.Sphere()),
    "se3": (
        mj.SE3(),
        jnp.asarray(PLACE),
        mj.Constraint(lambda t, y, args: mj.Stiefel()(t, y[:3, :3])),
    ),
}
MAPS = ["exponential", "cayley"]


@pytest.mark.parametrize("coordinates", MAPS)
@pytest.mark.parametrize("name", GROUPS)
def test_rates_belong_to_the_map(name, coordinates):
    """`y phi(w)` moves as `w'` says, at the origin, near it and far from it."""
    group, y, _ = GROUPS[name]
    rng = np.random.default_rng(0)
    cayley = coordinates == "cayley"

    @jax.jit
    def rates(w, w_dot):
        z, z_dot = jax.jvp(lambda w: group.moved(y, w, cayley), (w,), (w_dot,))
        velocity = group.velocity(z, z_dot)
        return group.rate(w, velocity, cayley), group.tangent(z, velocity) - z_dot, z

    for size in (0.0, 1e-8, 1e-3, 0.3, 0.49, 0.51, 1.7, 3.0):
        w = rng.normal(size=group.dimension)
        w, w_dot = size * w / np.linalg.norm(w[:3]), rng.normal(size=group.dimension)
        rate, gap, z = rates(jnp.asarray(w), jnp.asarray(w_dot))
        np.testing.assert_allclose(rate, w_dot, atol=2e-14)
        np.testing.assert_allclose(gap, 0, atol=2e-14)
        if name == "se3":
            W = np.zeros((4, 4))
            W[:3, :3], W[:3, 3] = hat(w[:3]), w[3:]
            one = np.eye(4)
            phi = scipy.linalg.solve(one - W / 2, one + W / 2) if cayley else scipy.linalg.expm(W)
            np.testing.assert_allclose(z, np.asarray(y) @ phi, atol=2e-14)


@pytest.mark.parametrize("name", GROUPS)
def test_matrices_and_quaternions_turn_alike(name):
    """All three by the same rotation."""
    group, y, _ = GROUPS[name]
    w = jnp.array([0.4, -1.1, 0.8])
    expected = scipy.linalg.expm(hat(w))
    w = jnp.concatenate([w, jnp.zeros(group.dimension - 3)])
    start = jnp.array([1.0, 0, 0, 0]) if name == "quaternion" else jnp.eye(y.shape[0])
    z = group.moved(start, w, False)
    np.testing.assert_allclose(as_matrix(z), expected, atol=1e-15)


def as_matrix(y):
    if y.ndim == 2:
        return np.asarray(y)[:3, :3]
    s, v = y[0], np.asarray(y[1:])
    return (s**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * s * hat(v)


def velocity(t, y):
    """In the body, and depending on where it is, so that nothing commutes. (Of each group one for
    which the leading term of the error dominates in the range of steps below.)"""
    x = jnp.ravel(y)
    if x.size == 4:
        w = jnp.stack([2 * jnp.cos(2 * t), 1.7 * x[0], x[1] - 0.5])
    else:
        w = jnp.stack([1 + jnp.sin(t), -2 * x[1], 1.2 * x[2] ** 2])
    return jnp.concatenate([w, jnp.stack([0.2 * t, x[2], -0.4 * jnp.ones_like(t)])])


SOLVERS = [(dfx.Heun(), 2), (dfx.Bosh3(), 3), (dfx.Dopri5(), 5), (dfx.Tsit5(), 5)]


@pytest.mark.parametrize("coordinates", variants(MAPS, ["exponential"]))
@pytest.mark.parametrize("name", variants(GROUPS, ["so3", "quaternion"]))
def test_order(name, coordinates):
    """That of the wrapped solver, fitted over a range of steps, for SciPy's solution."""
    group, y0, constraint = GROUPS[name]
    field = lambda t, y, args: group.tangent(y, velocity(t, y)[: group.dimension])
    compiled = jax.jit(lambda t, y: field(t, y, None))
    flat = lambda t, x: np.ravel(compiled(t, jnp.asarray(x.reshape(y0.shape))))
    reference = scipy.integrate.solve_ivp(
        flat, (0, 3), np.ravel(y0), method="DOP853", rtol=3e-14, atol=1e-15
    ).y[:, -1]
    chart = mj.LieGroupChart(group, coordinates)
    for solver, order in [*SOLVERS[:2], SOLVERS[3 if name == "quaternion" else 2]]:
        hook = mj.LocalCoordinates(solver, constraint, chart=chart)

        @jax.jit
        def end(h, hook=hook):
            return mj.diffeqsolve(dfx.ODETerm(field), hook, 0.0, 3.0, h, y0, max_steps=200).ys[0]

        steps = np.array([60, 84, 120, 168])
        ends = [end(jnp.asarray(3.0 / n)) for n in steps]
        errors = [np.sqrt(np.mean((np.ravel(e) - reference) ** 2)) for e in ends]
        slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
        assert abs(slope - order) < 0.2, (solver, slope, errors)
        assert max(mj.constraint_violation(constraint, 3.0, e) for e in ends) < 1e-15


def test_uniform_rotation_is_exact():
    """One step of Euler's method for a third of a turn."""
    chart = mj.LieGroupChart(mj.SO3())
    hook = mj.LocalCoordinates(dfx.Euler(), mj.Stiefel(), chart=chart)
    w = jnp.array([0.8, -1.2, 1.5])
    field = dfx.ODETerm(lambda t, y, args: mj.SO3().tangent(y, w))
    sol = mj.diffeqsolve(field, hook, 0.0, 1.0, 1.0, jnp.asarray(TURN))
    expected = TURN @ scipy.linalg.expm(hat(w))
    np.testing.assert_allclose(sol.ys[0], expected, atol=1e-15)


PRODUCT = mj.Product((mj.Sphere(), None))


def top(inertia, load):
    """`load` is weight times centre of mass."""

    def field(t, y, args):
        (a, b, c, d), w = y
        up = jnp.stack([2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d])
        torque = jnp.cross(inertia * w, w) - jnp.cross(load, up)
        return mj.UnitQuaternion().tangent(y[0], w), torque / inertia

    return dfx.ODETerm(field)


def spun(terms, solver, t1, y0, tolerance, coordinates="exponential", **options):
    chart = mj.LieGroupChart((mj.UnitQuaternion(), None), coordinates)
    return mj.diffeqsolve(
        terms,
        mj.LocalCoordinates(solver, PRODUCT, chart=chart),
        0.0,
        t1,
        None,
        y0,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        **options,
    )


@pytest.mark.parametrize("coordinates", MAPS)
def test_published_heavy_top(coordinates):
    """Its orientation after 2 s and 47 turns, to the digits that are published."""
    inertia, center = (jnp.array(BENCHMARK[name]) for name in ("inertia", "center"))
    load = BENCHMARK["mass"] * BENCHMARK["gravity"] * center
    y0 = jnp.array(BENCHMARK["orientation"]), jnp.array(BENCHMARK["spin"])
    sol = spun(top(inertia, load), dfx.Dopri8(), 2.0, y0, 1e-9, coordinates, max_steps=16384)
    np.testing.assert_allclose(sol.ys[0][0], BENCHMARK_QUATERNION, atol=5e-6)
    np.testing.assert_allclose(sol.ys[0][0] @ sol.ys[0][0], 1, rtol=0, atol=1e-15)


def test_free_rigid_body_against_the_exact_solution():
    """Elliptic functions for the momentum in the body; in space it is constant."""
    problem = mj.problems.rigid_body(t1=10.0)
    inertia, y0 = problem.args.inertia, np.asarray(problem.y0)
    start = jnp.array([1.0, 0, 0, 0]), problem.y0 / inertia
    ts = jnp.linspace(0.0, 10.0, 21)
    saveat = dfx.SaveAt(ts=ts, dense=True)
    sol = spun(top(inertia, jnp.zeros(3)), dfx.Dopri8(), 10.0, start, 1e-11, saveat=saveat)
    momentum = np.asarray(sol.ys[1]) * np.asarray(inertia)
    np.testing.assert_allclose(momentum, problem.reference(np.asarray(ts)), atol=1e-9)
    in_space = [as_matrix(q) @ L for q, L in zip(sol.ys[0], momentum)]
    np.testing.assert_allclose(in_space, np.broadcast_to(y0, (21, 3)), atol=1e-9)
    between = jax.vmap(sol.evaluate)(jnp.asarray([0.123, 4.567, 9.87]))
    violation = mj.constraint_violation(PRODUCT, jnp.array([0.123, 4.567, 9.87]), between)
    assert violation < 1e-15
    np.testing.assert_allclose(
        np.asarray(between[1]) * np.asarray(inertia),
        problem.reference(np.array([0.123, 4.567, 9.87])),
        atol=1e-6,
    )


def end_of_turn(speed, adjoint, solver=None):
    group = mj.SO3()

    def field(t, y, speed):
        w = speed * jnp.stack([jnp.cos(t), 0.5 * y[0, 0], y[1, 2]])
        return group.tangent(y, w)

    chart = mj.LieGroupChart(group)
    hook = mj.LocalCoordinates(solver or dfx.Bosh3(), mj.Stiefel(), chart=chart)
    sol = mj.diffeqsolve(
        dfx.ODETerm(field),
        hook,
        0.0,
        1.0,
        0.05,
        jnp.asarray(TURN),
        speed,
        adjoint=adjoint,
        max_steps=32,
    )
    return sol.ys[0][0, 1] + 0.3 * sol.ys[0][2, 2]


@pytest.mark.parametrize("solver", variants([dfx.Bosh3(), dfx.Kvaerno3()], [dfx.Bosh3()]))
def test_gradients_and_batches(solver):
    """Forward = reverse = differences; vmapped = single. With an implicit solver, too, of which the
    derivative carried from step to step would belong to other coordinates."""
    if isinstance(solver, dfx.Kvaerno3):
        finder = dfx.VeryChord(rtol=1e-9, atol=1e-9)
        solver = dfx.Kvaerno3(root_finder=finder)
    run = jax.jit(jax.value_and_grad(lambda s: end_of_turn(s, mj.StepReplayAdjoint(), solver)))
    values, reverse = zip(run(1.3), run(0.4))
    difference = (run(1.3 + 1e-5)[0] - run(1.3 - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(reverse[0], difference, rtol=1e-7)
    forward = lambda s: jax.jvp(
        lambda s: end_of_turn(s, dfx.ForwardMode(), solver), (s,), (jnp.ones(()),)
    )
    batch, slopes = jax.jit(jax.vmap(forward))(jnp.array([1.3, 0.4]))
    np.testing.assert_allclose(batch, values, rtol=1e-12)
    np.testing.assert_allclose(slopes, reverse, rtol=1e-10)


def test_a_step_of_more_than_half_a_turn_is_rejected():
    w = jnp.array([3.0, 1.0, 0.5])
    field = dfx.ODETerm(lambda t, y, args: mj.SO3().tangent(y, w))
    hook = mj.LocalCoordinates(dfx.Heun(), mj.Stiefel(), chart=mj.LieGroupChart(mj.SO3()))
    run = lambda controller: mj.diffeqsolve(
        field, hook, 0.0, 2.0, 2.0, jnp.eye(3), stepsize_controller=controller, throw=False
    )
    adaptive = run(dfx.PIDController(rtol=1e-6, atol=1e-6))
    assert adaptive.result == dfx.RESULTS.successful
    assert adaptive.stats["num_rejected_steps"] >= 1
    assert run(dfx.ConstantStepSize()).result != dfx.RESULTS.successful


class Motions2(mj.AbstractLieGroup):
    """Of somebody else: motions of the plane as `(angle, x, y)`, moved by the angle first."""

    dimension = 3

    def tangent(self, y, velocity):
        c, s = jnp.cos(y[0]), jnp.sin(y[0])
        u = velocity[1:]
        return jnp.stack([velocity[0], c * u[0] - s * u[1], s * u[0] + c * u[1]])

    def velocity(self, y, tangent):
        return self.tangent(-y, tangent)

    def moved(self, y, w, cayley):
        c, s = jnp.cos(y[0]), jnp.sin(y[0])
        return y + jnp.stack([w[0], c * w[1] - s * w[2], s * w[1] + c * w[2]])

    def rate(self, w, velocity, cayley):
        c, s = jnp.cos(w[0]), jnp.sin(w[0])
        u = velocity[1:]
        return jnp.stack([velocity[0], c * u[0] - s * u[1], s * u[0] + c * u[1]])

    def is_within(self, w, cayley):
        return jnp.isfinite(w).all() & (jnp.abs(w[0]) < 2.0)


def test_a_group_of_somebody_else():
    """It may move as far as it says, whatever its components mean."""
    group = Motions2()
    field = dfx.ODETerm(lambda t, y, args: group.tangent(y, jnp.array([0.1, 100.0, 0.0])))
    constraint = mj.Constraint(lambda t, y, args: y[0] - 0.1 * t)  # of what is known anyway
    hook = mj.LocalCoordinates(dfx.Tsit5(), constraint, chart=mj.LieGroupChart(group))
    sol = mj.diffeqsolve(field, hook, 0.0, 1.0, 1.0, jnp.zeros(3))
    expected = [0.1, 1000 * np.sin(0.1), 1000 * (1 - np.cos(0.1))]
    np.testing.assert_allclose(sol.ys[0], expected, rtol=1e-9)


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_arguments():
    with pytest.raises(ValueError, match="`coordinates`.*'exponential' or 'cayley'"):
        mj.LieGroupChart(mj.SO3(), "euler")
    for groups in (None, "so3", (None, None)):
        with pytest.raises(TypeError, match="`groups`"):
            mj.LieGroupChart(groups)
    field = dfx.ODETerm(lambda t, y, args: y)
    solve = lambda chart, terms, y0: mj.diffeqsolve(
        terms, mj.LocalCoordinates(dfx.Heun(), mj.Sphere(), chart=chart), 0.0, 1.0, 0.1, y0
    )
    with pytest.raises(ValueError, match=r"`mj.UnitQuaternion\(\)` must have shape \(4,\)"):
        solve(mj.LieGroupChart(mj.UnitQuaternion()), field, jnp.ones(3))
    with pytest.raises(ValueError, match="`groups`.*like the state"):
        solve(mj.LieGroupChart((mj.UnitQuaternion(), None)), field, jnp.ones(4))
    path = dfx.VirtualBrownianTree(0.0, 1.0, 1e-2, (), jax.random.key(0))
    noise = dfx.MultiTerm(field, dfx.ControlTerm(lambda t, y, args: y, path))
    with pytest.raises(ValueError, match="noise"):
        solve(mj.LieGroupChart(mj.UnitQuaternion()), noise, jnp.array([1.0, 0, 0, 0]))
