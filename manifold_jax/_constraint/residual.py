"""A residual `g(t, y, args)` as a function of vectors: its Jacobian and the size of its rows."""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike, ResidualFunction, Y
from .._linalg.dense import is_rounding
from .._linalg.rows import AbstractRows, Rows


def residual_vector(
    constraint: ResidualFunction, t: RealScalarLike, y: Y, args: Args
) -> Float[Array, " m"]:
    """Return the residual as one vector, in the floating-point type of the state."""
    flat, _ = jfu.ravel_pytree(constraint(t, y, args))
    return flat


def jacobian(
    residual: Callable[[Float[Array, " n"]], Float[Array, " m"]], x: Float[Array, " n"]
) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
    """Return the residual and its Jacobian, by `m` pullbacks: the cheap direction, as `m <= n`."""
    r, pullback = jax.vjp(residual, x)
    (rows,) = jax.vmap(pullback)(jnp.eye(r.shape[0], dtype=r.dtype))
    return r, rows


def row_scale(G: Rows, x: Float[Array, " n"], redundant: bool = False) -> Float[Array, " m"]:
    """Return the typical size of each residual, `max_j |G_ij| (|x_j| + 1)`.

    This is row equilibration (Sudarsan & Keerthi 1998, eqs. (3.3)-(3.4), with the typical sizes taken
    from the state). The 1 stands for lengths that the state does not show. With the size of the state
    in its place a third of the points beside a rod of length 1, given as displacements of 1e-3, could
    not be corrected: the residual has rounding errors of 1e-16 whatever the displacements.
    """
    if isinstance(G, AbstractRows):
        scale = G.sizes(jnp.abs(x) + 1)
    else:
        scale = jnp.max(jnp.abs(G) * (jnp.abs(x) + 1)[None, :], axis=1)
    if redundant:
        # Of equations that hold identically; if all do, only the state tells how large their terms are.
        scale = jnp.where(is_rounding(scale), jnp.max(scale), scale)
        scale = jnp.where(scale > 0, scale, jnp.max(jnp.abs(x)) + 1)
    return jnp.maximum(scale, jnp.finfo(scale.dtype).tiny)


def as_time(t: RealScalarLike, dtype: Any) -> Array:
    """Return a time as a floating-point array, also if it was given as an integer."""
    t = jnp.asarray(t)
    return t if jnp.issubdtype(t.dtype, jnp.floating) else t.astype(dtype)
