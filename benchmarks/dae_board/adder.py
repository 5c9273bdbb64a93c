"""The two-bit adder: 53 transistors between 175 nodes.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problem `tba`.
"""

import jax.numpy as jnp
import numpy as np

from .problem import BoardProblem
from .tables import ADDER_START
from .transistors import currents, Kind, pulse, stored, Technology, Transistors, VDD


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

    u0 = jnp.asarray(ADDER_START)
    charge0 = -residual(0.0, {"u": u0, "charge": 0.0}, {"charge": 0.0}, {"load": 2.0})["charge"]
    start = {"u": ADDER_START, "charge": np.asarray(charge0)}
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
        form="index-1",
        short=5.0,
        short_tolerance=1e-7,
    )
