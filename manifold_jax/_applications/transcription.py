"""Multiple shooting as a nonlinear program with sparse matrices, for optimizers of SciPy."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .shooting import Charts, Ends, Knots, Last, Shooting, solve_intervals, solve_last, states_at


_FAR = 1e10  # what a gap is where a solve fails, so that the step there is refused


class Iterate(NamedTuple):
    """Everything at one vector of unknowns, as NumPy arrays."""

    knots: Knots
    u: np.ndarray
    ends: Ends
    last: Last


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
    def of(shooting: Shooting, charts: Charts, m: int, ends_free: bool) -> "Transcription":
        K, _, d = charts.bases.shape
        knots = np.full((K, d), -1)
        count = K - 1 if ends_free else K - 2
        knots[1 : count + 1] = np.arange(count * d).reshape(count, d)
        return Transcription(shooting, charts, knots, count * d + np.arange(K * m).reshape(K, m))

    @property
    def size(self) -> int:
        return self.inputs.max() + 1

    @property
    def places(self) -> np.ndarray:
        """Return the places of what the gap after an interval depends on: the coordinates of the first knot, the
        inputs at both, and the coordinates of the second knot."""
        knots, inputs = self.knots, self.inputs
        return np.concatenate([knots[:-1], inputs[:-1], inputs[1:], knots[1:]], axis=1)

    def at(self, v: np.ndarray) -> Iterate:
        if self._key != v.tobytes():
            self.evaluations += 1
            z, u = jnp.asarray(np.append(v, 0.0)[self.knots]), jnp.asarray(v[self.inputs])
            knots = states_at(self.shooting, self.charts, z, u)
            starts, ends = Knots(*(leaf[:-1] for leaf in knots)), self._ends
            pairs = jnp.stack([u[:-1], u[1:]], axis=1)
            times = jnp.stack([self.charts.ts[:-1], self.charts.ts[1:]], axis=1)
            reached = solve_intervals(self.shooting, times, starts, pairs, ends)
            last = solve_last(self.shooting, knots.x[-1], knots.by_z[-1])
            self._iterate = jax.tree.map(np.asarray, Iterate(knots, u, reached, last))
            self._key = v.tobytes()
        return self._iterate

    @property
    def _ends(self) -> Charts:
        return Charts(*(leaf[1:] for leaf in self.charts))

    def cost(self, v: np.ndarray) -> float:
        now = self.at(v)
        total = now.ends.reached[:, -1].sum() + now.last.values[0]
        return float(total) if np.isfinite(total) else _FAR

    def cost_gradient(self, v: np.ndarray) -> np.ndarray:
        none = np.zeros(self.residual(v).size)
        gradient = np.zeros(self.size + 1)
        np.add.at(gradient, self.places, self.gradients(self.at(v), none))
        return gradient[:-1]

    def residual(self, v: np.ndarray) -> np.ndarray:
        """Return the gaps between intervals and the residual of the goal."""
        now, (_, centers, bases) = self.at(v), self._ends
        away = np.einsum("knd,kn->kd", bases, now.knots.x[1:] - centers)
        gaps = now.ends.reached[:, :-1] - away
        return np.nan_to_num(np.append(gaps, now.last.values[1:]), nan=_FAR)

    def jacobian(self, v: np.ndarray) -> sp.csr_array:
        now = self.at(v)
        gaps = np.concatenate([now.ends.by_p[:, :-1], self._by_end(now)], axis=2)
        count, d, _ = gaps.shape
        rows = np.arange(count * d).reshape(count, d, 1)
        of_goal = count * d + np.arange(now.last.values.size - 1)[:, None]
        parts = [
            (rows, self.places[:, None, :], gaps),
            (of_goal, self.knots[None, -1], now.last.by_z[1:]),
        ]
        return sum_entries(parts, (count * d + of_goal.size, self.size))

    def gradients(self, now: Iterate, multipliers: np.ndarray) -> np.ndarray:
        """Return what each interval contributes to the gradient of `cost + multipliers @ residual`."""
        count, d = self.knots.shape[0] - 1, self.knots.shape[1]
        of_gaps = multipliers[: count * d].reshape(count, d)
        weights = np.append(of_gaps, np.ones((count, 1)), axis=1)
        by_end = np.einsum("kd,kde->ke", of_gaps, self._by_end(now))
        by_end[-1] += np.append(1, multipliers[count * d :]) @ now.last.by_z
        return np.append(np.einsum("kr,krp->kp", weights, now.ends.by_p), by_end, axis=1)

    def _by_end(self, now: Iterate) -> np.ndarray:
        return -np.einsum("knd,kne->kde", self._ends.bases, now.knots.by_z[1:])

    def recentered(self, v: np.ndarray) -> tuple["Transcription", np.ndarray, np.ndarray]:
        """Return the same with charts around the states at `v`, where these are, and the derivatives of the new
        coordinates by the old ones, `(K, d, d)`."""
        now = self.at(v)
        charts = Charts.around(self.shooting, self.charts.ts, now.knots.x, now.u)
        turn = np.einsum("knd,kne->kde", charts.bases, now.knots.by_z)
        moved = v.copy()
        moved[: self.inputs[0, 0]] = 0
        new = Transcription(self.shooting, charts, self.knots, self.inputs, self.evaluations)
        return new, moved, turn


def sum_entries(parts: list[tuple[np.ndarray, ...]], shape: tuple[int, int]) -> sp.csr_array:
    """Sum values at rows and columns; places of -1 are those of no unknown."""
    flat = [np.stack([np.ravel(x) for x in np.broadcast_arrays(*part)]) for part in parts]
    rows, columns, values = np.concatenate(flat, axis=1)
    known = (rows >= 0) & (columns >= 0)
    index = rows[known].astype(int), columns[known].astype(int)
    return sp.csr_array(sp.coo_array((values[known], index), shape=shape))
