"""The end of a fit: its result, at the times of the data."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._constraint.checks import has_no_equations
from .._constraint.project import consistent_state
from .data import Records, unflatten
from .objective import Objective
from .optimize import OptimizerOutcome
from .pieces import edges_of
from .quality import judge
from .report import FitResult, Start


def summarize(
    objective: Objective, outcome: OptimizerOutcome, starts: tuple[Start, ...], records: Records
) -> FitResult:
    u, transform = outcome.u, objective.transform
    observed, *_, failed = jtu.tree_map(np.asarray, outcome.solved.values)
    bad = np.any(failed.reshape(records.ts.shape[0], -1) > 0, axis=1)
    theta = np.asarray(transform.values(u))
    quality = judge(u, outcome.solved, objective, records)
    prediction = _on_grid(observed, records)
    deviation = np.where(records.weights > 0, prediction - records.data, np.nan)
    prediction[bad], deviation[bad] = np.nan, np.nan
    lead = (lambda a: a) if records.many else (lambda a: a[0])
    like = lambda flat: jtu.tree_map(np.asarray, transform.unravel(jnp.asarray(flat)))
    first = np.flatnonzero(objective.pieces.first)
    y0 = jtu.tree_map(lambda a: lead(np.asarray(a)[first]), _initial_states(u, objective))
    covariance = quality.covariance
    return FitResult(
        parameters=like(theta),
        standard_errors=None if covariance is None else like(np.sqrt(np.diag(covariance))),
        names=transform.names,
        y0=y0,
        ts=lead(records.ts),
        prediction=unflatten(lead(prediction), records.observed),
        residuals=unflatten(lead(deviation), records.observed),
        history=np.asarray(outcome.losses),
        failed=bad,
        starts=starts,
        success=outcome.success and bool(np.all(np.isfinite(theta))),
        message=outcome.message,
        **quality._asdict(),
    )


@eqx.filter_jit
def _initial_states(u: Any, objective: Objective) -> Any:
    """Return the states at the starts of all pieces, on the manifold."""
    x, pieces = objective.chosen(u)

    def one(x: Any, piece: Any) -> Any:
        begin = objective.simulator.beginning(x, piece)
        given = begin.constraint, piece.start, begin.y0, begin.args
        return begin.y0 if has_no_equations(*given) else consistent_state(*given, throw=False)[0]

    return jax.vmap(one)(x, pieces)


def _on_grid(observed: np.ndarray, records: Records) -> np.ndarray:
    """Return the predictions of the pieces at the times of their records, `(R, T, k)`."""
    R, T, k = records.data.shape
    observed = observed.reshape(R, -1, *observed.shape[1:])
    edges = edges_of(T, observed.shape[1])
    grid = np.empty((R, T, k))
    for s, (a, b) in enumerate(itertools.pairwise(edges)):
        # in this order, a joint belongs to the piece that begins there
        grid[:, a : b + 1] = observed[:, s, : b - a + 1]
    return grid
