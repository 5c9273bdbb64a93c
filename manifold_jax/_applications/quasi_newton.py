"""Minimization of a transcription: a trust-region method of SciPy with second derivatives in blocks."""

from typing import Any

import numpy as np
import scipy.optimize as opt
import scipy.sparse as sp

from .transcription import Evaluation, sum_entries, Transcription


# So many iterations are made in the same charts. A chart far from its center is steep: problems that need
# 65 iterations with new charts do not end in 600 without.
_IN_THE_SAME_CHARTS = 50
_FIRST_CURVATURE = 0.1
_SMALL = 1e-8


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
        safe = np.abs(product) > _SMALL * sizes
        product = np.where(safe, product, np.inf)
        self.blocks += rest[:, :, None] * rest[:, None, :] / product[:, None, None]

    def turned(self, transcription: Transcription, turn: np.ndarray) -> None:
        """Go on in other coordinates of the knots."""
        d, back = turn.shape[1], np.linalg.inv(turn)
        change = np.tile(np.eye(self.blocks.shape[1]), (self.blocks.shape[0], 1, 1))
        change[:, :d, :d], change[:, -d:, -d:] = back[:-1], back[1:]
        self.blocks = np.swapaxes(change, 1, 2) @ self.blocks @ change
        self.transcription, self.before = transcription, None


def minimize(
    transcription: Transcription,
    start: np.ndarray,
    bounds: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> tuple[Transcription, opt.OptimizeResult]:
    """Minimize the cost where the residual is zero and the inputs are within their bounds; return the
    transcription with the last charts, too, and the number of all iterations in `nit`."""
    hessian, iterations, v, before = BlockHessian(transcription), 0, start, np.inf
    options: dict[str, Any] = dict(initial_barrier_parameter=1e-2)
    while True:
        T, limit = transcription, min(_IN_THE_SAME_CHARTS, max_iterations - iterations)
        none = sp.csr_array((T.size, T.size))
        jacobian: Any = T.jacobian
        closed = opt.NonlinearConstraint(T.residual, 0, 0, jac=jacobian, hess=hessian.at)
        result = opt.minimize(
            T.cost,
            v,
            jac=T.cost_gradient,
            hess=lambda v, none=none: none,  # the cost is in that of the Lagrangian
            method="trust-constr",
            bounds=bounds,
            constraints=closed,
            options=dict(maxiter=limit, gtol=tolerance, xtol=1e-12, **options),
        )
        iterations += result.nit
        # Steps of which rounding leaves nothing are too small twice.
        change, before = abs(result.fun - before), result.fun
        still = result.status == 2 and change <= 1e-9 * (1 + abs(result.fun))
        finished = result.status == 1 or still
        if finished or iterations >= max_iterations:
            result.nit = iterations
            return T, result
        transcription, v, turn = T.recentered(result.x)
        hessian.turned(transcription, turn)
        options = dict(
            initial_tr_radius=max(result.tr_radius, 1e-3),
            initial_constr_penalty=result.constr_penalty,
        )
        if "barrier_parameter" in result:  # not without bounds
            options["initial_barrier_parameter"] = result.barrier_parameter
            options["initial_barrier_tolerance"] = result.barrier_tolerance
