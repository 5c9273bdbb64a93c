"""Many equations on states without masses, and the gallery's large mechanisms: as with dense matrices."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax.problems.n_four_bar import _bodies
from manifold_jax.problems.polymer import energy, polymer


BONDS = 40
ORDER = np.random.default_rng(0).permutation(BONDS)


def bonds(t, y, args):
    d = jnp.diff(y, axis=0)
    return (jnp.sum(d * d, axis=1) - (args * (1 + 0.1 * jnp.sin(t))) ** 2)[ORDER]


def drift(t, y, args):
    return jnp.stack([jnp.sin(3 * y[:, 1] + t), jnp.cos(y[:, 0])], axis=1)


def start(lengths):
    angle = jnp.sin(jnp.arange(float(BONDS)) ** 2)
    d = lengths[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    return jnp.concatenate([jnp.zeros((1, 2)), jnp.cumsum(d, axis=0)])


def end(choice, y0, lengths, hook=mj.Projected):
    constraint = mj.Constraint(bonds, structure=choice)
    field = drift if hook is mj.Stabilized else mj.tangent_field(drift, constraint)
    more = {"stabilization": mj.InvariantStabilization(5.0)} if hook is mj.Stabilized else {}
    solver = hook(dfx.Tsit5(), constraint, **more)
    sol = mj.diffeqsolve(
        dfx.ODETerm(field), solver, 0.0, 0.2, 0.02, y0, lengths, max_steps=16, consistent="project"
    )
    return sol.ys[-1]


def test_a_solve_and_its_gradients():
    """Reverse as with matrices, and as forwards; a batch as one of it."""
    lengths = 1 + 0.1 * jnp.cos(jnp.arange(float(BONDS)))
    y0 = start(lengths) + 0.01
    loss = lambda choice: lambda y0, lengths: jnp.sum(jnp.sin(end(choice, y0, lengths)))
    both = {c: jax.jit(jax.value_and_grad(loss(c), (0, 1))) for c in ("auto", "dense")}
    assert mj.Constraint(bonds).structure_at(0.0, y0, lengths).block_order.width == 1
    assert mj.Constraint(bonds, structure="dense").structure_at(0.0, y0, lengths) is None
    value, gradient = both["auto"](y0, lengths)
    expected, by_matrices = both["dense"](y0, lengths)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-10)
    for a, b in zip(gradient, by_matrices):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def moved(choice, y, lengths, projection=None):
    constraint = mj.Constraint(bonds, structure=choice)
    return mj.project(constraint, 0.3, y, lengths, projection=projection)[0]


def test_projection_of_batches_and_its_tangents():
    lengths = jnp.ones(BONDS)
    ys = start(lengths)[None] + 0.02 * jnp.sin(jnp.arange(3 * 2.0 * (BONDS + 1))).reshape(3, -1, 2)
    together = jax.vmap(lambda y: moved("sparse", y, lengths))(ys)
    for y, got in zip(ys, together):
        np.testing.assert_allclose(got, moved("dense", y, lengths), rtol=0, atol=1e-11)
    tangents = [
        jax.jvp(lambda y, c=c: moved(c, y, lengths), (ys[0],), (jnp.cos(ys[0]),))[1]
        for c in ("sparse", "dense")
    ]
    np.testing.assert_allclose(*tangents, rtol=0, atol=1e-10)


def test_weights():
    lengths = jnp.ones(BONDS)
    y = start(lengths) + 0.02 * jnp.sin(jnp.arange(2.0 * (BONDS + 1))).reshape(-1, 2)
    weights = mj.NewtonProjection(metric=1 + y[:, :1] ** 2 * jnp.ones((1, 2)))
    sparse, dense = (moved(c, y, lengths, weights) for c in ("sparse", "dense"))
    np.testing.assert_allclose(sparse, dense, rtol=0, atol=1e-11)
    assert jnp.abs(sparse - moved("sparse", y, lengths)).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("hook", [mj.LocalCoordinates, mj.Stabilized])
def test_other_approaches(hook):
    lengths = jnp.ones(BONDS)
    a, b = (
        jax.jit(lambda y, c=c: end(c, y, lengths, hook))(start(lengths)) for c in ("auto", "dense")
    )
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


def test_spheres_that_have_nothing_in_common():
    sphere = mj.Constraint(lambda t, y, args: jnp.sum(y * y, axis=1) - 1, structure="sparse")
    y = jnp.asarray(np.random.default_rng(0).normal(size=(200, 3)))
    p, info = mj.project(sphere, 0.0, y)
    assert info.success
    np.testing.assert_allclose(p, y / jnp.linalg.norm(y, axis=1)[:, None], rtol=0, atol=1e-14)


@pytest.mark.usefixtures("missing_entry")
def test_a_missing_entry_is_noticed():
    ring = lambda t, y, args: (y * jnp.roll(y, 1) - 1).at[5].add(y[0])
    y = 1 + 0.1 * jnp.sin(jnp.arange(8.0))
    _, info = mj.project(mj.Constraint(ring, structure="sparse"), 0.0, y, throw=False)
    assert not info.success


def test_refused(as_a_user_meets_it):
    with pytest.raises(ValueError, match="'auto', 'dense' or 'sparse'"):
        mj.Constraint(bonds, structure="banded")
    with pytest.raises(ValueError, match="structure='dense'"):
        mj.Constraint(bonds, structure="sparse", redundant=True)
    y = jnp.ones(40)
    with pytest.raises(ValueError, match="cumulative"):
        mj.project(mj.Constraint(lambda t, y, args: jnp.cumsum(y), structure="sparse"), 0.0, y)
    twice = lambda t, y, args: jnp.concatenate([y[:20] - 1, 2 * y[:20] - 2])
    with pytest.raises(RuntimeError, match="full rank"):
        mj.project(mj.Constraint(twice, structure="sparse"), 0.0, y + 0.1)
    redundant = mj.Constraint(twice, redundant=True)  # by matrices
    np.testing.assert_allclose(mj.project(redundant, 0.0, y + 0.1)[0][:20], 1, rtol=0, atol=1e-14)


GALLERY = {
    "polymer": lambda: mj.problems.polymer(12, t1=0.2),
    "cable-net": lambda: mj.problems.cable_net(3, 4, t1=0.2),
    "falling-truss": lambda: mj.problems.falling_truss(5, t1=0.5),
    "n-four-bar": lambda: mj.problems.n_four_bar(3, t1=0.5),
}


@pytest.mark.parametrize("build", GALLERY.values(), ids=GALLERY)
def test_accelerations_of_the_gallery(build):
    """Along the reference, as with dense matrices, and as its second differences; on the manifold."""
    problem = build()
    system, h = problem.system, 1e-3
    t = problem.t1 / 2 + h * np.array([-2, -1, 0, 1, 2])
    q, v = problem.reference(t)
    y = jnp.asarray(q[2]), jnp.asarray(v[2])
    functions = system.mass_matrix.function, system.holonomic, system.force
    a, b = (
        mj.MechanicalSystem(*functions, structure=c).accelerations(t[2], y, problem.args)
        for c in ("sparse", "dense")
    )
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)
    expected = (v[0] - 8 * v[1] + 8 * v[3] - v[4]) / (12 * h)
    np.testing.assert_allclose(a, expected, rtol=0, atol=1e-7)
    assert mj.constraint_violation(problem.constraint, t[2], y, problem.args) < 1e-12
    assert mj.constraint_violation(problem.constraint, 0.0, problem.y0, problem.args) < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("build", GALLERY.values(), ids=GALLERY)
def test_solutions_of_the_gallery(build):
    problem = build()
    system, times = problem.system, np.linspace(0, problem.t1, 4)
    functions = system.mass_matrix.function, system.holonomic, system.force
    sparse = mj.MechanicalSystem(*functions, structure="sparse")
    sol = mj.diffeqsolve(
        sparse.terms,
        mj.Projected(dfx.Dopri8(), sparse.constraint),
        0.0,
        problem.t1,
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
    )
    for got, expected in zip(sol.ys, problem.reference(times)):
        np.testing.assert_allclose(got, expected, rtol=0, atol=3e-8)
    assert mj.constraint_violation(sparse.constraint, sol.ts, sol.ys, problem.args) < 1e-15


def test_energy_of_the_polymer():
    problem = polymer(30)
    start, end = (energy(y, problem.args) for y in (problem.reference(0.0), problem.reference(1.0)))
    np.testing.assert_allclose(end, start, rtol=1e-12)
    np.testing.assert_allclose(problem.reference(1.0)[1].sum(0), problem.y0[1].sum(0), atol=1e-10)


@pytest.mark.parametrize("loops", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 40))])
def test_near_a_singular_position(loops):
    """Equations that nearly depend on each other, `angle^2` of the largest eigenvalue: accelerations
    are those of one angle, or NaN. Dense matrices leave errors of some `eps / angle^2`."""
    problem = mj.problems.n_four_bar(loops)
    system, rate = problem.system, jnp.asarray(-5.0)
    functions = system.mass_matrix.function, system.holonomic, system.force
    sparse = mj.MechanicalSystem(*functions, structure="sparse")
    pull = problem.args.gravity * ((loops + 1) / 2 + loops) / ((loops + 1) / 3 + loops)

    def error(angle):
        state = lambda angle, rate: _bodies(jnp, angle, rate, jnp.asarray(1.0), loops)
        y, (_, expected) = jax.jvp(state, (angle, rate), (rate, -pull * jnp.cos(angle)))
        return jnp.abs(sparse.accelerations(0.0, y, problem.args) - expected).max()

    angles = 10.0 ** -np.arange(1, 9)
    errors = jax.jit(jax.vmap(error))(jnp.asarray(angles))
    assert (errors[:5] < 1e-13 / angles[:5]).all()
    assert (jnp.isnan(errors[5:]) | (errors[5:] < 1e-3)).all()


@pytest.mark.slow
def test_forty_four_bars():
    """The published benchmark with its measure of the error, for which 1e-3 is high precision: twenty
    seconds and all singular positions in them."""
    problem = mj.problems.n_four_bar(40)
    ts = np.linspace(0, 20, 401)
    sol = mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        0.0,
        problem.t1,
        None,
        problem.y0,
        problem.args,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    )
    # Position and velocity of the end of the first crank.
    end, expected = (
        np.concatenate([2 * np.asarray(part)[:, 0, :2] for part in y], axis=1)
        for y in (sol.ys, problem.reference(ts))
    )
    errors = np.abs(end - expected) / np.maximum(np.abs(expected), 1e-3)
    assert np.sqrt(np.mean(errors.max(axis=1) ** 2)) < 2e-4
    violation = jax.vmap(
        lambda t, q, v: mj.constraint_violation(problem.constraint, t, (q, v), problem.args)
    )
    assert violation(ts, *sol.ys).max() < 1e-14
    weight = problem.args.mass * problem.args.gravity
    q, v = map(np.asarray, sol.ys)
    kinetic = 0.5 * np.sum(v**2 * [1.0, 1.0, 1 / 12], axis=(1, 2))
    energy = kinetic + weight * np.sum(q[:, :, 1], axis=1)
    assert np.abs(energy - energy[0]).max() < 1e-3
