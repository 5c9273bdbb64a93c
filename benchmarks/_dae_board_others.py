"""Chemistry, a net of water pipes and the two-bit adder.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problems `orego`, `rober`, `chemakzo`, `water` and `tba`.
"""

import jax.numpy as jnp
import numpy as np

from . import _stiff_problems as stiff
from ._dae_board_problem import BoardProblem
from ._dae_board_tables import ADDER_START
from ._dae_board_transistors import (
    currents,
    Kind,
    pulse,
    stored,
    Technology,
    Transistors,
    VDD,
)


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


# From node, to node.
_PIPES = np.array(
    [
        (1, 2), (2, 3), (2, 6), (3, 4), (3, 5), (4, 5), (5, 10), (6, 5), (7, 4),
        (7, 8), (8, 5), (8, 10), (9, 8), (11, 9), (11, 12), (12, 7), (12, 8), (13, 11),
    ]
)  # fmt: skip
_WATER_FLOWS = [
    0.2298488296477430e-2,
    0.1188984650746585e-2,
    0.1109503645730845e-2,
    0.1589620100314825e-3,
    0.1030022640715102e-2,
    0.8710606306836165e-3,
    0.3243571480903489e-2,
    0.1109503645730845e-2,
    0.7120986206521341e-3,
    0.6414613963833099e-3,
    0.9416978549524347e-3,
    0.3403428519096511e-2,
    0.2397639310739395e-2,
    0.2397639310739395e-2,
    0.3348581430454180e-2,
    0.1353560017035444e-2,
    0.1995021413418736e-2,
    0.5746220741193575e-2,
]
# Of the nodes 1, 2, ..., 13.
_WATER_PRESSURES = [
    0.1111271078730254e6,
    0.1111269851929858e6,
    0.1111269255355337e6,
    0.1111269322658045e6,
    0.1111268591478108e6,
    0.1111269221703983e6,
    0.1111270121140691e6,
    0.1111270045592387e6,
    0.1111274419515807e6,
    0.1111255158881087e6,
    0.1111278793439227e6,
    0.1111270995171642e6,
    0.1111298338971779e6,
]


def water_tubes() -> BoardProblem:
    """Flows in 18 pipes, of which the friction is given by an implicit law, between 13 nodes of which
    two have a buffer: index 2."""
    viscosity, density, critical, length, roughness = 1.31e-6, 1e3, 2.3e3, 1e3, 2e-4
    area, buffer, gravity = np.pi / 4, 200.0, 9.8
    net = np.zeros((13, 18))
    net[_PIPES[:, 1] - 1, np.arange(18)] += 1
    net[_PIPES[:, 0] - 1, np.arange(18)] -= 1
    buffers = np.zeros(13)
    buffers[[4, 7]] = buffer / (density * gravity)

    def outside(t, demand):
        hours = t / 3600
        one_in = (1 - jnp.cos(jnp.exp(-hours) - 1)) / 200
        out = hours**2 * (3 * hours**2 - 92 * hours + 720) / 1e6
        flows = jnp.zeros(13).at[0].set(one_in).at[12].set(one_in * 200 / 80)
        return flows.at[9].set(-demand * out)

    def residual(t, x, xdot, args):
        flow, friction, pressure = x["flow"], x["friction"], x["pressure"]
        reynolds = jnp.abs(flow) / (viscosity * area)
        turbulent = reynolds > critical
        root = jnp.sqrt(friction)
        rough = 2 * roughness + 18.7 / (jnp.where(turbulent, reynolds, critical) * root)
        lost = friction * density * length * flow**2 / area**2
        smooth = 32 * viscosity * density * length * flow / area
        driving = -net.T @ pressure - jnp.where(turbulent, lost, smooth)
        return {
            "momentum": density * length / area * xdot["flow"] - driving,
            "friction": 1 / root - 1.74 + 2 * jnp.log10(rough),
            "balance": buffers * xdot["pressure"] - net @ flow - outside(t, args["demand"]),
        }

    start = {
        "flow": np.zeros(18),
        "friction": np.full(18, 0.47519404529185289807e-1),
        "pressure": np.full(13, 109800.0),
    }
    end = {"flow": _WATER_FLOWS, "pressure": _WATER_PRESSURES}
    return BoardProblem(
        residual,
        start,
        {"demand": 1.0},
        61200.0,
        end,
        "demand",
        rtol=1e-8,
        atol=1e-11,
        short=3600.0,
    )


_TIME, _STIFF = 1e4, 5.0
_GAIN = 43.7e-6 * _TIME * _STIFF
_ADDER = Technology(
    40 / (_TIME * _STIFF),
    100 / (_TIME * _STIFF),
    0.6e-4 * _TIME,
    2.4e-5 * _TIME,
    1e-15 * _TIME * _STIFF,
    (
        Kind(-2.43, 0.2, 1.28, 53.5e-6 * _TIME * _STIFF, 53.5e-6 * _TIME * _STIFF),
        *(Kind(0.2, 0.035, 1.01, k * 4 * _GAIN, k * 4 * _GAIN) for k in (1, 2, 3)),
    ),
)
_GROUND, _SUPPLY, _INPUTS = 175, 176, 177  # behind the 175 nodes


def _gate(first: int, rows: list[tuple[int, int, int, int, int]]) -> list[tuple[int, ...]]:
    """The load (a depletion transistor that gives the result at node 4) and others, each by the
    offset of its own nodes, of its source and drain, the place of its gate, and its kind."""
    place = lambda k: k if k >= _GROUND else first + k
    load = (first, first + 4, _SUPPLY, first + 4, 0)
    return [load, *((first + k, place(s), first + d, g, kind) for k, s, d, g, kind in rows)]


def _nor(first: int, u1: int, u2: int) -> list[tuple[int, ...]]:
    return _gate(first, [(5, _GROUND, 4, u1, 1), (9, _GROUND, 4, u2, 1)])


def _and_or_not(first: int, u1: int, u2: int, u3: int) -> list[tuple[int, ...]]:
    """Not (u1 or (u2 and u3))."""
    return _gate(first, [(5, _GROUND, 4, u1, 1), (9, 13, 4, u2, 2), (14, _GROUND, 13, u3, 2)])


def _nand(first: int, u1: int, u2: int) -> list[tuple[int, ...]]:
    return _gate(first, [(5, 9, 4, u1, 2), (10, _GROUND, 9, u2, 2)])


def _or_and_not(first: int, u1: int, u2: int, u3: int) -> list[tuple[int, ...]]:
    """Not (u1 and (u2 or u3))."""
    return _gate(first, [(5, 9, 4, u1, 2), (10, _GROUND, 9, u2, 2), (14, _GROUND, 9, u3, 2)])


def _adder_parts() -> Transistors:
    """Nodes count from 0; the results of the gates are at 4, 17, 35, 48, 66, 84, 97, 115, 129, 147."""
    v1, v2, v3, v4, carry = range(_INPUTS, _INPUTS + 5)
    rows = _nor(0, v1, v2) + _and_or_not(13, 4, v2, v1) + _nor(31, 17, carry)
    rows += _and_or_not(44, 35, carry, 17) + _and_or_not(62, 4, carry, 17) + _nor(80, v3, v4)
    rows += _and_or_not(93, 84, v4, v3) + _nand(111, 66, 97) + _or_and_not(125, 115, 66, 97)
    rows += _and_or_not(143, 84, 4, 97)
    rows += [(161, 165, 147, 97, 3), (166, 170, 165, 17, 3), (171, _GROUND, 170, carry, 3)]
    return Transistors.of(rows)


def two_bit_adder() -> BoardProblem:
    """Charges and voltages of 175 nodes."""
    parts, outputs = _adder_parts(), np.array([48, 129, 147])

    def given(t, supply):
        shapes = ((0, 5, 20), (10, 15, 40), (30, 35, 80), (70, 75, 160), (150, 155, 320))
        pulses = [pulse(t, delay, 5, high, 5, period) for delay, high, period in shapes]
        return jnp.stack([jnp.zeros_like(t), jnp.full_like(t, supply), *pulses])

    def residual(t, x, xdot, args):
        u = jnp.concatenate([x["u"], given(t, VDD)])
        # As published, capacitors to the supply have the charge of their own voltage.
        charged = jnp.concatenate([x["u"], given(t, 0.0)])
        held = stored(_ADDER, parts, u, charged, 175)
        held = held.at[outputs].add(args["load"] * x["u"][outputs])
        return {
            "current": xdot["charge"] - currents(_ADDER, parts, u, 175),
            "charge": x["charge"] - held,
        }

    start = {"u": ADDER_START, "charge": np.zeros(175)}
    end = np.full(175, np.nan)
    end[outputs] = [0.2040419147264534, 0.4997238455712048e1, 0.2038985905095614]
    return BoardProblem(
        residual,
        start,
        {"load": 2.0},
        320.0,
        {"u": end},
        "load",
        rtol=1e-5,
        atol=1e-5,
        floor=1.0,
        jumps=tuple(np.arange(5.0, 320.0, 5.0)),
        short=5.0,
    )


def others() -> dict[str, BoardProblem]:
    return {
        "Oregonator": oregonator(),
        "Robertson": robertson(),
        "chemical Akzo Nobel": chemical_akzo_nobel(),
        "water tubes": water_tubes(),
        "two-bit adder": two_bit_adder(),
    }
