"""A few trajectories that take much longer: Kepler orbits of which one in a hundred is nearly a line."""

import dataclasses
import math
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from ..tools.measure import compiled_for_any, interleaved


ECCENTRICITY, LARGEST_OTHER = 0.99, 0.3
ONE_IN = 100


@dataclasses.dataclass(frozen=True)
class HeavyTail:
    """`ratio` is the time of all divided by the sum of what each would take in full lanes: its
    steps, at the time per step of a batch without long ones."""

    trajectories: int
    lanes: int
    steps: float  # of a trajectory
    most_steps: int
    us_per_step_without: float
    us_per_step: float
    ratio: float


def measure(size: int, lanes: int, tolerance: float, repeats: int) -> HeavyTail:
    random = np.random.default_rng(0)
    even = random.uniform(0, LARGEST_OTHER, size)
    heavy = even.copy()
    heavy[random.choice(size, max(1, size // ONE_IN), replace=False)] = ECCENTRICITY
    program, _ = compiled_for_any(lambda e: _steps(e, lanes, tolerance), jnp.asarray(even))
    batches = {"even": jnp.asarray(even), "heavy": jnp.asarray(heavy)}
    timings = interleaved({k: lambda e=e: program(e) for k, e in batches.items()}, repeats)
    steps = {k: np.asarray(program(e)) for k, e in batches.items()}
    us = {k: 1e3 * timings[k].median_ms / steps[k].sum() for k in batches}
    return HeavyTail(
        size,
        lanes,
        float(steps["heavy"].mean()),
        int(steps["heavy"].max()),
        float(us["even"]),
        float(us["heavy"]),
        float(us["heavy"] / us["even"]),
    )


def _steps(eccentricities: Any, lanes: int, tolerance: float) -> jax.Array:
    """Three periods, from the pericentre."""
    e = eccentricities
    zero = jnp.zeros_like(e)
    y0s = jnp.stack([1 - e, zero, zero, jnp.sqrt((1 + e) / (1 - e))], axis=1)

    def invariants(t: Any, y: Any, e: Any) -> Any:
        r = jnp.sqrt(y[0] ** 2 + y[1] ** 2)
        energy = (y[2] ** 2 + y[3] ** 2) / 2 - 1 / r + 1 / 2
        return energy, y[0] * y[3] - y[1] * y[2] - jnp.sqrt(1 - e**2)

    def field(t: Any, y: Any, e: Any) -> Any:
        r2 = y[0] ** 2 + y[1] ** 2
        return jnp.concatenate([y[2:], -y[:2] / (r2 * jnp.sqrt(r2))])

    solver = mj.Projected(dfx.Tsit5(), mj.Constraint(invariants))
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    sol = mj.solve_ensemble(
        dfx.ODETerm(field),
        solver,
        0.0,
        6 * math.pi,
        None,
        y0s,
        e,
        stepsize_controller=controller,
        lanes=lanes,
        throw=True,
        args_axes=0,
    )
    return sol.stats["num_steps"]
