"""RATTLE for a chain of rigid bonds: velocity Verlet with constraints, as in molecular dynamics.

Positions are corrected along the bonds of the step before, velocities along those of the new
positions. Written from its description in Andersen, J. Comput. Phys. 52 (1983) 24-34.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Chain(NamedTuple):
    """Beads with inverse masses `w` on bonds of the lengths `L`."""

    w: Any
    L: Any


def rattle(
    chain: Chain, force: Callable, step: float, steps: int, saved: int, method: Any
) -> Callable:
    """`(q, v) -> (q, v)`, `saved` states of a run of `steps` steps."""

    def advance(_, state):
        q, v, a = state
        half = v + 0.5 * step * a
        free = q + step * half
        new = method.positions(chain, free, jnp.diff(q, axis=0))
        half = half + (new - free) / step
        a = force(new) * chain.w[:, None]
        v = method.velocities(chain, half + 0.5 * step * a, jnp.diff(new, axis=0))
        return new, v, a

    def some(state, _):
        state = jax.lax.fori_loop(0, steps // saved, advance, state)
        return state, state[:2]

    def run(q, v):
        start = q, v, force(q) * chain.w[:, None]
        return jax.lax.scan(some, start, length=saved)[1]

    return run


class Sweeps(NamedTuple):
    """One bond after the other until all are satisfied to the tolerance (SHAKE's iteration). Every
    second bond at once, as these share no beads."""

    tolerance: float

    def positions(self, chain: Chain, q: Any, before: Any) -> Any:
        def bond(d, before, L2, w):
            return (L2 - jnp.sum(d * d, axis=1)) / (2 * w * jnp.sum(d * before, axis=1))

        return self._until(chain, q, before, bond, lambda d: jnp.sum(d * d, axis=1) - chain.L**2)

    def velocities(self, chain: Chain, v: Any, d: Any) -> Any:
        bond = lambda rate, d, L2, w: -jnp.sum(rate * d, axis=1) / (w * L2)
        return self._until(chain, v, d, bond, lambda rate: jnp.sum(rate * d, axis=1))

    def _until(self, chain, x, along, bond, residual):
        w, L2 = chain.w[:, None], chain.L**2
        reduced = chain.w[1:] + chain.w[:-1]

        def sweep(x):
            for first in (0, 1):
                of = slice(first, None, 2)
                d = along[of]
                size = bond(jnp.diff(x, axis=0)[of], d, L2[of], reduced[of])[:, None]
                x = x.at[first + 1 :: 2].add(size * d * w[first + 1 :: 2])
                end = first + 2 * len(d)
                x = x.at[first:end:2].add(-size * d * w[first:end:2])
            return x

        unfinished = lambda x: jnp.max(jnp.abs(residual(jnp.diff(x, axis=0))) / L2) > self.tolerance
        return jax.lax.while_loop(unfinished, sweep, x)


class Newton(NamedTuple):
    """All bonds at once by Newton's method, of which the matrix is tridiagonal (the matrix form of
    SHAKE)."""

    tolerance: float

    def positions(self, chain: Chain, q: Any, before: Any) -> Any:
        def unfinished(q):
            d = jnp.diff(q, axis=0)
            violation = jnp.abs(jnp.sum(d * d, axis=1) - chain.L**2) / chain.L**2
            return jnp.max(violation) > self.tolerance

        def iterate(q):
            d = jnp.diff(q, axis=0)
            return _moved(chain, q, d, before, (chain.L**2 - jnp.sum(d * d, axis=1)) / 2)

        return jax.lax.while_loop(unfinished, iterate, q)

    def velocities(self, chain: Chain, v: Any, d: Any) -> Any:
        return _moved(chain, v, d, d, -jnp.sum(jnp.diff(v, axis=0) * d, axis=1))


def _moved(chain: Chain, x: Any, d: Any, along: Any, wanted: Any) -> Any:
    """`x + M^-1 B^T s` with `D M^-1 B^T s = wanted`, `D` and `B` the gradients of bonds `d` and
    `along`."""
    w, none = chain.w, jnp.zeros(1)
    diagonal = (w[1:] + w[:-1]) * jnp.sum(d * along, axis=1)
    lower = jnp.concatenate([none, -w[1:-1] * jnp.sum(d[1:] * along[:-1], axis=1)])
    upper = jnp.concatenate([-w[1:-1] * jnp.sum(d[:-1] * along[1:], axis=1), none])
    size = jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, wanted[:, None])
    pull, end = size * along, jnp.zeros((1, x.shape[1]))
    return x + w[:, None] * (jnp.concatenate([end, pull]) - jnp.concatenate([pull, end]))
