"""Generalized forces of a Lagrangian."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp

from .._custom_types import RealScalarLike, Y


class LagrangianForce(eqx.Module):
    """`Q + dL/dq - d^2L/dv dq v - d^2L/dv dt`: all of `d/dt dL/dv - dL/dq = Q` but `M a`."""

    lagrangian: Callable
    applied: Callable | None

    def __call__(self, t: RealScalarLike, q: Y, v: Y, *rest: Any) -> Y:
        """`rest` are further states, if there are any, and the args."""
        args = rest[-1]
        x, unravel = jfu.ravel_pytree(q)
        w, _ = jfu.ravel_pytree(v)
        t = jnp.asarray(t, x.dtype)
        L = lambda t, x, w: self.lagrangian(t, unravel(x), unravel(w), args)
        momentum = lambda t, x: jax.grad(L, argnums=2)(t, x, w)
        _, momentum_rate = jax.jvp(momentum, (t, x), (jnp.ones_like(t), w))
        force = unravel(jax.grad(L, argnums=1)(t, x, w) - momentum_rate)
        if self.applied is None:
            return force
        return jax.tree_util.tree_map(jnp.add, force, self.applied(t, q, v, *rest))
