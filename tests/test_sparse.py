"""Mechanical systems with sparse constraints: the same numbers as with dense matrices, at linear size."""

import diffrax as dfx
import jax
import jax.extend.core as jax_core
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import manifold_jax as mj
from manifold_jax._linalg.sparse import pattern, structure
from manifold_jax._linalg.sparse.elimination import Blocks, eliminate


def chain(links, choice, **kwargs):
    """A chain of the gallery, in which the default chooses by size."""
    problem = mj.problems.chain(links)
    system = problem.system
    functions = system.mass_matrix.function, system.holonomic, system.force
    return mj.MechanicalSystem(*functions, structure=choice, **kwargs), problem


def largest_difference(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(jnp.abs(x - y).max()) for x, y in leaves)


def near(y):
    """Off the manifold, everywhere differently."""
    moved = lambda x: x + 0.01 * jnp.cos(3 * jnp.arange(x.size, dtype=float)).reshape(x.shape)
    return jax.tree.map(moved, y)


def as_matrix(blocks):
    number, width, _ = blocks.diagonal.shape
    block, row, column = np.indices((number, width, width))
    parts = []
    for shift, entries in zip((-1, 0, 1), blocks):
        inside = (block + shift >= 0) & (block + shift < number)
        places = (block * width + row)[inside], ((block + shift) * width + column)[inside]
        parts.append(sp.coo_matrix((np.asarray(entries)[inside], places), (number * width,) * 2))
    return sum(part.tocsr() for part in parts)


@pytest.mark.parametrize(("number", "width"), [(3, 1), (40, 6), (300, 2), (2100, 2)])
def test_block_tridiagonal_systems(number, width):
    """In one loop, in chunks, and in chunks of chunks; not symmetric."""
    random = np.random.default_rng(0)
    parts = random.uniform(-1, 1, (3, number, width, width)) / (3 * width)
    parts[0, 0] = parts[2, -1] = 0
    parts[1] += np.eye(width)
    blocks = Blocks(*map(jnp.asarray, parts))
    b = random.normal(size=(number, width))
    solve = jax.jit(lambda blocks, b: eliminate(blocks).solve(b))
    for system, matrix in (
        (blocks, as_matrix(blocks)),
        (blocks.transposed(), as_matrix(blocks).T),
    ):
        x = np.asarray(solve(system, jnp.asarray(b)))
        np.testing.assert_allclose(matrix @ x.ravel(), b.ravel(), rtol=0, atol=1e-13)


def test_hashed_dependence_misses_nothing(monkeypatch):
    """Of a ring in a random order, next to what every number depends on."""
    n = 120
    order = np.random.default_rng(1).permutation(n)
    ring = lambda x: x[order] * x[np.roll(order, 1)]
    exact = pattern.dependence(ring, jnp.zeros(n)).toarray()
    assert exact.sum() == 2 * n
    monkeypatch.setattr(pattern, "_GROUPS", 16)
    np.testing.assert_array_equal(pattern.dependence(ring, jnp.zeros(n)).toarray(), exact)
    assert pattern.dependence(jnp.cumsum, jnp.zeros(n)) is None


def test_structures_that_are_found_again(monkeypatch):
    """Of those that were forgotten meanwhile, too."""
    neighbours = lambda x: jnp.diff(x) * x[1:]
    first = structure.structure_of(((neighbours, jnp.ones(40)),))
    monkeypatch.setattr(structure, "_FOUND", {})
    again = structure.structure_of(((neighbours, jnp.ones(40)),))
    assert first is not again
    assert first == again
    assert hash(first) == hash(again)
    assert first != structure.structure_of(((neighbours, jnp.ones(41)),))


def test_orders():
    """A chain whose equations are given in a random order, and one that is closed."""
    n = 50
    order = np.random.default_rng(1).permutation(n - 1)
    difference = lambda x: jnp.diff(x)[order]
    depends = pattern.dependence(difference, jnp.zeros(n))
    found = structure.Structure(depends, 1)
    assert found.block_order.width == 1
    assert found.num_colors == 2
    np.testing.assert_array_equal(
        found.block_order.order[found.block_order.places], np.arange(n - 1)
    )
    closed = sp.csr_matrix(np.eye(n, dtype=bool) | np.roll(np.eye(n, dtype=bool), 1, axis=1))
    assert structure.Structure(closed, 1).block_order.width == 2


ORDER = np.random.default_rng(0).permutation(7)


def arm(structure, masses="blocks"):
    """Four planar bodies with joints, of which the last one does not slip sideways: blocks of
    masses, one of them singular but for the constraint of its body alone."""
    random = np.random.default_rng(0)
    A = random.normal(size=(4, 3, 3))
    M = A @ A.swapaxes(1, 2) + np.eye(3)
    direction = np.array([0.3, 1.0, -0.2])
    P = np.eye(3) - np.outer(direction, direction) / (direction @ direction)
    M[3] = P @ M[3] @ P

    def joints(t, q, args):
        q = q.reshape(4, 3)
        end = q[:, :2] + args * jnp.stack([jnp.cos(q[:, 2]), jnp.sin(q[:, 2])], axis=1)
        start = q[:, :2] - args * jnp.stack([jnp.cos(q[:, 2]), jnp.sin(q[:, 2])], axis=1)
        gaps = start[1:] - end[:-1] - 0.1 * jnp.sin(t)
        return jnp.append(gaps.reshape(-1), q[3] @ direction - 0.5 * q[3, 0] ** 2)[ORDER]

    def force(t, q, v, args):
        return jnp.sin(jnp.arange(12.0)) - 0.1 * v

    def slip(t, q, v, args):
        return v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2])

    M = jax.scipy.linalg.block_diag(*M) if masses == "full" else M
    return mj.MechanicalSystem(M, joints, force, velocity_constraint=slip, structure=structure)


@pytest.mark.slow
def test_blocks_of_masses_and_constraints_on_velocities():
    y = (0.3 * jnp.cos(jnp.arange(12.0) ** 2), 0.2 * jnp.sin(jnp.arange(12.0)))
    args = jnp.asarray(0.4)

    def values(system, y, args):
        corrected, info = system.constraint.correct(mj.NewtonProjection(), 0.3, y, args, far=True)
        a, multipliers = (
            f(0.3, corrected, args) for f in (system.accelerations, system.multipliers)
        )
        return (corrected, a, multipliers), info.success

    def both(system):
        scalar = lambda y, args: sum(
            map(jnp.sum, map(jnp.sin, jax.tree.leaves(values(system, y, args)[0])))
        )
        return *values(system, y, args), jax.grad(scalar, argnums=(0, 1))(y, args)

    sparse, success, gradient = jax.jit(lambda: both(arm("sparse")))()
    assert success
    dense, _, expected = jax.jit(lambda: both(arm("dense", "full")))()
    assert largest_difference(sparse, dense) < 1e-10
    assert largest_difference(gradient, expected) < 1e-9
    other = jax.jit(lambda y: arm("dense").accelerations(0.3, y, args))(sparse[0])
    assert largest_difference(other, dense[1]) < 1e-10


def test_a_solve_is_that_of_dense_matrices():
    """With corrected outputs; by itself the larger one is sparse."""
    for_comparison = {}
    for choice in ("dense", "auto"):
        system, problem = chain(40, choice)
        assert (system.constraint.structure_at(0.0, problem.y0, problem.args) is None) == (
            choice == "dense"
        )
        for_comparison[choice] = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            0.05,
            None,
            near(problem.y0),
            problem.args,
            saveat=dfx.SaveAt(ts=jnp.linspace(0, 0.05, 4)),
            stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
        )
    dense, sparse = for_comparison["dense"], for_comparison["auto"]
    assert largest_difference(dense.ys, sparse.ys) < 1e-10
    violation = mj.constraint_violation(system.constraint, sparse.ts, sparse.ys, problem.args)
    assert violation < 1e-15
    by_dense, _ = chain(40, "dense")
    expected = mj.constraint_violation(by_dense.constraint, 0.0, near(problem.y0), problem.args)
    got = mj.constraint_violation(system.constraint, 0.0, near(problem.y0), problem.args)
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def largest_array(jaxpr):
    sizes = [np.prod(v.aval.shape, dtype=int) for e in jaxpr.eqns for v in e.outvars]
    inner = [largest_array(j) for e in jaxpr.eqns for j in jax_core.jaxprs_in_params(e.params)]
    return max([0, *sizes, *inner])


def test_no_array_grows_with_the_square():
    """Of a whole solve and its gradient."""
    links = 512
    system, problem = chain(links, "sparse")

    def loss(args):
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            0.1,
            0.01,
            problem.y0,
            args,
            max_steps=16,
        )
        return jnp.sum(sol.ys[0])

    of_solve = largest_array(jax.make_jaxpr(loss)(problem.args).jaxpr)
    of_gradient = largest_array(jax.make_jaxpr(jax.grad(loss))(problem.args).jaxpr)
    assert of_solve < links**2 / 2
    assert of_gradient < links**2 / 2  # more than 17 states


@pytest.mark.slow
@pytest.mark.parametrize("links", [100, 1000])
def test_gradient_against_differences(links):
    system, problem = chain(links, "sparse")

    @jax.jit
    def loss(args):
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            0.1,
            0.01,
            problem.y0,
            args,
            max_steps=16,
        )
        return jnp.sum(sol.ys[0] ** 2) / links**2

    random = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: jnp.asarray(random.normal(size=jnp.shape(x))), problem.args)
    at = lambda e: loss(jax.tree.map(lambda x, d: x + e * d, problem.args, direction))
    h = 1e-3
    expected = (at(-2 * h) - 8 * at(-h) + 8 * at(h) - at(2 * h)) / (12 * h)
    gradient = jax.grad(loss)(problem.args)
    got = sum(map(jnp.sum, jax.tree.leaves(jax.tree.map(jnp.multiply, gradient, direction))))
    np.testing.assert_allclose(got, expected, rtol=1e-7)


def test_batches_and_single_precision():
    system, problem = chain(7, "sparse")
    random = np.random.default_rng(0)
    lengths = jnp.asarray(random.uniform(0.5, 2.0, (3, 7)))

    def values(lengths, y):
        args = problem.args._replace(lengths=lengths)
        corrected, _ = system.constraint.correct(mj.NewtonProjection(), 0.0, y, args, far=True)
        return corrected, system.multipliers(0.0, corrected, args)

    together = jax.jit(jax.vmap(values, in_axes=(0, None)))(lengths, near(problem.y0))
    one = jax.jit(values)(lengths[1], near(problem.y0))
    assert largest_difference(jax.tree.map(lambda x: x[1], together), one) < 1e-12
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (problem.y0, problem.args))
    a = system.accelerations(0.0, *single)
    assert a.dtype == jnp.float32
    np.testing.assert_allclose(
        a, system.accelerations(0.0, problem.y0, problem.args), rtol=0, atol=1e-4
    )


def test_bodies_that_are_not_connected():
    """Two pendulums and a free point."""

    def rods(t, q, args):
        return jnp.stack([q[0:2] @ q[0:2] - 1, q[4:6] @ q[4:6] - 1])

    force = lambda t, q, v, args: jnp.tile(jnp.array([0.0, -9.81]), 3)
    y = jnp.array([1.0, 0.0, 5.0, 5.0, 0.0, -1.0]), jnp.array([0.0, 1.0, 2.0, 0.0, 3.0, 0.0])
    systems = [mj.MechanicalSystem(1.0, rods, force, structure=s) for s in ("sparse", "dense")]
    a, b = (jax.jit(lambda y, s=s: s.accelerations(0.0, y))(y) for s in systems)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


def test_positions_that_are_too_few_to_be_sparse_alone():
    """Twenty equations for positions and twenty for velocities."""

    def rods(t, q, args):
        return jnp.sum(q.reshape(20, 3)[:, :2] ** 2, axis=1) - 1

    def skates(t, q, v, args):
        q, v = q.reshape(20, 3), v.reshape(20, 3)
        return v[:, 2] - jnp.sin(q[:, 2]) * v[:, 0]

    force = lambda t, q, v, args: -q
    y = near((jnp.tile(jnp.array([0.6, 0.8, 0.3]), 20), jnp.linspace(0.1, 0.5, 60)))
    corrected = []
    for choice in ("auto", "dense"):
        system = mj.MechanicalSystem(2.0, rods, force, velocity_constraint=skates, structure=choice)
        assert system.constraint.is_sparse(0.0, y, None) == (choice == "auto")
        corrected.append(jax.jit(lambda y, c=system.constraint: mj.project(c, 0.0, y)[0])(y))
    assert largest_difference(*corrected) < 1e-13


def test_dependent_equations_are_refused_at_the_start():
    system, problem = chain(6, "sparse")
    twice = lambda t, q, args: jnp.concatenate(
        [system.holonomic(t, q, args), 2 * system.holonomic(t, q, args)[2:3]]
    )
    dependent = mj.MechanicalSystem(system.mass_matrix, twice, system.force, structure="sparse")
    with pytest.raises(RuntimeError, match="full rank"):
        mj.consistent_state(dependent.constraint, 0.0, problem.y0, problem.args)


@pytest.mark.usefixtures("missing_entry")
def test_a_missing_entry_is_noticed():
    system, problem = chain(6, "sparse")
    closed = lambda t, q, args: system.holonomic(t, q, args).at[5].add(q[0])
    ring = mj.MechanicalSystem(system.mass_matrix, closed, system.force, structure="sparse")
    y = near(problem.y0)
    _, info = mj.consistent_state(ring.constraint, 0.0, y, problem.args, throw=False)
    assert not info.full_rank
    assert not info.success
    assert jnp.isnan(ring.accelerations(0.0, y, problem.args)).all()


def test_refused(as_a_user_meets_it):
    system, problem = chain(40, "sparse")
    functions = system.mass_matrix, system.holonomic, system.force
    with pytest.raises(ValueError, match="'auto', 'dense' or 'sparse'"):
        mj.MechanicalSystem(*functions, structure="banded")
    with pytest.raises(ValueError, match="redundant=True"):
        mj.MechanicalSystem(*functions, structure="sparse", redundant=True)

    def accelerations(mass, constraint, choice, args=problem.args):
        changed = mj.MechanicalSystem(mass, constraint, system.force, structure=choice)
        return jax.jit(lambda y: changed.accelerations(0.0, y, args))(problem.y0)

    with pytest.raises(ValueError, match="full matrix"):
        accelerations(jnp.eye(80), system.holonomic, "sparse")
    height = lambda t, q, args: jnp.cumsum(q.reshape(-1, 2)[:, 1]) + q[0]
    with pytest.raises(ValueError, match="cumulative"):
        accelerations(system.mass_matrix, height, "sparse")
    assert jnp.isfinite(accelerations(system.mass_matrix, height, "auto")).all()

    picked = lambda t, q, args: q.reshape(-1, 2)[args[1], 1]
    pair = mj.MechanicalSystem(1.0, picked, lambda t, q, v, args: -q, structure="sparse")
    with pytest.raises(ValueError, match="closes over"):
        jax.jit(lambda args: pair.accelerations(0.0, problem.y0, args))((0.0, jnp.arange(40)))
