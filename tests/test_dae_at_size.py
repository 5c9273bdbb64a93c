"""Differential-algebraic equations with hundreds of unknowns: found and solved with sparse matrices."""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

import manifold_jax as mj
from manifold_jax._dae import occurrence
from manifold_jax._dae.equations import ResidualEquations
from manifold_jax._linalg.condition import reciprocal_condition
from manifold_jax._linalg.sparse import factorize_sparse, SparseMatrix, SquarePattern
from manifold_jax._linalg.sparse.condensation import Condensation, Condensed


def mesh(t, x, xdot, args):
    """A square of nodes, each connected to its neighbours and to the ground by resistors. A third has
    capacitors, the others are algebraic. A current flows into the first one."""
    v, number = x["v"], x["v"].size
    beside = jnp.pad(v, 1, mode="edge")
    slopes = [
        beside[2:, 1:-1] - v,
        beside[:-2, 1:-1] - v,
        beside[1:-1, 2:] - v,
        beside[1:-1, :-2] - v,
    ]
    flows = sum(args["G"] * (d + args["cubic"] * d**3) for d in slopes)
    source = (np.arange(number).reshape(v.shape) == 0).astype(float)
    return has_capacitor(number).reshape(v.shape) * xdot["v"] - flows + v - source * jnp.sin(t)


def has_capacitor(number):
    return (np.arange(number) % 3 == 0).astype(float)


def conductances(m, G):
    """The matrix of the linear mesh."""
    K = np.eye(m * m)
    for i in range(m):
        for j in range(m):
            for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if 0 <= a < m and 0 <= b < m:
                    K[i * m + j, i * m + j] += G
                    K[i * m + j, a * m + b] -= G
    return K


def guess(m):
    return {"v": jnp.zeros((m, m))}


ARGS = {"G": jnp.asarray(2.0), "cubic": jnp.asarray(0.3)}


@functools.cache
def reduced(m, form):
    return mj.reduce_dae(mesh, guess(m), ARGS, form=form)


def random_state(dae, m, t, args):
    v = jnp.asarray(np.random.default_rng(0).normal(size=(m, m)))
    return dae.consistent_state(t, {"v": v}, args)[0]


@pytest.mark.parametrize("form", ["ode", "index-1"])
def test_linear_mesh(form):
    """Against dense matrices in NumPy."""
    m, t, args = 12, 0.4, {"G": jnp.asarray(2.0), "cubic": jnp.asarray(0.0)}
    dae = reduced(m, form)
    assert dae.system.analysis.sparsity.method == "either"
    z = random_state(dae, m, t, args)
    x, xdot = dae.outputs(t, z, args)
    K, source = conductances(m, 2.0), np.eye(m * m)[0]
    (stored,), (algebraic,) = (np.nonzero(has_capacitor(m * m) == value) for value in (1, 0))
    v = np.asarray(x["v"]).ravel()
    others = np.linalg.solve(
        K[np.ix_(algebraic, algebraic)], -K[np.ix_(algebraic, stored)] @ v[stored]
    )
    np.testing.assert_allclose(v[algebraic], others, atol=1e-13)
    rate = source * np.sin(t) - K @ v
    dv = np.asarray(xdot["v"]).ravel()
    np.testing.assert_allclose(dv[stored], rate[stored], atol=1e-12)
    others = np.linalg.solve(
        K[np.ix_(algebraic, algebraic)], -K[np.ix_(algebraic, stored)] @ dv[stored]
    )
    np.testing.assert_allclose(dv[algebraic], others, atol=1e-12)


def test_gradient_of_a_mesh():
    """Reverse mode, forward mode and differences, through the start and the outputs."""
    m, t = 12, 0.4
    dae = reduced(m, "ode")

    @jax.jit
    def loss(args):
        v = jnp.asarray(np.random.default_rng(0).normal(size=(m, m)))
        z = dae.consistent_state(t, {"v": v}, args, throw=False)[0]
        x, xdot = dae.outputs(t, z, args)
        return jnp.sum(jnp.sin(x["v"]) * xdot["v"])

    reverse = jax.grad(loss)(ARGS)
    for name in ARGS:
        along = {key: jnp.asarray(float(key == name)) for key in ARGS}
        forward = jax.jvp(loss, (ARGS,), (along,))[1]
        moved = [loss({**ARGS, name: ARGS[name] + h}) for h in (1e-5, -1e-5)]
        np.testing.assert_allclose(reverse[name], forward, rtol=1e-11)
        np.testing.assert_allclose(reverse[name], (moved[0] - moved[1]) / 2e-5, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("m", [32])
def test_a_large_mesh(m):
    dae = reduced(m, "index-1")
    assert dae.report.degrees_of_freedom == int(has_capacitor(m * m).sum())
    z = random_state(dae, m, 0.0, ARGS)
    controller = dfx.PIDController(1e-8, 1e-8)
    solver = mj.Rodas5P()
    sol = mj.diffeqsolve(dae.terms, solver, 0.0, 0.1, 1e-3, z, ARGS, stepsize_controller=controller)
    x, xdot = dae.outputs(sol.ts[-1], sol.ys[-1], ARGS)
    # The tolerance times the conductances, some tens, of flows between random voltages.
    assert np.abs(mesh(sol.ts[-1], x, xdot, ARGS)).max() < 1e-6


def test_a_long_chain_of_ratios():
    """Each rate is four times the one before: singular values over 36 decades, and yet it is solved in
    one pass."""
    n = 60

    def chain(t, x, xdot, args):
        rates = args["ratio"] * jnp.concatenate([jnp.zeros(1), xdot[:-1]])
        return xdot - rates - jnp.concatenate([x[:1], jnp.zeros(n - 1)])

    args = {"ratio": jnp.asarray(4.0)}
    dae = mj.reduce_dae(chain, jnp.ones(n), args)
    assert dae.report.condition == 1
    z, _ = dae.consistent_state(0.0, jnp.ones(n), args)
    np.testing.assert_allclose(dae.terms.vf(0.0, z, args), 4.0 ** np.arange(n), rtol=1e-12)


def test_occurrence_in_parts(monkeypatch):
    m = 4
    equations = ResidualEquations.of(mesh, guess(m), ARGS, 1)
    example = occurrence.Example.of(equations, jnp.zeros(m * m), ARGS)
    whole = occurrence.Occurrence.of(example)
    monkeypatch.setattr(occurrence, "_AT_A_TIME", 5)
    for one, other in zip(whole, occurrence.Occurrence.of(example), strict=True):
        np.testing.assert_array_equal(one, other)


# Conditions


def random_matrix(n, seed):
    random = np.random.default_rng(seed)
    return random.normal(size=(n, n)) + np.diag(np.full(n, 3.0))


def test_condition_of_blocks():
    """That of the worst block, whatever couples them, their order and their units."""
    random = np.random.default_rng(1)
    blocks = [random_matrix(5, seed) for seed in range(3)]
    blocks[1][0] = blocks[1][1] + 1e-6 * random.normal(size=5)
    whole = scipy.linalg.block_diag(*blocks)
    whole[:5, 5:] = random.normal(size=(5, 10))
    found = reciprocal_condition(sp.csr_array(whole))
    expected = min(reciprocal_condition(sp.csr_array(block)) for block in blocks)
    assert 1e-8 < expected < 1e-5
    order = random.permutation(15), random.permutation(15)
    units = np.exp(random.uniform(-15, 15, 15))
    scaled = (units[:, None] * whole * units[::-1])[np.ix_(*order)]
    for other in (found, reciprocal_condition(sp.csr_array(scaled))):
        assert expected / 30 < other < 30 * expected


@pytest.mark.parametrize("n", [5, 300])
def test_singular_matrices(n):
    A = random_matrix(n, 0)
    assert reciprocal_condition(sp.csr_array(A)) > 1e-6
    A[0] = A[1:].sum(axis=0)
    assert reciprocal_condition(sp.csr_array(A)) < 1e-13
    assert reciprocal_condition(sp.csr_array(A[:, [0, *range(n - 1)]])) < 1e-13
    A[:, 0] = 0
    assert reciprocal_condition(sp.csr_array(A)) == 0
    # Rounding in the place of a zero.
    cancelled = sp.csr_array(np.array([[1.0, 1.0, 0.0], [0.0, 1e-15, 1.0], [0.0, 0.0, 1.0]]))
    assert reciprocal_condition(cancelled) == 0


# Unknowns that are eliminated before KLU


def with_rates(n, seed):
    """A matrix of `n` unknowns, of which the first half have equations for one other each, in some order."""
    random, half = np.random.default_rng(seed), n // 2
    A = sp.lil_array((n, n))
    for p in range(half):
        A[p, p], A[p, random.integers(half, n)] = random.normal(size=2) + 2
    rest = sp.random_array((n - half, n), density=3 / n, rng=random).toarray()
    A[half:] = rest + np.eye(n)[half:] * (3 + random.normal(size=n - half))[:, None]
    order = random.permutation(n)
    return sp.csr_matrix(A.toarray()[np.ix_(order, order)])


@pytest.mark.parametrize("seed", range(3))
def test_elimination_of_rates(seed):
    A, b = with_rates(160, seed), jnp.asarray(np.random.default_rng(1).normal(size=160))
    pattern = SquarePattern(A)
    assert len(Condensation.of(pattern).eliminated) >= 70
    matrix = SparseMatrix(jnp.asarray(A.toarray()[pattern.rows, pattern.columns]), pattern)
    factors = jax.jit(lambda matrix: factorize_sparse(matrix, "klu"))(matrix)
    assert factors.usable
    assert isinstance(factors.factors.factors.first, Condensed)
    assert factors.factors.factors.use_first
    np.testing.assert_allclose(factors.solve(b), np.linalg.solve(A.toarray(), b), rtol=1e-9)
    through = jax.vjp(factors.solve, b)[1](b)[0]
    np.testing.assert_allclose(through, np.linalg.solve(A.toarray().T, b), rtol=1e-9)


def test_rates_without_a_pivot():
    """An equation whose own unknown has a coefficient of zero: then KLU takes the whole matrix."""
    A = with_rates(160, 0)
    pattern = SquarePattern(A)
    row = Condensation.of(pattern).eliminated[0]
    dense = A.toarray()
    entries = jnp.asarray(dense[pattern.rows, pattern.columns])
    entries = jnp.where((pattern.rows == row) & (pattern.columns == row), 0, entries)
    dense[row, row] = 0
    factors = factorize_sparse(SparseMatrix(entries, pattern), "klu")
    assert factors.usable
    assert not factors.factors.factors.use_first
    b = jnp.asarray(np.random.default_rng(1).normal(size=160))
    np.testing.assert_allclose(factors.solve(b), np.linalg.solve(dense, b), rtol=1e-9)
