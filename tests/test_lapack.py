"""Batches of LAPACK's routines: the same as one by one, and never as calls that could wait for each other."""

import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj
from manifold_jax._linalg import lapack
from manifold_jax._linalg.dense import factorize, factorize_positive, pseudo_invert
from manifold_jax._linalg.pivoted import factorize_equilibrated, factorize_pivoted


random = np.random.default_rng(0)
N = 11  # beyond what is eliminated without the library
MATRICES = random.normal(size=(2, 3, N, N))
POSITIVE = MATRICES @ np.swapaxes(MATRICES, -1, -2) + np.eye(N)
RIGHT = random.normal(size=(3, N))


def batched_calls(program, *args):
    """Return the shapes of what LAPACK is called with, of calls with more than one matrix."""
    text = jax.jit(program).lower(*args).as_text()
    calls = re.findall(r"custom_call @lapack_(\w+)\(.*?\) .*? : \(tensor<([\dx]+)x[a-z]", text)
    assert calls
    shapes = [(name, tuple(map(int, shape.split("x")))) for name, shape in calls]
    # The first argument is a matrix, or the diagonal of one.
    size = lambda name, shape: np.prod(shape[: -1 if "gtsv" in name else -2])
    return [shape for name, shape in shapes if size(name, shape) > 1]


@pytest.mark.parametrize(
    "factor", [factorize, factorize_positive, factorize_equilibrated, factorize_pivoted]
)
def test_batches_of_systems(factor):
    def solve(A, b):
        factors = factor(A)
        return factors.solve(b), factors.factors.solve_transposed(b), factors.usable

    every = jax.vmap(jax.vmap(solve), in_axes=(0, None))
    x, transposed, usable = jax.jit(every)(POSITIVE, RIGHT)
    assert usable.all()
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(x[i, j], np.linalg.solve(POSITIVE[i, j], RIGHT[j]), rtol=1e-9)
        expected = np.linalg.solve(POSITIVE[i, j].T, RIGHT[j])
        np.testing.assert_allclose(transposed[i, j], expected, rtol=1e-9)
    assert not batched_calls(every, POSITIVE, RIGHT)


@pytest.mark.parametrize("factor", [factorize, factorize_positive])
def test_units_of_equations_do_not_matter(factor):
    A, size = POSITIVE[0, 0], 10.0 ** np.linspace(-9, 9, N)
    scaled = size[:, None] * A * size[None, :]
    x, usable = jax.jit(lambda A, b: (factor(A).solve(b), factor(A).usable))(scaled, RIGHT[0])
    assert usable
    np.testing.assert_allclose(x * size, np.linalg.solve(A, RIGHT[0] / size), rtol=1e-9)


DEPENDENT = POSITIVE[0, 0].copy()
DEPENDENT[:, 4], DEPENDENT[4] = DEPENDENT[:, 2], DEPENDENT[2]
DEPENDENT[4, 4] = DEPENDENT[2, 2]
FAULTS = {"dependent": DEPENDENT, "zero": np.zeros((N, N)), "NaN": np.full((N, N), np.nan)}
FAULTS["infinite"] = np.where(np.eye(N) > 0, np.inf, POSITIVE[0, 0])


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("factor", [factorize, factorize_positive])
def test_what_cannot_be_solved_is_told_and_finite(factor, fault):
    """Also in derivatives: those of a rejected step are multiplied by zero."""

    def solve(A):
        factors = factor(A)
        return factors.solve(jnp.asarray(RIGHT[0])), factors.usable

    (x, usable), pull = jax.vjp(solve, jnp.asarray(FAULTS[fault]))
    assert not usable
    assert np.isfinite(x).all()
    (A_bar,) = pull((jnp.ones(N), np.zeros((), jax.dtypes.float0)))
    assert np.isfinite(A_bar).all()


def test_indefinite_matrices_are_not_positive():
    indefinite = jnp.asarray(POSITIVE[0, 0] - 3 * np.diag(np.diag(POSITIVE[0, 0])))
    assert factorize(indefinite).usable
    assert not factorize_positive(indefinite).usable


@pytest.mark.parametrize("factor", [factorize, factorize_pivoted])
def test_many_right_hand_sides_of_one_matrix(factor):
    """They are solved for at once, also within a batch of matrices: no loop over them, no copies of the factors."""

    def solve(A, right):
        factors = factor(A)
        transposed = jax.vmap(factors.factors.solve_transposed)(right)
        return jax.vmap(factors.solve)(right), transposed

    right = random.normal(size=(3, N))
    x, transposed = jax.jit(solve)(POSITIVE[0, 0], right)
    np.testing.assert_allclose(x, np.linalg.solve(POSITIVE[0, 0], right.T).T, rtol=1e-9)
    expected = np.linalg.solve(POSITIVE[0, 0].T, right.T).T
    np.testing.assert_allclose(transposed, expected, rtol=1e-9)
    one = lambda b: factor(jnp.asarray(POSITIVE[0, 0])).solve(b)
    loops = lambda program, b: jax.jit(program).lower(b).as_text().count("stablehlo.while")
    assert loops(jax.vmap(one), right) == loops(one, right[0])
    assert not batched_calls(solve, POSITIVE[0, 0], right)
    every = jax.vmap(solve, in_axes=(0, None))
    np.testing.assert_allclose(jax.jit(every)(POSITIVE[0], right)[0][0], x, rtol=1e-12)
    assert not batched_calls(every, POSITIVE[0], right)


def test_batches_of_eigenvalues():
    inverses = jax.vmap(lambda A: pseudo_invert(A).inverse)
    found = jax.jit(inverses)(POSITIVE[0])
    np.testing.assert_allclose(found, np.linalg.inv(POSITIVE[0]), rtol=1e-8)
    assert not batched_calls(inverses, POSITIVE[0])
    values = jax.vmap(lapack.singular_values)
    np.testing.assert_allclose(
        values(MATRICES[0]), np.linalg.svd(MATRICES[0], compute_uv=False), rtol=1e-12
    )
    assert not batched_calls(values, MATRICES[0])


def test_batches_of_tridiagonal_systems():
    lower, diagonal, upper = random.normal(size=(3, 4, N)) + np.array([0, 4, 0])[:, None, None]
    every = jax.vmap(lapack.tridiagonal_solve, in_axes=(0, 0, 0, None))
    found = every(lower, diagonal, upper, RIGHT.T)
    for k in range(4):
        bands = np.stack([np.roll(upper[k], 1), diagonal[k], np.roll(lower[k], -1)])
        np.testing.assert_allclose(
            found[k], scipy.linalg.solve_banded((1, 1), bands, RIGHT.T), rtol=1e-10
        )
    assert not batched_calls(every, lower, diagonal, upper, RIGHT.T)


def test_solves_of_a_mechanism():
    """25 equations: corrections of all saved values at once, in a batch, with derivatives of several arguments."""
    problem = mj.problems.delta_robot()

    def ends(change):
        args = problem.args._replace(platform_mass=problem.args.platform_mass + change[0])
        args = args._replace(stiffness=args.stiffness + change[1])
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Tsit5(), problem.constraint),
            *(0.0, 0.1, 0.01, problem.y0, args),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 0.1, 5)),
            adjoint=dfx.ForwardMode(),
        )
        return sol.ys

    assert not batched_calls(jax.vmap(jax.jacfwd(ends)), jnp.zeros((3, 2)))
