"""The assembly of a state inside of `jit`, `vmap` and derivatives: lengths and what is given may be traced."""

from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.dense import pseudo_invert
from .bodies import Pose


# Eigenvalues of `J J^T` below this fraction of the largest belong to equations that depend on others.
_DEPENDENT = 1e-12


def assemble_traced(
    assembly: Any,
    y: tuple[Pose, Pose],
    fixed: tuple[Pose, Pose],
    t: Array,
    args: Args,
    names: list[tuple[str, np.ndarray]],
    iterations: int,
    closed: float,
) -> tuple[Pose, Pose]:
    """The same steps of least norm as with concrete numbers, `x - J^+ phi(x)` in what is free, and one
    for the velocities, with derivatives through all of them. `names` are those of the equations.

    While it runs an error says which joint could not be closed.
    """
    kept = [np.concatenate([np.ravel(x) for x in jtu.tree_leaves(part)]) for part in fixed]
    free_x, free_w = (np.flatnonzero(~part) for part in kept)
    (x, unravel), (w, _) = (jfu.ravel_pytree(part) for part in y)

    def phi(t: Array, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return jfu.ravel_pytree(assembly._equations(t, unravel(x), args))[0]

    def corrected(x: Float[Array, " n"], _: Any) -> tuple[Float[Array, " n"], None]:
        J = jax.jacfwd(phi, 1)(t, x)[:, free_x]
        return x.at[free_x].add(-_least_norm(J, phi(t, x))), None

    def iterate(x: Float[Array, " n"], _: Any) -> tuple[Float[Array, " n"], None]:
        unfinished = jnp.max(jnp.abs(phi(t, x)), initial=0) >= 10 * jnp.finfo(x.dtype).eps
        return jax.lax.cond(unfinished, lambda x: corrected(x, None)[0], lambda x: x, x), None

    x, _ = jax.lax.scan(iterate, x, None, length=iterations)
    x, _ = corrected(x, None)  # of which the derivative is that of a root
    J = jax.jacfwd(phi, 1)(t, x)
    _, driven = jax.jvp(lambda t: phi(t, x), (t,), (jnp.ones_like(t),))
    rate = lambda w: driven + J @ w
    w = w.at[free_w].add(-_least_norm(J[:, free_w], rate(w)))
    largest = jnp.maximum(1, jnp.max(jnp.abs(jax.lax.stop_gradient(w)), initial=0))
    x = _raise_unless_small(x, phi(t, x), closed, names, "the joints cannot be closed")
    w = _raise_unless_small(
        w, rate(w) / largest, closed, names, "the velocities given disagree with the joints"
    )
    return unravel(x), unravel(w)


def _least_norm(J: Float[Array, "m n"], b: Float[Array, " m"]) -> Float[Array, " n"]:
    return J.T @ pseudo_invert(J @ J.T, _DEPENDENT).solve(b)


def _raise_unless_small(
    x: Float[Array, " n"],
    gap: Float[Array, " m"],
    most: float,
    names: list[tuple[str, np.ndarray]],
    fault: str,
) -> Float[Array, " n"]:
    gaps = jnp.stack([jnp.max(jnp.abs(gap[rows])) for _, rows in names])
    messages = [
        f"`assemble=True`: whatever the other bodies do, {fault}, {name} least of all. Check lengths and points, or "
        "give less."
        for name, _ in names
    ]
    failed = ~(jnp.max(gaps) <= most)
    return eqx.branched_error_if(
        x, failed, jnp.argmax(jnp.where(jnp.isnan(gaps), jnp.inf, gaps)), messages
    )
