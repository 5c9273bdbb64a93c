"""Whether a trajectory that an optimizer has found can be used, and what to do if not."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .quasi_newton import Minimum
from .shooting import Knots, solve_intervals
from .transcription import Transcription


_CLOSED, _EXACT = 1e-6, 1e-3  # largest gaps and integration errors of a motion that is found


class Measured(NamedTuple):
    """How well the intervals fit together, where they do least, how far the goal is missed, the largest value of
    the path constraint (minus infinity without one) and where it is, and how well the intervals are solved."""

    gap: float
    at: float
    miss: float
    excess: float
    excess_at: float
    error: float


def measure(T: Transcription, v: np.ndarray) -> Measured:
    """Solve each interval again with twice as many steps, as two halves."""
    now, ts, u = T.at(v), np.asarray(T.charts.ts), T.at(v).u
    size, coarse = 1 + np.abs(now.knots.x).max(), now.ends.reached[:, :-1]
    gaps = np.abs(coarse - now.knots.x[1:]).max(axis=1) / size
    middle, between = (ts[1:] + ts[:-1]) / 2, (u[1:] + u[:-1]) / 2
    halves = ((ts[:-1], middle), (u[:-1], between)), ((middle, ts[1:]), (between, u[1:]))
    x, by_z, cost = now.knots.x[:-1], jnp.asarray(now.knots.by_z[:-1]), 0.0
    for times, inputs in halves:
        times, pairs = (jnp.asarray(np.stack(pair, axis=1)) for pair in (times, inputs))
        ends = solve_intervals(T.shooting, times, Knots(jnp.asarray(x), by_z), pairs)
        x, cost = np.asarray(ends.reached[:, :-1]), cost + np.asarray(ends.reached[:, -1]).sum()
    coarse_cost = now.ends.reached[:, -1].sum()
    errors = np.abs(x - coarse).max() / size, abs(cost - coarse_cost) / (1 + abs(cost))
    error = np.max(errors)  # NaN if one is
    worst = int(np.argmax(np.nan_to_num(gaps, nan=np.inf)))
    miss = float(np.abs(now.last.values[1:]).max(initial=0))
    path = now.path.values.max(axis=1, initial=-np.inf)  # NaN if one is
    last = int(np.argmax(np.nan_to_num(path, nan=np.inf)))
    excess = float(path[last]), float(ts[last])
    return Measured(float(gaps[worst]), float(ts[worst + 1]), miss, *excess, float(error))


def message_of(found: Minimum, measured: Measured) -> str:
    """Return what is wrong with a result, nothing if it can be used."""
    if not np.max([measured.gap, measured.miss, measured.excess]) <= _CLOSED:  # NaN if one is
        excess = f", the `path_constraint` {measured.excess:.2g} at t = {measured.excess_at:.6g}"
        return (
            f"No motion was found: after {found.iterations} iterations the parts of the motion are {measured.gap:.2g} apart, most at "
            f"t = {measured.at:.6g}{'' if measured.excess == -np.inf else excess}, and the function `goal` is {measured.miss:.2g}. "
            "The goal may be out of reach within `bounds`, the path and the time; otherwise give `states` or `inputs` that are "
            "nearer to a motion, or more `max_iterations`."
        )
    if not measured.error <= _EXACT:
        return (
            f"The steps are too coarse: twice as many change the motion by {measured.error:.2g}. Write more `steps`, or give more "
            "times."
        )
    if not found.is_final:
        return (
            f"The motion is possible, but its cost may still fall: {found.iterations} iterations are made. Write more "
            "`max_iterations`."
        )
    return ""
