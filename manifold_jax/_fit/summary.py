"""The end of a fit: what was found, and how well the data determine it."""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._initial import consistent_state
from .data import Records, unflatten
from .objective import gaps, Objective, Solved, weighted
from .optimize import Outcome
from .pieces import edges_of
from .report import FitResult
from .uncertainty import describe, gauss_newton


def summarize(
    objective: Objective, outcome: Outcome, records: Records, absolute: bool, seen: Any
) -> FitResult:
    """`absolute`: whether the user knows `sigma`; `seen`: shapes of one observation."""
    u, transform = outcome.u, objective.transform
    observed, *_, failed = jtu.tree_map(np.asarray, outcome.solved.values)
    failed = failed > 0
    bad = np.any(failed.reshape(records.ts.shape[0], -1), axis=1)
    theta = np.asarray(transform.values(u[: transform.start.size]))
    errors = _errors(objective, outcome, records, absolute)
    prediction = _on_grid(observed, records)
    deviation = np.where(records.weights > 0, prediction - records.data, np.nan)
    prediction[bad], deviation[bad] = np.nan, np.nan
    lead = (lambda a: a) if records.many else (lambda a: a[0])
    like = lambda flat: jtu.tree_map(np.asarray, transform.unravel(jnp.asarray(flat)))
    starts = jtu.tree_map(lambda leaf: lead(np.asarray(leaf)), _initial_states(u, objective))
    spread = None if errors.covariance is None else like(np.sqrt(np.diag(errors.covariance)))
    return FitResult(
        parameters=like(theta),
        standard_errors=spread,
        covariance=errors.covariance,
        names=transform.names,
        y0=starts,
        noise=errors.noise,
        ts=lead(records.ts),
        prediction=unflatten(lead(prediction), seen),
        residuals=unflatten(lead(deviation), seen),
        history=np.asarray(outcome.losses),
        failed=bad,
        unidentifiable=errors.unidentifiable,
        at_bounds=transform.at_bounds(theta),
        success=outcome.success and bool(np.all(np.isfinite(theta))),
        message=outcome.message,
    )


class _Errors(NamedTuple):
    covariance: np.ndarray | None
    noise: float | None
    unidentifiable: tuple[str, ...]


def _errors(objective: Objective, outcome: Outcome, records: Records, absolute: bool) -> _Errors:
    """Of the parameters, from the Gauss-Newton matrix of records that were solved."""
    if objective.loss is not None or outcome.solved.matrices is None:
        return _Errors(None, None, ())
    r, J, C, D = jtu.tree_map(np.asarray, _linearize(outcome.u, outcome.solved, objective))
    failed = np.asarray(outcome.solved.values.failed) > 0
    used = (np.asarray(objective.pieces.weights) > 0) & ~failed[:, None, None]
    p = D.shape[0]
    found = gauss_newton(J[used], C.reshape(-1, J.shape[-1]))
    freedom = int(np.sum(used)) - found.rank
    size = np.sqrt(np.sum(r[used] ** 2) / freedom) if freedom > 0 else None
    if size is None and not absolute:
        return _Errors(None, None, ())
    scale = 1.0 if absolute else size**2
    covariance, lines = scale * (D @ found.covariance[:p, :p] @ D.T), []
    for direction in found.directions:
        line, involved = describe(direction, objective.transform.names)
        lines.append(line)
        covariance[involved], covariance[:, involved] = 0.0, 0.0
        covariance[involved, involved] = np.inf
    unit = 1.0 if absolute else np.max(records.weights)
    return _Errors(covariance, None if size is None else float(size / unit), tuple(lines))


@eqx.filter_jit
def _linearize(u: Any, solved: Solved, objective: Objective) -> Any:
    """Weighted residuals, their derivatives, those of the gaps, and those of the parameters."""

    def both(u: Any) -> Any:
        predicted = solved.around(u, objective)
        r = weighted(objective, predicted)
        return (r, gaps(objective, predicted)), r

    (J, C), r = jax.jacfwd(both, has_aux=True)(u)
    transform = objective.transform
    return r, J, C, jax.jacfwd(transform.values)(u[: transform.start.size])


@eqx.filter_jit
def _initial_states(u: Any, objective: Objective) -> Any:
    """Of all records, on the manifold."""
    x, pieces = objective.chosen(u)

    def one(x: Any, piece: Any) -> Any:
        begin = objective.simulator.beginning(x, piece, objective.transform)
        y0, _ = consistent_state(begin.constraint, piece.start, begin.y0, begin.args, throw=False)
        return y0

    count = pieces.start.size // objective.records
    return jtu.tree_map(lambda leaf: leaf[::count], jax.vmap(one)(x, pieces))


def _on_grid(observed: np.ndarray, records: Records) -> np.ndarray:
    """Predictions of the pieces back at the times of their records, `(R, T, k)`."""
    R, T, k = records.data.shape
    observed = observed.reshape(R, -1, *observed.shape[1:])
    edges = edges_of(T, observed.shape[1])
    grid = np.empty((R, T, k))
    for s, (a, b) in enumerate(itertools.pairwise(edges)):
        # in this order, a joint belongs to the piece that begins there
        grid[:, a : b + 1] = observed[:, s, : b - a + 1]
    return grid
