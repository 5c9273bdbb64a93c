"""Equations whose highest derivatives cancel in a combination of them.

    C (u' - v') = i(u),   C (v' - u') = j(v)

are structurally nonsingular, but cannot be solved for `u'` and `v'`: their sum `0 = i(u) + j(v)`
contains no derivative. Such combinations are found if the weights are constant, and if the coefficients
are constant, too, or are added and subtracted as one number (like the charge between two nodes of a
circuit). The combination replaces one of the equations.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array

from .._jaxpr.incidence import incidence
from .._linalg.condition import singular_below
from .analysis import Analysis
from .equations import EquationCombination
from .occurrence import Example, Occurrence, tracked


# A sum counts as zero below this fraction of its terms.
_ROUNDING = 1e-12
_POINTS = 3


def without_cancellations(found: Analysis) -> Analysis:
    """Replace equations by combinations without their highest derivatives, as long as there are any."""
    while found.samples.singular and (repairs := cancelled(found)):
        equations = found.example.equations
        for repair in repairs:
            equations = equations.combined(repair.combination)
        example = found.example._replace(equations=equations)
        gone = {repair.combination.row: repair.gone for repair in repairs}
        occurrence = Occurrence.of(example).without(found.occurrence, gone)
        better = Analysis.of(example, occurrence, found.implicit)
        if better is None:
            return found
        found = better
    return found


class Cancelled(NamedTuple):
    """A combination that replaces an equation, and the derivatives it has lost, `gone[k, j]`."""

    combination: EquationCombination
    gone: np.ndarray


def cancelled(analysis: Analysis) -> list[Cancelled]:
    """Return the cancellations among equations that are differentiated equally often: those that hold
    for other parameters and times, too, and of which none changes an equation that another one needs."""
    example, occurrence, layout = analysis.example, analysis.occurrence, analysis.layout
    jacobians = _jacobians(example, occurrence.there)
    found: list[Cancelled] = []
    for weights in _common_null_vectors(analysis.samples.matrices):
        (used,) = np.nonzero(weights)
        if len(used) < 2 or len(set(analysis.c[used].tolist())) > 1:
            continue
        rows, weights = analysis.rows[used], weights[used]
        if any(other.combination.row in rows for other in found):
            continue
        constant = ~occurrence.varies[rows].any(axis=0) | _constant(example, rows, weights)
        gone = constant & _vanishes(jacobians, rows, weights)
        leading = layout.aliases.merged(gone[None])[0]
        highest = layout.structure.d - analysis.c[used[0]]
        stands = layout.aliases.merged(occurrence.there[rows].any(axis=0)[None])[0]  # pyright: ignore[reportIndexIssue]
        at = np.maximum(highest, 0), np.arange(len(highest))
        if ((highest >= 0) & stands[at] & ~leading[at]).any():
            continue
        target = int(rows[np.argmax(np.abs(weights))])
        parts = tuple(zip(rows.tolist(), weights.tolist(), strict=True))
        found.append(Cancelled(EquationCombination(target, parts), gone))
    return found


def _constant(example: Example, rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return which coefficients of the weighted sum are constant, shape `(levels, n)`. Found from its
    gradient, in which numbers are added and subtracted before they are multiplied."""
    shape = len(example.jets), example.equations.n
    cotangent = np.zeros(example.equations.n)
    cotangent[rows] = weights

    def gradient(t: Array, jets: tuple[Array, ...], args: object) -> Array:
        _, pullback = jax.vjp(lambda jets: example.residual(t, jets, args), jets)
        return jnp.concatenate(pullback(jnp.asarray(cotangent, jets[0].dtype))[0])

    anything = np.ones(1, bool)
    inputs = [tracked(tree, anything) for tree in (example.t, example.jets, example.args)]
    try:
        return ~incidence(gradient, *inputs).depends[:, 0].reshape(shape)
    except (ValueError, RuntimeError):  # no gradient: `while_loop`, the derivative of a solve
        return np.zeros(shape, bool)


def _vanishes(jacobians: list[np.ndarray], rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return which coefficients of the weighted sum are zero at all points, shape `(levels, n)`."""
    vanishes = np.ones(jacobians[0].shape[1:], bool)
    for J in jacobians:
        parts = weights[:, None, None] * J[rows]
        vanishes &= np.abs(parts.sum(axis=0)) <= _ROUNDING * np.abs(parts).sum(axis=0)
    return vanishes


def _common_null_vectors(matrices: list[sp.csr_array]) -> list[np.ndarray]:
    """Return the common null vectors with few nonzero entries, the first positive, the largest of them
    1. The columns of each matrix are scaled separately: exponential functions differ by many decades
    from sample to sample."""
    every = sp.hstack(matrices).toarray()
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
    for k in range(len(null)):  # reduce to echelon form
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


def _jacobians(example: Example, there: np.ndarray) -> list[np.ndarray]:
    """Return all Jacobians `(n, levels, n)` at other times, values and parameters."""

    @jax.jit
    def jacobian(t: Array, jets: tuple[Array, ...], args: object) -> Array:
        along = lambda jets: example.residual(t, jets, args)
        return jnp.stack(jax.jacfwd(along)(jets), axis=1)

    random = np.random.default_rng(1)

    def moved(x: Array, k: int) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        # Zeros are changed, too: a parameter may be zero in the example only.
        size = jnp.where(x == 0, 1, x)
        return x + size * jnp.asarray(0.1 * k * random.normal(size=x.shape), x.dtype)

    found = []
    for k in range(_POINTS):
        inputs = example.args, example.jets
        args, jets = jax.tree_util.tree_map(functools.partial(moved, k=k), inputs)
        J = jacobian(jnp.asarray(random.uniform(), example.t.dtype), jets, args)
        found.append(np.where(there, np.asarray(J), 0))
    return found
