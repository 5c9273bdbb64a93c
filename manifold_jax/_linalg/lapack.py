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
import jax.scipy.linalg as jsl
import jax.tree_util as jtu
from jaxtyping import Array, Float, Inexact


def _one_after_the_other(function: Callable) -> Callable:
    call = jax.custom_batching.custom_vmap(function)

    @call.def_vmap
    def _of_batch(axis_size: int, batched: Any, *args: Any) -> Any:
        every = [
            x if of_batch else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, of_batch in zip(args, batched, strict=True)
        ]
        out = jax.lax.platform_dependent(
            *every,
            cpu=lambda *args: jax.lax.map(lambda one: call(*one), args),
            default=jax.vmap(function),
        )
        return out, jtu.tree_map(lambda _: True, out)

    return call


@_one_after_the_other
def lu_factor(A: Inexact[Array, "n n"]) -> tuple[Inexact[Array, "n n"], Array]:
    return jsl.lu_factor(A)


@_one_after_the_other
def lu_solve(
    lu: Inexact[Array, "n n"], pivots: Array, b: Inexact[Array, "n ..."]
) -> Inexact[Array, "n ..."]:
    return jsl.lu_solve((lu, pivots), b)


@_one_after_the_other
def lu_solve_transposed(
    lu: Inexact[Array, "n n"], pivots: Array, b: Inexact[Array, "n ..."]
) -> Inexact[Array, "n ..."]:
    return jsl.lu_solve((lu, pivots), b, trans=1)


@_one_after_the_other
def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jnp.linalg.cholesky(A)


@_one_after_the_other
def eigh(A: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    return tuple(jnp.linalg.eigh(A, symmetrize_input=False))  # pyright: ignore[reportReturnType]


@_one_after_the_other
def singular_values(A: Float[Array, "n n"]) -> Float[Array, " n"]:
    return jnp.linalg.svd(A, compute_uv=False)


@_one_after_the_other
def tridiagonal_solve(
    lower: Float[Array, " n"],
    diagonal: Float[Array, " n"],
    upper: Float[Array, " n"],
    b: Float[Array, "n k"],
) -> Float[Array, "n k"]:
    return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, b)
