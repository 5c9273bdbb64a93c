"""Square systems: linear ones, and roots with the derivative of the implicit function.

Without LAPACK: batched factorizations can wait for each other for ever on the CPU. Seen with
jaxlib 0.10.2 on two cores: two that do not depend on each other, under `vmap` in one large
program, each held a thread of XLA's pool and waited there for tasks in the queue of the pool.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import FloatScalar


# Columns up to which the elimination is written out, so that it fuses.
_UNROLL_LIMIT = 4


def reduction(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], FloatScalar]:
    """`E` with `E A = 1` (or `[1; 0]` if `k < n`) and the sign of `det E`, by Gauss-Jordan
    elimination with row exchanges. Not finite if the columns of `A` are dependent."""
    n, k = A.shape
    rows = jnp.arange(n)

    def column(j, state):
        M, sign = state
        p = jnp.argmax(jnp.where(rows >= j, jnp.abs(M[:, j]), -1))
        sign = sign * jnp.sign(M[p, j]) * jnp.where(p == j, 1, -1)
        pivot_row = M[p] / M[p, j]
        M = jnp.where((rows == p)[:, None], M[j][None], M)
        M = jnp.where((rows == j)[:, None], pivot_row[None], M - jnp.outer(M[:, j], pivot_row))
        return M, sign

    start = jnp.concatenate([A, jnp.eye(n, dtype=A.dtype)], axis=1), jnp.ones((), A.dtype)
    M, sign = jax.lax.fori_loop(0, k, column, start, unroll=k <= _UNROLL_LIMIT)
    return M[:, k:], sign


def solve(A: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """`A^-1 b`, with its derivatives. Not finite if `A` is singular."""
    return jax.lax.custom_linear_solve(
        lambda x: A @ x,
        b,
        lambda _, b: reduction(A)[0] @ b,
        lambda _, b: reduction(A)[0].T @ b,
    )


def newton(
    residual: Callable, guess: Float[Array, " n"], max_steps: int = 50
) -> Float[Array, " n"]:
    """Newton's method for as long as every step lowers `max_i |r_i|`: the best point found.
    Simple roots are found to round-off."""

    def advance(state):
        best, least, x, steps, _ = state
        r, J = residual(x), jax.jacfwd(residual)(x)
        level = jnp.max(jnp.abs(r))
        progress = level < least
        best, least = jnp.where(progress, x, best), jnp.where(progress, level, least)
        return best, least, x - solve(J, r), steps + 1, progress

    unfinished = lambda state: state[-1] & (state[-2] < max_steps)
    start = (guess, jnp.asarray(jnp.inf, guess.dtype), guess, 0, jnp.asarray(True))
    return jax.lax.while_loop(unfinished, advance, start)[0]


@eqx.filter_custom_jvp
def implicit_root(residual: eqx.Module, root: Float[Array, " n"]) -> Float[Array, " n"]:
    """`root` itself, as the function of the leaves of `residual` that `residual(root) = 0`
    defines. How the root was found does not matter, and is not differentiated."""
    del residual
    return root


# r(x, theta) = 0:  dx = -(dr/dx)^-1 (dr/dtheta) dtheta. Written in terms of the output, so
# that the rule can itself be differentiated.
@implicit_root.def_jvp
def _implicit_function(primals, tangents):
    residual, root = primals
    residual_dot, _ = tangents
    root = implicit_root(residual, root)
    _, slope = eqx.filter_jvp(lambda r: r(root), (residual,), (residual_dot,))
    if slope is None:
        return root, jnp.zeros_like(root)
    return root, -solve(jax.jacfwd(residual)(root), slope)


def without_derivative(tree: Any) -> Any:
    """`tree` with all its arrays held fixed."""
    return jtu.tree_map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, tree)
