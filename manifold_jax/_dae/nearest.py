"""The consistent state nearest to a guess.

    z - z_guess + W^-1 G(z)^T lambda = 0,  g(t, z, args) = 0

is solved for `z` and `lambda`, and differentiated as the root that it is: the guess may be far
from the manifold, where the derivative depends on how the manifold is curved.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, FloatScalar, IntScalar
from .._constraint.residual import jacobian
from .._constraint.settings import NewtonProjection
from .._linalg.dense import gram
from .._linalg.newton import (
    AbstractEquations,
    damped_newton,
    implicit_root,
    Iterate,
    without_derivative,
)
from .._linalg.rows import combine, multiply
from .constraint import hidden_constraints, Reduced
from .pivots import Pivoted


# Of an iteration that gains a factor each time.
_MAX_STEPS = 300


@dataclasses.dataclass(frozen=True, eq=False)
class Levels:
    """Which derivatives of the equations, `first_i <= k < end_i`."""

    first: np.ndarray
    end: np.ndarray


class Constrained(eqx.Module):
    """`g(z) = 0`, and what may move: the diagonal of `W^-1`, 0 for what is fixed."""

    system: Reduced
    t: Array
    args: Args
    free: Float[Array, " n"]
    w: Float[Array, " k"]  # a guess
    levels: Levels = eqx.field(static=True)

    def __call__(self, z: Float[Array, " n"]) -> Float[Array, " m"]:
        levels = self.levels
        return hidden_constraints(
            self.system, self.t, z, self.args, levels.first, levels.end, self.w
        )


def _stationarity(g: Constrained, guess: Array, x: Float[Array, " k"]) -> Float[Array, " k"]:
    z, multipliers = x[: guess.size], x[guess.size :]
    value, pullback = jax.vjp(g, z)
    (pull,) = pullback(multipliers)
    return jnp.concatenate([z - guess + g.free * pull, value])


class _Nearest(AbstractEquations):
    """The conditions of the nearest point, in the unknowns `(z, lambda)`."""

    g: Constrained
    guess: Float[Array, " n"]

    def point(self, z: Float[Array, " k"]) -> Float[Array, " k"]:
        return z

    def residual(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return _stationarity(self.g, self.guess, x)

    def linearize(self, x: Float[Array, " k"]) -> Pivoted:
        return Pivoted.of(jax.jacfwd(self.residual)(x))


class _LeastChange(NamedTuple):
    """The least change of the state, with a given rate of the residual: across the manifold."""

    G: Float[Array, "m n"]
    directions: Float[Array, "m n"]
    factored: Pivoted

    def solve(self, b: Float[Array, " m"]) -> Float[Array, " n"]:
        return combine(self.factored.solve(b), self.directions)


def _across(g: Constrained, z: Float[Array, " n"]) -> tuple[Float[Array, " m"], _LeastChange]:
    r, G = jacobian(g, z)
    directions = G * g.free[None, :]
    return r, _LeastChange(G, directions, Pivoted.of(gram(G, directions)))


class _Approach(NamedTuple):
    """The search for the nearest point: the state, its multipliers, how far they are from
    stationary, and the
    part of the step across the manifold that is taken."""

    z: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    level: FloatScalar
    damping: FloatScalar
    iterations: IntScalar


def _approach(g: Constrained, guess: Float[Array, " n"], m: int) -> _Approach:
    """Across the manifold by Gauss-Newton steps, smaller ones while the residual grows, and along
    it by half the distance that a flat manifold would ask for: that converges up to three radii
    of curvature away, and needs no second derivatives."""
    g, guess = without_derivative((g, guess))
    rounding = float(jnp.finfo(guess.dtype).eps)

    def advance(state: _Approach) -> _Approach:
        offset = guess - state.z
        r, across = _across(g, state.z)
        multipliers = across.factored.solve(multiply(across.G, offset))
        along = offset - combine(multipliers, across.directions)
        step = across.solve(r)
        there = jnp.max(jnp.abs(step)) <= 1e-2 * (1 + jnp.max(jnp.abs(state.z)))
        z = state.z - state.damping * step
        better = there | (jnp.max(jnp.abs(g(z))) < jnp.max(jnp.abs(r)))
        z = jnp.where(better, z, state.z) + jnp.where(there, along / 2, 0)
        level = jnp.maximum(jnp.max(jnp.abs(along)), jnp.max(jnp.abs(step)))
        damping = jnp.where(better, jnp.ones_like(level), state.damping / 4)
        return _Approach(z, multipliers, level, damping, state.iterations + 1)

    def unfinished(state: _Approach) -> BoolScalar:
        size = 1 + jnp.max(jnp.abs(state.z))
        return (state.level > rounding * size) & (state.iterations < _MAX_STEPS)

    one, none = jnp.ones((), guess.dtype), jnp.zeros((m,), guess.dtype)
    start = _Approach(guess, none, jnp.inf * one, one, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, advance, start)


class NearestState(NamedTuple):
    """The nearest state with its multipliers, and whether the iteration came to an end."""

    z: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    iterations: IntScalar
    settled: BoolScalar


def nearest_state(
    system: Reduced,
    t: Array,
    guess: Float[Array, " n"],
    w: Float[Array, " k"],
    fixed: np.ndarray,
    args: Args,
) -> "NearestState":
    """Return the state nearest to the guess, of what holds without the unknowns that became
    states, which stay where they are."""
    unlifted = system.static.plan.unlifted
    m = int(unlifted.c.sum())
    if m == 0:
        none = jnp.zeros((0,), guess.dtype)
        return NearestState(guess, none, jnp.zeros((), jnp.int32), jnp.asarray(True))
    levels = Levels(np.zeros_like(unlifted.c), unlifted.c)
    free = jnp.asarray(np.where(fixed, 0, 1), guess.dtype)
    g = Constrained(system, t, args, free, w, levels)
    near = _approach(g, guess, m)
    root = implicit_root(_Nearest(g, guess), jnp.concatenate([near.z, near.multipliers]))
    settled = near.level <= float(jnp.finfo(guess.dtype).eps) ** 0.5 * (
        1 + jnp.max(jnp.abs(near.z))
    )
    return NearestState(root[: guess.size], root[guess.size :], near.iterations, settled)


def _damped(equations: AbstractEquations, start: Float[Array, " k"]) -> Iterate:
    equations, start = without_derivative((equations, start))
    r = equations.residual(equations.point(start))
    tolerance = NewtonProjection().tolerance_for(start.dtype)
    return damped_newton(equations, start, r, jnp.ones_like(r), _MAX_STEPS, tolerance)


def _polished(equations: AbstractEquations, start: Float[Array, " k"]) -> Float[Array, " k"]:
    """Improve a root by Newton's steps as long as each is less than half the one before: currents
    of 1e-12 solve
    their equations to rounding beside 1 with half their digits."""
    equations, start = without_derivative((equations, start))

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, level, _ = state
        x = equations.point(z)
        dz = equations.linearize(x).solve(equations.residual(x))
        size = jnp.max(jnp.abs(dz) / jnp.maximum(jnp.abs(z), jnp.finfo(z.dtype).tiny))
        smaller = size < level / 2
        return jnp.where(smaller, z - dz, z), size, smaller & (size > 0)

    first = start, jnp.asarray(jnp.inf, start.dtype), jnp.asarray(True)
    return jax.lax.while_loop(lambda state: state[2], advance, first)[0]


class _Lifted(AbstractEquations):
    """The equations for the unknowns that became states, `z[where]`, with the others given."""

    system: Reduced
    t: Array
    z: Float[Array, " n"]
    args: Args
    levels: Levels = eqx.field(static=True)
    where: tuple[int, ...] = eqx.field(static=True)

    def point(self, z: Float[Array, " k"]) -> Float[Array, " n"]:
        return self.z.at[np.array(self.where)].set(z)

    def residual(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        levels = self.levels
        return hidden_constraints(self.system, self.t, x, self.args, levels.first, levels.end)

    def linearize(self, x: Float[Array, " n"]) -> Pivoted:
        where = np.array(self.where)
        return Pivoted.of(jax.jacfwd(lambda u: self.residual(x.at[where].set(u)))(x[where]))


def with_lifted(system: Reduced, t: Array, z: Float[Array, " n"], args: Args) -> Float[Array, " n"]:
    """Return the state with the unknowns that became states as they follow from the others."""
    layout, unlifted = system.static.plan.layout, system.static.plan.unlifted
    order, unknown = layout.names.T
    j = np.searchsorted(layout.aliases.roots, layout.aliases.root[unknown])
    (where,) = np.nonzero(order + layout.aliases.shift[unknown] >= unlifted.d[j])
    if len(where) == 0:
        return z
    levels = Levels(unlifted.c, layout.structure.c)
    equations = _Lifted(system, t, z, args, levels, tuple(where.tolist()))
    root = _polished(equations, _damped(equations, z[where]).z)
    return equations.point(implicit_root(equations, root))
