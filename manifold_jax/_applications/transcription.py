"""Multiple shooting as a nonlinear program with sparse matrices, for optimizers of SciPy."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .shooting import (
    AtTheEnd,
    AtTheKnots,
    Charts,
    IntervalEnds,
    Knots,
    path_at,
    Shooting,
    solve_intervals,
    solve_last,
    states_at,
)


_FAR = 1e10  # what a gap is where a solve fails, so that the step there is refused


class Evaluation(NamedTuple):
    """Everything at one vector of unknowns, as NumPy arrays; `gaps` are those between the ends of intervals and
    the knots there, `(K - 1, d)`, with their derivatives by the unknowns before and after them."""

    knots: Knots
    u: np.ndarray
    ends: IntervalEnds
    last: AtTheEnd
    path: AtTheKnots
    gaps: np.ndarray
    by_start: np.ndarray
    by_end: np.ndarray


@dataclasses.dataclass
class Transcription:
    """The unknowns are the tangent coordinates of the knots that are free, and all inputs. `knots` and `inputs`
    are their places in the vector of unknowns, shapes `(K, d)` and `(K, m)`; -1 for knots that are given."""

    shooting: Shooting
    charts: Charts
    knots: np.ndarray
    inputs: np.ndarray
    evaluations: int = 0
    _key: bytes = b""
    _iterate: Any = None

    @staticmethod
    def of(
        shooting: Shooting, charts: Charts, m: int, ends_free: bool, periodic: bool = False
    ) -> "Transcription":
        """Return the problem whose first state is given, and unless `ends_free` the last one, too; or the periodic
        one, at whose last time state and inputs are the unknowns of the first."""
        K, _, d = charts.bases.shape
        knots, inputs = np.full((K, d), -1), np.arange(K * m).reshape(K, m)
        count, first = K - 1 if ends_free else K - 2, 0 if periodic else 1
        knots[first : count + first] = np.arange(count * d).reshape(count, d)
        if periodic:
            knots[-1], inputs[-1] = knots[0], inputs[0]
            charts = charts.closed()
        return Transcription(shooting, charts, knots, count * d + inputs)

    @property
    def size(self) -> int:
        return int(self.inputs.max()) + 1

    @property
    def is_periodic(self) -> bool:
        return bool(np.all(self.knots[0] == self.knots[-1]) and self.knots[0, 0] >= 0)

    @property
    def places(self) -> np.ndarray:
        """Return the places of what the gap after an interval depends on: the coordinates of the first knot, the
        inputs at both, and the coordinates of the second knot."""
        knots, inputs = self.knots, self.inputs
        return np.concatenate([knots[:-1], inputs[:-1], inputs[1:], knots[1:]], axis=1)

    def at(self, v: np.ndarray) -> Evaluation:
        if self._key != v.tobytes():
            self.evaluations += 1
            self._iterate, self._key = self._evaluated(v), v.tobytes()
        return self._iterate

    def _evaluated(self, v: np.ndarray) -> Evaluation:
        z, u = jnp.asarray(np.append(v, 0.0)[self.knots]), jnp.asarray(v[self.inputs])
        knots = states_at(self.shooting, self.charts, z, u)
        starts = Knots(*(leaf[:-1] for leaf in knots))
        pairs = jnp.stack([u[:-1], u[1:]], axis=1)
        times = jnp.stack([self.charts.ts[:-1], self.charts.ts[1:]], axis=1)
        ends = solve_intervals(self.shooting, times, starts, pairs)
        last = solve_last(self.shooting, knots.x[-1], knots.by_z[-1])
        path = path_at(self.shooting, self.charts.ts, knots, u)
        knots, u, ends, last, path = jax.tree.map(np.asarray, (knots, u, ends, last, path))
        differences = ends.reached[:, :-1] - knots.x[1:]
        gaps, slopes = gaps_of(differences, np.asarray(self.charts.bases[1:]))
        by_start, by_end = slopes @ ends.by_p[:, :-1], -slopes @ knots.by_z[1:]
        return Evaluation(knots, u, ends, last, path, gaps, by_start, by_end)

    def cost(self, v: np.ndarray) -> float:
        now = self.at(v)
        total = now.ends.reached[:, -1].sum() + now.last.values[0]
        return float(total) if np.isfinite(total) else _FAR

    def cost_gradient(self, v: np.ndarray) -> np.ndarray:
        gradient, none = np.zeros(self.size + 1), np.zeros(self.residual(v).size)
        np.add.at(gradient, self.places, self.gradients(self.at(v), none))
        return gradient[:-1]

    def residual(self, v: np.ndarray) -> np.ndarray:
        """Return the gaps between intervals, the residual of the goal and the path constraint."""
        now = self.at(v)
        parts = now.gaps.ravel(), now.last.values[1:], now.path.values.ravel()
        return np.nan_to_num(np.concatenate(parts), nan=_FAR)

    def lowest(self, v: np.ndarray) -> np.ndarray:
        """Return lower bounds of the residual, whose upper ones are zero."""
        count = self.at(v).path.values.size
        lowest = np.zeros(self.residual(v).size)
        lowest[lowest.size - count :] = -np.inf
        return lowest

    def jacobian(self, v: np.ndarray) -> sp.csr_array:
        now = self.at(v)
        count, d = now.gaps.shape
        rows = np.arange(count * d).reshape(count, d, 1)
        of_goal = count * d + np.arange(now.last.values.size - 1)[:, None]
        gaps = np.concatenate([now.by_start, now.by_end], axis=2)
        equations = count * d + of_goal.size
        of_path = equations + np.arange(now.path.values.size).reshape(*now.path.values.shape, 1)
        parts = [
            (rows, self.places[:, None, :], gaps),
            (of_goal, self.knots[None, -1], now.last.by_z[1:]),
            (of_path, self.knots[:, None], now.path.by_z),
            (of_path, self.inputs[:, None], now.path.by_u),
        ]
        return sum_entries(parts, (equations + of_path.size, self.size))

    def gradients(self, now: Evaluation, multipliers: np.ndarray) -> np.ndarray:
        """Return what each interval contributes to the gradient of `cost + multipliers @ residual`."""
        of_gaps, of_goal, of_path = np.split(
            multipliers, [now.gaps.size, multipliers.size - now.path.values.size]
        )
        of_gaps, of_path = of_gaps.reshape(now.gaps.shape), of_path.reshape(now.path.values.shape)
        by_start = np.einsum("kd,kdp->kp", of_gaps, now.by_start) + now.ends.by_p[:, -1]
        by_end = np.einsum("kd,kde->ke", of_gaps, now.by_end)
        by_end[-1] += np.append(1, of_goal) @ now.last.by_z
        d, m = self.knots.shape[1], self.inputs.shape[1]
        by_z = np.einsum("ks,ksd->kd", of_path, now.path.by_z)
        by_u = np.einsum("ks,ksm->km", of_path, now.path.by_u)
        by_start[:, :d] += by_z[:-1]
        by_start[:, d : d + m] += by_u[:-1]
        by_start[-1, d + m :] += by_u[-1]
        by_end[-1] += by_z[-1]
        return np.append(by_start, by_end, axis=1)

    def recentered(self, v: np.ndarray) -> tuple["Transcription", np.ndarray, np.ndarray]:
        """Return the same with charts around the states at `v`, where these are, and the derivatives of the new
        coordinates by the old ones, `(K, d, d)`."""
        now = self.at(v)
        given = self.shooting, self.charts.ts, now.knots.x, now.u
        charts = Charts.around(*given, dimension=self.knots.shape[1])
        if self.is_periodic:
            charts = charts.closed()
        turn = np.einsum("knd,kne->kde", charts.bases, now.knots.by_z)
        moved = v.copy()
        moved[: self.inputs[0, 0]] = 0
        new = Transcription(self.shooting, charts, self.knots, self.inputs, self.evaluations)
        return new, moved, turn


def gaps_of(differences: np.ndarray, bases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return differences of states `(K, n)` in tangent coordinates `(K, d)`, and the derivatives of these by the
    differences. States on the far side of the manifold may have none along the tangent space: a difference that
    is more than 45 degrees from it counts with its length, over the root of two."""
    gaps = np.einsum("knd,kn->kd", bases, differences)
    tangent, whole = (np.sum(x**2, axis=1) for x in (gaps, differences))
    gaps[:, 0] += np.where(tangent < 1e-12 * whole, 1e-6 * np.sqrt(whole), 0)  # any direction
    tangent, whole = (np.sum(x**2, axis=1) for x in (gaps, differences))
    is_far = whole > 2 * tangent
    tangent, whole = (np.where(is_far, np.maximum(x, 1e-300), 1) for x in (tangent, whole))
    scale = np.where(is_far, np.sqrt(whole / (2 * tangent)), 1)[:, None]
    along = np.einsum("knd,kd->kn", bases, gaps) / tangent[:, None]
    change = scale * np.where(is_far[:, None], differences / whole[:, None] - along, 0)
    slopes = scale[:, :, None] * np.swapaxes(bases, 1, 2) + gaps[:, :, None] * change[:, None, :]
    return scale * gaps, slopes


def sum_entries(parts: list[tuple[np.ndarray, ...]], shape: tuple[int, int]) -> sp.csr_array:
    """Sum values at rows and columns; places of -1 are those of no unknown."""
    flat = [np.stack([np.ravel(x) for x in np.broadcast_arrays(*part)]) for part in parts]
    rows, columns, values = np.concatenate(flat, axis=1)
    known = (rows >= 0) & (columns >= 0)
    index = rows[known].astype(int), columns[known].astype(int)
    return sp.csr_array(sp.coo_array((values[known], index), shape=shape))
