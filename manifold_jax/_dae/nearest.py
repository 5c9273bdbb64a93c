"""The consistent state nearest to a guess.

    z - z_guess + W^-1 G(z)^T lambda = 0,  g(t, z, args) = 0

is solved for `z` and `lambda`, and differentiated as its root: the guess may be far from the manifold,
where the derivative depends on the curvature of the manifold.

Lifted unknowns are those that became states because an equation is a nonlinear function of them, like
the voltage of a diode. They do not count for the distance: first the other states are moved, by the
equations without lifting, then the lifted ones follow from them.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._base.closure import convert_closure
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar
from .._constraint.residual import jacobian
from .._constraint.settings import NewtonProjection
from .._linalg.dense import gram
from .._linalg.newton import find_root, implicit_root, SquareSystem, without_derivative
from .._linalg.pivoted import factorize_equilibrated
from .._linalg.rows import combine, multiply
from .reduced import Reduced


# Limit for a linearly convergent iteration.
_MAX_STEPS = 300


class Constrained(eqx.Module):
    """The constraints `g(z) = 0` without the equations of lifted unknowns, and which components are
    fixed."""

    system: Reduced
    t: Array
    args: Args
    w: Float[Array, " k"]  # a guess of the leading derivatives
    fixed: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, z: Float[Array, " n"]) -> Float[Array, " m"]:
        c = self.system.analysis.unlifted.c
        return self.system.hidden_constraints(self.t, z, self.args, 0, c, self.w)


def free_components(fixed: tuple[bool, ...], z: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return 0 for components that are fixed and 1 for the others."""
    return jnp.asarray(np.where(fixed, 0, 1), z.dtype)


def depends_on_fixed_only(
    g: Callable, z: Float[Array, " n"], fixed: tuple[bool, ...]
) -> Bool[Array, " m"]:
    """Return which equations no free component is in: it has to be seen that they hold, they determine
    nothing, and their gradients count as independent of all others. To tell them from equations whose
    gradient is zero by chance, it is looked at in two states."""
    g, z = without_derivative((g, z))
    if not any(fixed):
        return jnp.zeros(jax.eval_shape(g, z).shape, bool)
    random = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, z.size), z.dtype)
    beside = z + random * (1 + jnp.abs(z))
    free = free_components(fixed, z)
    gradients = [jacobian(g, at)[1] * free[None, :] for at in (z, beside)]
    return jnp.all(jnp.stack([jnp.all(G == 0, axis=1) for G in gradients]), axis=0)


class _Approach(NamedTuple):
    """Iterate of the search for the nearest point: the state, its multipliers, the size of the last
    step, and the damping of steps across the manifold."""

    z: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    last_step: FloatScalar
    damping: FloatScalar
    iterations: IntScalar


def _approach(g: Constrained, guess: Float[Array, " n"], m: int) -> _Approach:
    """Approach the nearest point: across the manifold by Gauss-Newton steps, shorter ones while the
    residual grows, and along it by half the distance to the nearest point of the tangent space. That
    converges up to three radii of curvature away, and needs no second derivatives."""
    g, guess = without_derivative((g, guess))
    rounding = float(jnp.finfo(guess.dtype).eps)
    idle = jnp.diag(depends_on_fixed_only(g, guess, g.fixed).astype(guess.dtype))
    free = free_components(g.fixed, guess)

    def advance(state: _Approach) -> _Approach:
        offset = guess - state.z
        r, G = jacobian(g, state.z)
        directions = G * free[None, :]
        factored = factorize_equilibrated(gram(G, directions) + idle)
        multipliers = factored.solve(multiply(G, offset))
        along = offset - combine(multipliers, directions)
        step = combine(factored.solve(r), directions)
        there = jnp.max(jnp.abs(step)) <= 1e-2 * (1 + jnp.max(jnp.abs(state.z)))
        z = state.z - state.damping * step
        better = there | (jnp.max(jnp.abs(g(z))) < jnp.max(jnp.abs(r)))
        z = jnp.where(better, z, state.z) + jnp.where(there, along / 2, 0)
        last_step = jnp.maximum(jnp.max(jnp.abs(along)), jnp.max(jnp.abs(step)))
        damping = jnp.where(better, jnp.ones_like(last_step), state.damping / 4)
        return _Approach(z, multipliers, last_step, damping, state.iterations + 1)

    def unfinished(state: _Approach) -> BoolScalar:
        size = 1 + jnp.max(jnp.abs(state.z))
        return (state.last_step > rounding * size) & (state.iterations < _MAX_STEPS)

    one, none = jnp.ones((), guess.dtype), jnp.zeros((m,), guess.dtype)
    start = _Approach(guess, none, jnp.inf * one, one, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, advance, start)


class NearestState(NamedTuple):
    """The nearest state with its multipliers, and whether the iteration converged."""

    z: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    iterations: IntScalar
    settled: BoolScalar


def nearest_state(g: Constrained, guess: Float[Array, " n"]) -> NearestState:
    """Return the state nearest to the guess. Lifted unknowns stay where they are."""
    m = int(g.system.analysis.unlifted.c.sum())
    if m == 0:
        none = jnp.zeros((0,), guess.dtype)
        return NearestState(guess, none, jnp.zeros((), jnp.int32), jnp.asarray(True))
    near = _approach(g, guess, m)
    idle = depends_on_fixed_only(g, near.z, g.fixed)
    free = free_components(g.fixed, guess)

    def stationarity(x: Float[Array, " k"]) -> Float[Array, " k"]:
        z, multipliers = x[: guess.size], x[guess.size :]
        value, pullback = jax.vjp(g, z)
        (pull,) = pullback(multipliers)
        return jnp.concatenate([z - guess + free * pull, jnp.where(idle, multipliers, value)])

    found = jnp.concatenate([near.z, near.multipliers])
    root = implicit_root(SquareSystem(convert_closure(stationarity, found)), found)
    size = 1 + jnp.max(jnp.abs(near.z))
    settled = near.last_step <= float(jnp.finfo(guess.dtype).eps) ** 0.5 * size
    return NearestState(root[: guess.size], root[guess.size :], near.iterations, settled)


def _polished(equations: SquareSystem, start: Float[Array, " k"]) -> Float[Array, " k"]:
    """Improve a root by Newton's steps as long as each is less than half the one before. A residual at
    rounding level is not enough: beside terms of size 1, a current of 1e-12 has only half of its
    digits."""
    equations, start = without_derivative((equations, start))

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, last_step, _ = state
        dz = equations.linearize(z).solve(equations.residual(z))
        size = jnp.max(jnp.abs(dz) / jnp.maximum(jnp.abs(z), jnp.finfo(z.dtype).tiny))
        smaller = size < last_step / 2
        return jnp.where(smaller, z - dz, z), size, smaller & (size > 0)

    first = start, jnp.asarray(jnp.inf, start.dtype), jnp.asarray(True)
    return jax.lax.while_loop(lambda state: state[2], advance, first)[0]


def with_lifted(system: Reduced, t: Array, z: Float[Array, " n"], args: Args) -> Float[Array, " n"]:
    """Return the state with its lifted unknowns computed from the others."""
    layout, unlifted = system.analysis.layout, system.analysis.unlifted
    order, unknown = layout.names.T
    d = unlifted.d[layout.aliases.columns[unknown]]
    (where,) = np.nonzero(order + layout.aliases.shift[unknown] >= d)
    if len(where) == 0:
        return z

    def residual(u: Float[Array, " k"]) -> Float[Array, " k"]:
        changed = z.at[where].set(u)
        return system.hidden_constraints(t, changed, args, unlifted.c, system.analysis.c)

    equations = SquareSystem(convert_closure(residual, z[where]))
    tolerance = NewtonProjection().tolerance_for(z.dtype)
    root = _polished(equations, find_root(equations, z[where], _MAX_STEPS, tolerance))
    return z.at[where].set(implicit_root(equations, root))
