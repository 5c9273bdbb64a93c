"""Rosenbrock methods whose linear systems are solved with sparse matrices."""

import re
import subprocess
import sys

import diffrax as dfx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

import manifold_jax as mj
from manifold_jax._base.klu import has_klu
from manifold_jax._jaxpr.trace import num_equations
from manifold_jax._linalg.sparse import factorize_sparse, SparseMatrix, SquarePattern
from manifold_jax._rosenbrock import sparsity
from manifold_jax._rosenbrock.algebraic import consistent


needs_klu = pytest.mark.skipif(not has_klu(jnp.float64), reason="klujax is not installed")
METHODS = ["tridiagonal", "multi-elimination"]
METHODS += [pytest.param(method, marks=needs_klu) for method in ("klu", "either")]


def banded(method: str, n: int, seed: int = 0) -> sp.csr_matrix:
    """A matrix with two diagonals beside the main one, in a random order."""
    random, below = np.random.default_rng(seed), 1 if method == "tridiagonal" else 2
    A = sp.diags([random.normal(size=n - k) for k in (below, 1)], [-below, 1], shape=(n, n))
    A = sp.csr_matrix(A + sp.diags(3 + random.uniform(size=n)))
    order = random.permutation(n)
    return sp.csr_matrix(A[order][:, order])


def from_scipy(A: sp.csr_matrix) -> SparseMatrix:
    pattern = SquarePattern(sp.csr_matrix(A != 0))
    return SparseMatrix(jnp.asarray(A.toarray()[pattern.rows, pattern.columns]), pattern)


@pytest.mark.parametrize("method", METHODS)
def test_systems_and_their_derivatives(method):
    A, b = banded(method, 50), jnp.asarray(np.random.default_rng(1).normal(size=50))
    sparse, direction = from_scipy(A), from_scipy(banded(method, 50, 2) * (A != 0))
    direction = SparseMatrix(jnp.cos(jnp.arange(sparse.entries.size)), sparse.pattern)
    dA = np.zeros((50, 50))
    dA[sparse.pattern.rows, sparse.pattern.columns] = direction.entries

    def solve(entries, b):
        return factorize_sparse(SparseMatrix(entries, sparse.pattern), method).solve(b)

    x = np.linalg.solve(A.toarray(), b)
    np.testing.assert_allclose(jax.jit(solve)(sparse.entries, b), x, rtol=1e-12, atol=1e-13)
    first = -np.linalg.solve(A.toarray(), dA @ x)
    second = -2 * np.linalg.solve(A.toarray(), dA @ first)
    along = lambda s: solve(sparse.entries + s * direction.entries, b)
    tangent = lambda s: jax.jvp(along, (s,), (1.0,))[1]
    np.testing.assert_allclose(tangent(0.0), first, rtol=1e-11, atol=1e-12)
    _, found = jax.jvp(tangent, (0.0,), (1.0,))
    np.testing.assert_allclose(found, second, rtol=1e-10, atol=1e-11)
    weights = jnp.sin(jnp.arange(50.0))
    by_entries, by_b = jax.vjp(solve, sparse.entries, b)[1](weights)
    adjoint = np.linalg.solve(A.toarray().T, weights)
    np.testing.assert_allclose(by_b, adjoint, rtol=1e-12, atol=1e-13)
    expected = -adjoint[sparse.pattern.rows] * x[sparse.pattern.columns]
    np.testing.assert_allclose(by_entries, expected, rtol=1e-11, atol=1e-12)
    batch = jax.vmap(solve)(jnp.stack([sparse.entries, 2 * sparse.entries]), jnp.stack([b, b]))
    np.testing.assert_allclose(batch, np.stack([x, x / 2]), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("transversal", ["diagonal", "elsewhere"])
@pytest.mark.parametrize("size", [5, 60, 300])
def test_multi_elimination_of_random_matrices(size, transversal):
    """Also those whose rows have to be exchanged for a diagonal without zeros, in the only way that there is."""
    random = np.random.default_rng(size)
    A = sp.random(size, size, 2 / size, random_state=random).toarray()
    A += np.diag(random.uniform(3, 4, size))
    if transversal == "elsewhere":
        A = np.tril(A)[random.permutation(size)]
    b = random.normal(size=size)

    @jax.jit
    def solve(sparse, b):
        factor = factorize_sparse(sparse, "multi-elimination")
        x, transpose = jax.vjp(factor.solve, b)
        return factor.usable, factor.factors.factors.num_solves, x, transpose(b)[0]

    usable, num_solves, x, of_transposed = solve(from_scipy(sp.csr_matrix(A)), jnp.asarray(b))
    assert usable
    assert num_solves == 1
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-10)
    np.testing.assert_allclose(of_transposed, np.linalg.solve(A.T, b), rtol=1e-10)


@pytest.mark.parametrize("method", METHODS[1:2] + METHODS[3:])
def test_small_pivots(method):
    """Without exchanges of rows pivots of 1e-9 cost half of all digits, which a refinement finds. Those
    of 1e-14 cost all of them: then KLU is what is left."""
    random, n = np.random.default_rng(0), 50
    A = np.diag(random.uniform(3, 4, n)) + np.diag(random.normal(size=n - 1), 1)
    A += np.diag(random.normal(size=n - 2), -2)
    b = random.normal(size=n)

    @jax.jit
    def solve(sparse, b):
        factor = factorize_sparse(sparse, method)
        x, transpose = jax.vjp(factor.solve, b)
        factors = factor.factors.factors
        first = factors.first if method == "either" else factors
        return factor.usable, first.num_solves, x, transpose(b)[0]

    for pivot, is_usable in ((1e-9, True), (1e-14, method == "either")):
        A[::10, ::10] = np.diag([pivot] * 5)
        usable, num_solves, x, of_transposed = solve(from_scipy(sp.csr_matrix(A)), jnp.asarray(b))
        assert usable == is_usable
        assert num_solves == 2
        if usable:
            np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9)
            np.testing.assert_allclose(of_transposed, np.linalg.solve(A.T, b), rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fault", ["equal rows", "a column", "zero row", "zero column", "nan"])
def test_singular_matrices_are_not_usable(method, fault):
    A = banded(method, 50)
    i = next(j for j in A[3].indices if j != 3)
    pair = sp.csr_matrix(([True, True], ([3, i], [i, 3])), A.shape)
    pattern = SquarePattern(sp.csr_matrix((A != 0) + pair))
    A = A.toarray()
    if fault == "equal rows":
        A[3] = A[i] = 0
        A[[3, 3, i, i], [3, i, 3, i]] = 1.0
    elif fault == "a column":  # has all entries of two rows
        A[3] = A[i] = 0
        A[[3, i], 3] = 1.0, 2.0
    elif fault == "zero row":
        A[3] = 0
    elif fault == "zero column":
        A[:, 3] = 0
    else:
        A[3, 3] = np.nan
    entries = jnp.asarray(A[pattern.rows, pattern.columns])
    factor = factorize_sparse(SparseMatrix(entries, pattern), method)
    assert not factor.usable
    assert jnp.all(jnp.isfinite(factor.solve(jnp.ones(50))))


def filters(n, shift=0):
    """Low-pass filters in a row: voltages `v` of capacitors, which leak to the second before them, and `e` of
    the nodes between two resistors and a diode. With a `shift` no algebraic equation is in the place of its unknown."""

    def ladder(t, y, args):
        frequency, resistance, capacitance = args
        v, e = y["v"], jnp.roll(y["e"], shift)
        left = jnp.concatenate([jnp.sin(frequency * t)[None], v[:-1]])
        right = jnp.concatenate([e[1:], v[-1:]])
        leak = 0.1 * (v - jnp.concatenate([jnp.zeros(2), v[:-2]]))
        node = (left - e) / resistance - (e - v) - 1e-3 * (jnp.exp(e) - 1)
        return {"v": ((e - v) - (v - right) / resistance - leak) / capacitance, "e": node}

    mass = {"v": np.ones(n), "e": np.zeros(n)}
    return mj.MassMatrixTerm(ladder, mass), {"v": jnp.zeros(n), "e": jnp.zeros(n)}


ARGS = jnp.asarray([1.0, 0.7, 0.5])


def end(structure, system, args, t1=0.3, **options):
    term, y0 = system
    sol = mj.diffeqsolve(
        term,
        mj.Rodas5P(structure=structure),
        0.0,
        t1,
        1e-3,
        y0,
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-8),
        max_steps=256,
        consistent="project",
        **options,
    )
    return sum(jnp.sum(leaf[-1] ** 2) for leaf in jax.tree.leaves(sol.ys)), sol


def methods_found(monkeypatch):
    """Record which methods are chosen."""
    jax.clear_caches()
    chosen = []
    choose = sparsity.choose_sparsity

    def recording(*args):
        chosen.append(found := choose(*args))
        return found

    for module in ("system", "algebraic"):
        monkeypatch.setattr(f"manifold_jax._rosenbrock.{module}.choose_sparsity", recording)
    return lambda: {None if found is None else found.method for found in chosen}


def test_solutions_and_gradients_as_dense(monkeypatch):
    methods = methods_found(monkeypatch)
    program = jax.value_and_grad(end, argnums=2, has_aux=True)
    run = lambda structure: jax.jit(lambda args: program(structure, filters(32), args))(ARGS)
    (_, sparse), by_sparse = run("auto")
    assert methods() == {"multi-elimination"}
    (_, dense), by_dense = run("dense")
    assert sparse.stats["num_steps"] == dense.stats["num_steps"] >= 5
    for name in ("v", "e"):
        np.testing.assert_allclose(sparse.ys[name], dense.ys[name], rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(by_sparse, by_dense, rtol=1e-10)


@needs_klu
@pytest.mark.slow
def test_a_batch_with_exchanges_of_rows(monkeypatch):
    """Trajectories of a batch end at different times: those that have finished make steps of length
    zero, whose matrices are singular."""
    methods = methods_found(monkeypatch)
    ends, factors = jnp.asarray([0.1, 0.3]), jnp.asarray([1.0, 1.5])

    def along(structure, factor, t1):
        run = lambda factor: end(structure, filters(64, shift=1), factor * ARGS, t1)[0]
        return jax.value_and_grad(run)(factor)

    batch = jax.jit(jax.vmap(lambda f, t1: along("auto", f, t1)))(factors, ends)
    assert methods() == {"either"}
    one = jax.jit(lambda f, t1: along("dense", f, t1))
    for k in range(2):
        for found, expected in zip(batch, one(factors[k], ends[k]), strict=True):
            np.testing.assert_allclose(found[k], expected, rtol=1e-10)


def test_consistent_starts_as_dense():
    term, y0 = filters(32)
    guess = {"v": jnp.cos(jnp.arange(32.0)), "e": y0["e"]}
    sparse, info = term.consistent_state(0.2, guess, ARGS)
    x, unravel = jax.flatten_util.ravel_pytree(guess)
    dense, _ = consistent(term.equations(guess, ARGS), 0.2, x)
    assert info.success
    assert info.residual < 1e-15
    np.testing.assert_array_equal(sparse["v"], guess["v"])
    np.testing.assert_allclose(sparse["e"], unravel(dense)["e"], rtol=1e-13)
    rates = unravel(term.equations(guess, ARGS).at(0.2, dense).derivative)
    found = term.derivative(0.2, sparse, ARGS)
    for name in ("v", "e"):
        np.testing.assert_allclose(found[name], rates[name], rtol=1e-12, atol=1e-14)
    index_2 = mj.MassMatrixTerm(lambda t, y, args: {"v": y["e"], "e": y["v"]}, term.mass)
    with pytest.raises(RuntimeError, match="index of M y' = f is above 1"):
        index_2.consistent_state(0.2, guess, ARGS)


def test_the_program_does_not_grow_with_the_system():
    def size(n):
        term, y0 = filters(n)
        solve = lambda args: end("sparse", (term, y0), args)[0]
        return num_equations(jax.jit(solve), ARGS)

    assert size(1000) < 1.3 * size(100)


def test_masses_that_are_not_known():
    """A mass that is an input of the program may be zero: without an unknown of its own for each
    equation the systems are then dense, and otherwise sparse."""
    x, mass = jnp.ones(70), jnp.ones(70)
    shifted = sparsity.choose_sparsity("auto", lambda x: jnp.roll(x, 1), x, mass)
    assert shifted is None
    own = sparsity.choose_sparsity("auto", lambda x: x - jnp.append(x[1:], 0.0), x, mass)
    assert own.method == "tridiagonal"


def wide(x):
    """Each equation with eight random unknowns."""
    return jnp.sum(x[np.random.default_rng(0).integers(x.size, size=(8, x.size))], axis=0)


def mesh(x):
    """Neighbours in two dimensions."""
    padded = jnp.pad(x.reshape(30, 30), 1)
    sides = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]
    return (sides - 4 * padded[1:-1, 1:-1]).reshape(-1)


@pytest.mark.parametrize(
    ("name", "function", "mass", "klu", "expected"),
    [
        ("few unknowns", lambda x: jnp.roll(x[:10], 1), None, True, None),
        ("neighbours", lambda x: jnp.diff(x, append=0.0), None, False, "tridiagonal"),
        (
            "two neighbours",
            lambda x: x + jnp.append(x[2:], x[:2]),
            None,
            False,
            "multi-elimination",
        ),
        ("algebraic", lambda x: x + jnp.append(x[2:], x[:2]), np.zeros(130), True, "either"),
        (
            "alone",
            lambda x: x + jnp.append(x[2:], x[:2]),
            np.zeros(130),
            False,
            "multi-elimination",
        ),
        ("no own unknown", lambda x: jnp.roll(x, 1), np.zeros(130), False, None),
        ("no own unknown", lambda x: jnp.roll(x, 1), np.zeros(130), True, "either"),
        ("few for KLU", lambda x: jnp.roll(x, 1), np.zeros(70), True, None),
        (
            "own unknown",
            lambda x: x + jnp.append(x[1:], 0.0),
            np.zeros(130),
            True,
            "tridiagonal",
        ),
        ("mesh", mesh, None, True, "multi-elimination"),
        ("wide", wide, None, False, None),
        ("wide", wide, None, True, "klu"),
        ("a matrix", lambda x: x, np.eye(130), True, None),
        ("everything", lambda x: x * jnp.sum(x), None, True, None),
    ],
)
def test_choice(monkeypatch, name, function, mass, klu, expected):
    monkeypatch.setattr(sparsity, "has_klu", lambda dtype: klu)
    x = jnp.ones({"few unknowns": 10, "few for KLU": 70, "wide": 260, "mesh": 900}.get(name, 130))
    massless = None if mass is None else np.asarray(mass) == 0
    mass = None if mass is None else jnp.asarray(mass)
    found = sparsity.choose_sparsity("auto", function, x, mass, massless)
    assert (None if found is None else found.method) == expected


def test_refusals(monkeypatch):
    monkeypatch.setattr(sparsity, "has_klu", lambda dtype: False)
    with pytest.raises(ValueError, match="`structure` must be 'auto', 'dense' or 'sparse'"):
        sparsity.check_structure("band")
    x = jnp.ones(70)
    with pytest.raises(ValueError, match="most of the 70 equations of `terms` depend on most"):
        sparsity.choose_sparsity("sparse", lambda x: x * jnp.sum(x), x, None)
    # Two equations for one unknown, and thirteen for twelve.
    shared = "places of `y[0]`, `y[1]` are too many for the unknowns in them: `y[1]` "
    with pytest.raises(ValueError, match=re.escape(shared)):
        sparsity.choose_sparsity("sparse", lambda x: x.at[0].set(x[1]), x, x, np.ones(70, bool))
    ring = lambda x: x.at[:12].set(x[:12] + jnp.roll(x[:12], 1)).at[12].set(x[0])
    with pytest.raises(
        ValueError, match=r"`y\[9\]` and 3 more are too many .* `y\[9\]` and 2 more"
    ):
        sparsity.choose_sparsity("sparse", ring, x, x, np.ones(70, bool))
    with pytest.raises(ValueError, match=r"Install klujax .*manifold_jax\[sparse\]"):
        sparsity.choose_sparsity("sparse", wide, jnp.ones(260), None)


@needs_klu
def test_klujax_does_not_change_settings():
    program = """
import jax
from manifold_jax._base.klu import klujax
klujax()
import jax.numpy as jnp
assert jnp.ones(()).dtype == jnp.float32
assert not jax.config.values["jax_platform_name"]
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_many_small_groups():
    """Unknowns that are coupled in threes: all of them are eliminated, and nothing is left."""
    A = np.array([[-1.0, 1.0, 0.0], [0.0, -2.0, 1.0], [0.5, 0.0, -3.0]])
    y0 = jnp.asarray(np.random.default_rng(0).normal(size=(30, 3)))
    terms = mj.MassMatrixTerm(lambda t, y, args: y @ A.T, 1.0)
    sol = mj.diffeqsolve(
        terms,
        mj.Rodas5P(),
        0.0,
        1.0,
        0.05,
        y0,
        stepsize_controller=dfx.PIDController(1e-10, 1e-10),
    )
    np.testing.assert_allclose(sol.ys[-1], y0 @ scipy.linalg.expm(A).T, atol=1e-9)
