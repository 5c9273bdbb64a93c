"""Minimization of a transcription: a trust-region method of SciPy with second derivatives in blocks."""

from typing import Any, cast, NamedTuple

import numpy as np
import scipy.optimize as opt
import scipy.sparse as sp

from .transcription import Evaluation, sum_entries, Transcription


# So many iterations are made in the same charts. A chart far from its center is steep: problems that need
# 65 iterations with new charts do not end in 600 without.
_IN_THE_SAME_CHARTS = 50
_FIRST_CURVATURE = 0.1
_SMALL = 1e-8
_CLOSED = 1e-8


class BlockHessian:
    """Second derivatives of the Lagrangian, one block for each interval, by symmetric updates of rank one.

    Source: Bock & Plitt, IFAC Proc. 17 (1984) 1603-1608 (blocks of multiple shooting); Nocedal & Wright,
    Numerical Optimization (2006), 6.2 (the update).
    """

    def __init__(self, transcription: Transcription):
        count, size = transcription.places.shape
        self.transcription = transcription
        self.blocks = np.tile(_FIRST_CURVATURE * np.eye(size), (count, 1, 1))
        self.before: tuple[np.ndarray, Evaluation] | None = None

    def at(self, v: np.ndarray, multipliers: np.ndarray) -> sp.csr_array:
        """Return the matrix at the next iterate."""
        T, now = self.transcription, self.transcription.at(v)
        places = T.places
        if self.before is not None:
            last, iterate = self.before
            step = np.append(v - last, 0.0)[places]
            change = T.gradients(now, multipliers) - T.gradients(iterate, multipliers)
            self._update(step, change)
        self.before = v.copy(), now
        parts = [(places[:, :, None], places[:, None, :], self.blocks)]
        return sum_entries(parts, (T.size, T.size))

    def _update(self, step: np.ndarray, change: np.ndarray) -> None:
        rest = change - np.einsum("kij,kj->ki", self.blocks, step)
        product = np.sum(rest * step, axis=1)
        sizes = np.linalg.norm(rest, axis=1) * np.linalg.norm(step, axis=1)
        safe = np.isfinite(product) & (np.abs(product) > _SMALL * sizes)
        rest = np.where(safe[:, None], rest, 0)
        product = np.where(safe, product, 1)
        self.blocks += rest[:, :, None] * rest[:, None, :] / product[:, None, None]

    def turned(self, transcription: Transcription, turn: np.ndarray) -> None:
        """Go on in other coordinates of the knots."""
        d, back = turn.shape[1], np.linalg.pinv(turn)
        change = np.tile(np.eye(self.blocks.shape[1]), (self.blocks.shape[0], 1, 1))
        change[:, :d, :d], change[:, -d:, -d:] = back[:-1], back[1:]
        self.blocks = np.swapaxes(change, 1, 2) @ self.blocks @ change
        self.transcription, self.before = transcription, None


class Minimum(NamedTuple):
    """The unknowns, with the transcription whose charts they belong to, and the largest violation; how many
    iterations were made, and whether the cost falls no more."""

    transcription: Transcription
    v: np.ndarray
    cost: float
    residual: float
    iterations: int
    is_final: bool


def minimize(
    transcription: Transcription,
    start: np.ndarray,
    bounds: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> Minimum:
    """Minimize the cost where the residual and the inputs are within their bounds."""
    hessian, T, v = BlockHessian(transcription), transcription, start
    options: dict[str, Any] = dict(initial_barrier_parameter=1e-2)
    best, iterations = None, 0
    while True:
        limit = min(_IN_THE_SAME_CHARTS, max_iterations - iterations)
        result = _in_these_charts(T, hessian, v, bounds, dict(maxiter=limit, **options))
        iterations += result.nit
        found = Minimum(T, result.x, result.fun, result.constr_violation, iterations, False)
        is_closed = found.residual <= _CLOSED and np.isfinite(result.optimality)
        # The gradient may not become small: rounding, or bounds that only just bind.
        is_whole = result.status == 2 or result.nit >= _IN_THE_SAME_CHARTS
        gain = np.inf if best is None else best.cost - found.cost
        stalls = is_closed and is_whole and gain <= tolerance * (1 + abs(found.cost))
        if is_closed and gain > 0:
            best = found
        if result.status == 1 or stalls or iterations >= max_iterations:
            chosen = found if best is None or result.status == 1 else best
            chosen.transcription.evaluations = T.evaluations
            return chosen._replace(iterations=iterations, is_final=result.status == 1 or stalls)
        T, v, turn = T.recentered(result.x)
        hessian.turned(T, turn)
        options = _continued(result)


def _in_these_charts(
    T: Transcription, hessian: BlockHessian, v: np.ndarray, bounds: np.ndarray, options: Any
) -> opt.OptimizeResult:
    none, jacobian = sp.csr_array((T.size, T.size)), cast(Any, T.jacobian)
    return opt.minimize(
        T.cost,
        v,
        jac=T.cost_gradient,
        hess=lambda v: none,  # the cost is in that of the Lagrangian
        method="trust-constr",
        bounds=bounds,
        constraints=opt.NonlinearConstraint(
            T.residual, T.lowest(v), 0, jac=jacobian, hess=hessian.at
        ),
        options=dict(gtol=_SMALL, xtol=1e-12, **options),
    )


def _continued(result: opt.OptimizeResult) -> dict[str, Any]:
    """Return the options with which the next charts go on where the last ones have ended."""
    options = dict(
        initial_tr_radius=max(result.tr_radius, 1e-3),
        initial_constr_penalty=result.constr_penalty,
    )
    if "barrier_parameter" in result:  # not without bounds
        options["initial_barrier_parameter"] = result.barrier_parameter
        options["initial_barrier_tolerance"] = result.barrier_tolerance
    return options
