"""Routines for matrices, alone and in batches of all kinds, next to NumPy: the largest errors."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifold_jax._linalg import lapack


SIZE, BATCH, COLUMNS = 11, 100, 7
ROUTINES = ("lu_factor", "lu_solve", "lu_solve_transposed", "cholesky", "eigh")
ROUTINES = (*ROUTINES, "singular_values", "tridiagonal_solve")


def errors() -> dict[str, float]:
    """The largest relative error of each routine."""
    random = np.random.default_rng(0)
    A = random.normal(size=(3, BATCH, SIZE, SIZE)) + 3 * np.eye(SIZE)
    b = random.normal(size=(3, BATCH, SIZE))
    found = {name: 0.0 for name in ROUTINES}
    note = lambda name, got, expected: found.update(
        {name: max(found[name], _difference(got, expected))}
    )
    _factorizations(A, note)
    _solves(A, b, note)
    bands = random.normal(size=(3, BATCH, SIZE)) + np.array([0, 4, 0])[:, None, None]
    _tridiagonal(bands, random.normal(size=(COLUMNS, SIZE, 2)), note)
    return found


def _difference(got: Any, expected: Any) -> float:
    size = np.max(np.abs(expected))
    return float(np.max(np.abs(np.asarray(got) - expected), initial=0.0, where=True) / size)


def _batches(A: np.ndarray) -> list[tuple[Any, np.ndarray]]:
    """Transformations of a function of one matrix, and what they are called with."""
    one = lambda f: f
    return [(one, A[0, 0]), (jax.vmap, A[0]), (lambda f: jax.vmap(jax.vmap(f)), A)]


def _factorizations(A: np.ndarray, note: Any) -> None:
    positive = A @ np.swapaxes(A, -1, -2) + np.eye(SIZE)
    for batched, matrix in _batches(A):
        lu, permutation = jax.jit(batched(lapack.lu_factor))(matrix)
        lu, permutation = np.asarray(lu), np.asarray(permutation)
        product = (np.tril(lu, -1) + np.eye(SIZE)) @ np.triu(lu)
        permuted = np.take_along_axis(matrix, permutation[..., None].astype(int), axis=-2)
        note("lu_factor", product, permuted)
        values = jax.jit(batched(lapack.singular_values))(matrix)
        note("singular_values", values, np.linalg.svd(matrix, compute_uv=False))
    for batched, matrix in _batches(positive):
        lower = jax.jit(batched(lapack.cholesky))(matrix)
        note("cholesky", lower, np.linalg.cholesky(matrix))
        values, vectors = map(np.asarray, jax.jit(batched(lapack.eigh))(matrix))
        note("eigh", values, np.linalg.eigvalsh(matrix))
        product = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        note("eigh", product, matrix)


def _solves(A: np.ndarray, b: np.ndarray, note: Any) -> None:
    def solve(name: str, A: Any, b: Any) -> Any:
        return getattr(lapack, name)(*lapack.lu_factor(A), b)

    columns = np.broadcast_to(b[0, :COLUMNS].T, (SIZE, COLUMNS))
    for name in ("lu_solve", "lu_solve_transposed"):
        one = functools.partial(solve, name)
        M = A if name == "lu_solve" else np.swapaxes(A, -1, -2)
        exact = lambda M, b: np.linalg.solve(M, b[..., None])[..., 0]
        cases = [
            (one, A[0, 0], b[0, 0], exact(M[0, 0], b[0, 0])),
            (one, A[0, 0], columns, np.linalg.solve(M[0, 0], columns)),
            (jax.vmap(one), A[0], b[0], exact(M[0], b[0])),
            (jax.vmap(one, (None, 0)), A[0, 0], b[0], exact(M[0, 0], b[0])),
            (jax.vmap(one, (0, None)), A[0], b[0, 0], exact(M[0], b[0, :1])),
            (jax.vmap(one, (0, None)), A[0], columns, np.linalg.solve(M[0], columns[None])),
            (jax.vmap(jax.vmap(one)), A, b, exact(M, b)),
            (jax.vmap(jax.vmap(one, (0, None))), A, b[:, 0], exact(M, b[:, :1])),
            (jax.vmap(jax.vmap(one, (None, 0))), A[:, 0], b, exact(M[:, :1], b)),
            (jax.vmap(jax.vmap(one, (None, 0)), (0, None)), A[0], b[0, :COLUMNS],
             exact(M[0][:, None], b[0, None, :COLUMNS])),
            (jax.vmap(jax.vmap(one, (0, None)), (None, 0)), A[0], b[0, :COLUMNS],
             exact(M[0][None], b[0, :COLUMNS, None])),
        ]  # fmt: skip
        for function, matrix, right, expected in cases:
            note(name, jax.jit(function)(matrix, right), expected)


def _tridiagonal(bands: np.ndarray, right: np.ndarray, note: Any) -> None:
    lower, diagonal, upper = bands
    dense = np.zeros((BATCH, SIZE, SIZE))
    rows = np.arange(SIZE)
    dense[:, rows, rows] = diagonal
    dense[:, rows[1:], rows[:-1]] = lower[:, 1:]
    dense[:, rows[:-1], rows[1:]] = upper[:, :-1]
    one = lapack.tridiagonal_solve
    given = lambda *index: (lower[index], diagonal[index], upper[index])
    # The numbers outside the matrix are not used.
    cases = [
        (one, given(0), right[0], np.linalg.solve(dense[0], right[0])),
        (jax.vmap(one, (0, 0, 0, None)), bands, right[0], np.linalg.solve(dense, right[:1])),
        (jax.vmap(one, (None, None, None, 0)), given(0), right, np.linalg.solve(dense[0], right)),
        (
            jax.vmap(jax.vmap(one, (None, None, None, 0)), (0, 0, 0, None)),
            bands,
            right,
            np.linalg.solve(dense[:, None], right[None]),
        ),
    ]
    for function, matrix, b, expected in cases:
        got = jax.jit(function)(*map(jnp.asarray, matrix), jnp.asarray(b))
        note("tridiagonal_solve", got, expected)
