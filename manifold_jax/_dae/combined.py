"""Equations whose highest derivatives cancel in a combination of them.

    C (u' - v') = i(u),   C (v' - u') = j(v)

are regular to the structure, but not solvable for `u'` and `v'`: their sum `0 = i(u) + j(v)` is an
equation of the unknowns alone. Found where weights are constant and coefficients are, too, or are
added and subtracted as one number (like the charge between two nodes of a circuit), and put in the
place of one of the equations.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._jaxpr.incidence import incidence
from .aliases import Aliases
from .equations import Combination, Equations
from .layout import Layout
from .occurrence import Occurrence, Point
from .samples import singular_below


# Of a sum that should be zero, relative to its parts.
_ROUNDING = 1e-12
_POINTS = 3


class Cancelled(NamedTuple):
    """A combination in the place of one of the equations, and what is not in it any more,
    `gone[k, j]`."""

    combination: Combination
    gone: np.ndarray


def cancelled(
    equations: Equations,
    occurrence: Occurrence,
    aliases: Aliases,
    layout: Layout,
    matrices: list[np.ndarray],
    point: Point,
) -> list[Cancelled]:
    """Return the cancellations among equations that are differentiated equally often: those that
    hold for other parameters and
    times, too, and of which none changes an equation that another one needs."""
    jacobians = _jacobians(equations, occurrence.there, point)
    found: list[Cancelled] = []
    for weights in _common_null_vectors(matrices):
        (used,) = np.nonzero(weights)
        if len(used) < 2 or len(set(layout.structure.c[used].tolist())) > 1:
            continue
        rows = aliases.rows[used]
        if any(other.combination.row in rows for other in found):
            continue
        constant = ~occurrence.varies[rows].any(axis=0) | _constant(
            equations, rows, weights[used], point
        )
        gone = constant & _vanishes(jacobians, rows, weights[used])
        leading = aliases.merged(gone[None])[0]
        highest = layout.structure.d - layout.structure.c[used[0]]
        stands = aliases.merged(occurrence.there[rows].any(axis=0)[None])[0]  # pyright: ignore[reportIndexIssue]
        columns = np.arange(len(highest))
        inside = highest >= 0
        at = np.maximum(highest, 0), columns
        if (inside & stands[at] & ~leading[at]).any():
            continue
        target = int(rows[np.argmax(np.abs(weights[used]))])
        parts = tuple(zip(rows.tolist(), weights[used].tolist(), strict=True))
        found.append(Cancelled(Combination(target, parts), gone))
    return found


def _constant(
    equations: Equations, rows: np.ndarray, weights: np.ndarray, point: Point
) -> np.ndarray:
    """Which coefficients of the weighted sum do not depend on anything, shape `(levels, n)`. Read
    off its gradient, where what is added and subtracted meets before it is multiplied."""
    cotangent = np.zeros(equations.n)
    cotangent[rows] = weights

    def gradient(t: Array, jets: tuple[Array, ...], args: object) -> Array:
        along = lambda jets: equations(t, jets, eqx.combine(args, point.fixed_args))
        _, pullback = jax.vjp(along, jets)
        return jnp.concatenate(pullback(jnp.asarray(cotangent, jets[0].dtype))[0])

    anything = lambda tree: np.ones(
        (sum(int(np.size(leaf)) for leaf in jax.tree_util.tree_leaves(tree)), 1), bool
    )
    tracked = [(tree, anything(tree)) for tree in (point.t, point.jets, point.args)]
    try:
        varies = incidence(gradient, *tracked).depends[:, 0]
    except (ValueError, NotImplementedError):  # no gradient, as of `while_loop`
        varies = np.ones(cotangent.size * len(point.jets), bool)
    return ~varies.reshape(len(point.jets), equations.n)


def _vanishes(jacobians: list[np.ndarray], rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Where the weighted sum of coefficients is zero at all points, shape `(levels, n)`."""
    vanishes = np.ones(jacobians[0].shape[1:], bool)
    for J in jacobians:
        parts = weights[:, None, None] * J[rows]
        vanishes &= np.abs(parts.sum(axis=0)) <= _ROUNDING * np.abs(parts).sum(axis=0)
    return vanishes


def _common_null_vectors(matrices: list[np.ndarray]) -> list[np.ndarray]:
    """Return the common null vectors with few numbers that are not zero, the first positive, the
    largest of them 1. Columns of each matrix are scaled
    for themselves: exponential functions differ by many decades from sample to sample."""
    every = np.concatenate(matrices, axis=1)
    scale = np.ones(len(every))
    for _ in range(3):
        columns = np.abs(every).max(axis=0)
        every = every / np.where(columns > 0, columns, 1)
        rows = np.abs(every).max(axis=1)
        rows = np.where(rows > 0, rows, 1)
        every, scale = every / rows[:, None], scale / rows
    left, values, _ = np.linalg.svd(every)
    null = left[:, values <= singular_below(every.dtype) * values[0]].T
    found = []
    for k in range(len(null)):  # reduced to echelon form
        column = int(np.argmax(np.abs(null[k])))
        null[k] = null[k] / null[k, column]
        others = np.arange(len(null)) != k
        null[others] -= null[others, column][:, None] * null[k][None, :]
    for v in null:
        weights = np.where(np.abs(v) > 1e-9, v, 0) * scale
        weights = weights / (np.abs(weights).max() * np.sign(weights[np.nonzero(weights)[0][0]]))
        whole = np.rint(weights)
        found.append(np.where(np.abs(weights - whole) < 1e-9, whole, weights))
    return found


def _jacobians(equations: Equations, there: np.ndarray, point: Point) -> list[np.ndarray]:
    """Return the Jacobians with respect to all derivatives, `(n, levels, n)`, at other times,
    values and parameters."""

    @jax.jit
    def jacobian(t: Array, jets: tuple[Array, ...], args: object) -> Array:
        along = lambda jets: equations(t, jets, eqx.combine(args, point.fixed_args))
        return jnp.stack(jax.jacfwd(along)(jets), axis=1)

    random = np.random.default_rng(1)

    def moved(x: Array, k: int) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        # Zeros, too: a parameter may be zero in the example only.
        size = jnp.where(x == 0, 1, x)
        return x + size * jnp.asarray(0.1 * k * random.normal(size=x.shape), x.dtype)

    found = []
    for k in range(_POINTS):
        args, jets = jax.tree_util.tree_map(functools.partial(moved, k=k), (point.args, point.jets))
        J = jacobian(jnp.asarray(random.uniform(), point.t.dtype), jets, args)
        found.append(np.where(there, np.asarray(J), 0))
    return found
