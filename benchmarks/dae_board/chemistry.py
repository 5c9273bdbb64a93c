"""The chemistry of the board.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problems `orego`, `rober` and `chemakzo`.
"""

import jax.numpy as jnp
import numpy as np

from ..tools import stiff_problems as stiff
from .problem import BoardProblem


def oregonator() -> BoardProblem:
    """An ODE, here as an implicit one."""

    def residual(t, x, xdot, args):
        a, b, c = x["y"]
        s, q, w = args["s"], 8.375e-6, 0.161
        reactions = [s * (b + a * (1 - q * a - b)), (c - (1 + a) * b) / s, w * (a - c)]
        return xdot["y"] - jnp.stack(reactions)

    end = {"y": [0.1000814870318523e1, 0.1228178521549917e4, 0.1320554942846706e3]}
    start = {"y": np.array([1.0, 2.0, 3.0])}
    return BoardProblem(residual, start, {"s": 77.27}, 360.0, end, "s", short=5.0)


def robertson() -> BoardProblem:
    problem = stiff.PROBLEMS["Robertson, DAE"]
    field = stiff.robertson_dae(jnp)

    def residual(t, x, xdot, args):
        rates = jnp.stack([args["slow"], 3e7, 1e4])
        return problem.mass * xdot["y"] - field(t, x["y"], rates)

    return BoardProblem(
        residual,
        {"y": problem.y0},
        {"slow": 0.04},
        problem.t1,
        {"y": problem.end},
        "slow",
        rtol=1e-8,
        atol=1e-14,
        dt0=1e-4,
        short=40.0,
    )


def chemical_akzo_nobel() -> BoardProblem:
    problem = stiff.PROBLEMS["chemical Akzo Nobel"]
    field = stiff.chemical_akzo_nobel(jnp)

    def residual(t, x, xdot, args):
        reactions = field(t, x["y"], None).at[1].add(3.3 * 0.9 / 737 * (args["inflow"] - 1))
        return problem.mass * xdot["y"] - reactions

    start = {"y": problem.y0}
    return BoardProblem(
        residual,
        start,
        {"inflow": 1.0},
        problem.t1,
        {"y": problem.end},
        "inflow",
        rtol=1e-10,
        atol=1e-12,
    )


def chemistry() -> dict[str, BoardProblem]:
    return {
        "Oregonator": oregonator(),
        "Robertson": robertson(),
        "chemical Akzo Nobel": chemical_akzo_nobel(),
    }
