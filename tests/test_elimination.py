import jax
import jax.numpy as jnp
import numpy as np
import pytest

from manifold_jax._linalg.elimination import eliminate, invert, LARGEST_WRITTEN_OUT


SIZES = (1, 2, 3, LARGEST_WRITTEN_OUT, LARGEST_WRITTEN_OUT + 1, 8)


def positive(m, seed=0):
    """Close to symmetric positive definite, as the products of normals and directions are."""
    random = np.random.default_rng(seed)
    A = random.normal(size=(m, m + 2))
    return A @ A.T + 0.1 * np.triu(random.normal(size=(m, m)))


@pytest.mark.parametrize("m", SIZES)
def test_as_numpy(m):
    A, b = positive(m), np.random.default_rng(1).normal(size=(m, 3))
    factors, full_rank = jax.jit(eliminate)(jnp.asarray(A))
    inverse, inverted = jax.jit(invert)(jnp.asarray(A))
    assert full_rank
    assert inverted
    close = dict(rtol=0, atol=1e-13 * np.linalg.cond(A))
    for right in (b, b[:, 0]):
        np.testing.assert_allclose(
            factors.solve(jnp.asarray(right)), np.linalg.solve(A, right), **close
        )
        transposed = factors.solve_transposed(jnp.asarray(right))
        np.testing.assert_allclose(transposed, np.linalg.solve(A.T, right), **close)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), **close)


@pytest.mark.parametrize("m", [size for size in SIZES if size > 1])
def test_rank_and_batches(m):
    """A dependent row is noticed, and leaves the other matrix of a batch untouched."""
    A = np.stack([positive(m), positive(m)])
    B = np.random.default_rng(2).normal(size=(m, m - 1))
    A[1] = B @ B.T
    factors, full_rank = jax.vmap(eliminate)(jnp.asarray(A))
    _, inverted = jax.vmap(invert)(jnp.asarray(A))
    np.testing.assert_array_equal(full_rank, [True, False])
    np.testing.assert_array_equal(inverted, [True, False])
    solutions = jax.vmap(lambda f: f.solve(jnp.ones(m)))(factors)
    assert jnp.all(jnp.isfinite(solutions))
    np.testing.assert_allclose(solutions[0], np.linalg.solve(A[0], np.ones(m)), rtol=1e-10)
