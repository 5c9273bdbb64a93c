"""Routines of LAPACK that do not stop for ever under `vmap`.

On the CPU jaxlib (0.10 and later) hands the matrices of a batch to the threads of XLA's pool, and waits
for them inside one of these threads. As many independent batched calls as there are threads, two on a
machine with two cores, each occupy one and wait for tasks that no thread is left to run. One matrix is
computed at once. So batches are computed there one matrix after the other, which takes about as
long on two cores; other devices have routines for batches.

None of these may be differentiated: they belong behind `stop_gradient`, or a rule for derivatives.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Inexact, Int


def one_after_the_other(function: Callable) -> Callable:
    """Of a batch compute `function` for each at a time, on the CPU."""
    call = jax.custom_batching.custom_vmap(function)

    @call.def_vmap
    def _of_batch(axis_size: int, batched: Any, *args: Any) -> Any:
        out = _map(call, function, batched, args)
        return out, jtu.tree_map(lambda _: True, out)

    return call


def _solves_one_after_the_other(function: Callable) -> Callable:
    """The last argument are right-hand sides, `(n, ...)`; those of one matrix are solved for at once."""
    call = jax.custom_batching.custom_vmap(function)

    @call.def_vmap
    def _of_batch(axis_size: int, batched: Any, *args: Any) -> Any:
        *factors, b = args
        if any(batched[:-1]):
            return _map(call, function, batched, args), True
        columns = jnp.moveaxis(b, 0, -1)
        x = call(*factors, columns.reshape(columns.shape[0], -1))
        return jnp.moveaxis(x.reshape(columns.shape), -1, 0), True

    return call


def _map(call: Callable, function: Callable, batched: Any, args: tuple[Any, ...]) -> Any:
    """Return the results for all of a batch; arguments that are not `batched` serve for each."""
    own = [x for x, of_batch in zip(args, batched, strict=True) if of_batch]

    def one(own: Any) -> Any:
        rest = iter(own)
        return call(
            *(next(rest) if of_batch else x for x, of_batch in zip(args, batched, strict=True))
        )

    axes = [0 if of_batch else None for of_batch in batched]
    return jax.lax.platform_dependent(
        cpu=lambda: jax.lax.map(one, own), default=lambda: jax.vmap(function, axes)(*args)
    )


@one_after_the_other
def lu_factor(A: Inexact[Array, "n n"]) -> tuple[Inexact[Array, "n n"], Int[Array, " n"]]:
    """Return `L` and `U` in one matrix, and the permutation with which `A[permutation] = L U`."""
    lu, _, permutation = jax.lax.linalg.lu(A)
    return lu, permutation


@_solves_one_after_the_other
def lu_solve(
    lu: Inexact[Array, "n n"], permutation: Int[Array, " n"], b: Inexact[Array, "n ..."]
) -> Inexact[Array, "n ..."]:
    """Return the solution of `A x = b`."""
    y = _triangular(lu, b[permutation].reshape(b.shape[0], -1), lower=True)
    return _triangular(lu, y, lower=False).reshape(b.shape)


@_solves_one_after_the_other
def lu_solve_transposed(
    lu: Inexact[Array, "n n"], permutation: Int[Array, " n"], b: Inexact[Array, "n ..."]
) -> Inexact[Array, "n ..."]:
    """Return the solution of `A^T x = b`."""
    y = _triangular(lu, b.reshape(b.shape[0], -1), lower=False, transpose_a=True)
    y = _triangular(lu, y, lower=True, transpose_a=True).reshape(b.shape)
    return jnp.zeros_like(y).at[permutation].set(y)


def _triangular(lu: Array, b: Array, *, lower: bool, transpose_a: bool = False) -> Array:
    options: dict[str, Any] = dict(left_side=True, lower=lower, transpose_a=transpose_a)
    return jax.lax.linalg.triangular_solve(lu, b, unit_diagonal=lower, **options)


@one_after_the_other
def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jnp.linalg.cholesky(A)


@_solves_one_after_the_other
def cholesky_solve(lower: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return the solution of `L L^T x = b`."""
    columns, options = b.reshape(b.shape[0], -1), dict[str, Any](left_side=True, lower=True)
    y = jax.lax.linalg.triangular_solve(lower, columns, **options)
    return jax.lax.linalg.triangular_solve(lower, y, transpose_a=True, **options).reshape(b.shape)


@one_after_the_other
def eigh(A: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    return tuple(jnp.linalg.eigh(A, symmetrize_input=False))  # pyright: ignore[reportReturnType]


@one_after_the_other
def singular_values(A: Float[Array, "n n"]) -> Float[Array, " n"]:
    return jnp.linalg.svd(A, compute_uv=False)


@_solves_one_after_the_other
def tridiagonal_solve(
    lower: Float[Array, " n"],
    diagonal: Float[Array, " n"],
    upper: Float[Array, " n"],
    b: Float[Array, "n k"],
) -> Float[Array, "n k"]:
    return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, b)
