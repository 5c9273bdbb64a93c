"""The smaller circuits of the board: transistor amplifier, charge pump and NAND gate.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problems `transamp`, `pump` and `nand`; as the pages of SciML's benchmarks quote them.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..tools import stiff_problems as stiff
from .problem import BoardProblem
from .transistors import currents, Kind, pulse, stored, Technology, Transistors, VDD


def transistor_amplifier() -> BoardProblem:
    """Charges move between eight nodes; the matrix of the capacitors is singular."""
    problem = stiff.PROBLEMS["transistor amplifier"]
    field, capacitors = stiff.transistor(jnp), problem.mass

    def residual(t, x, xdot, args):
        return args["capacity"] * capacitors @ xdot["u"] - field(t, x["u"], None)

    start = {"u": problem.y0}
    return BoardProblem(
        residual,
        start,
        {"capacity": 1.0},
        problem.t1,
        {"u": problem.end},
        "capacity",
        rtol=1e-7,
        atol=1e-7,
        floor=1.0,
        short=0.01,
        short_tolerance=1e-9,
    )


_PUMP = 0.2, 0.035, 1.01  # threshold voltage, bulk effect, potential


def _pump_charges(u: Any, capacity: float) -> Any:
    """Of gate, source and drain of a MOS transistor at the voltages of its three terminals."""
    vt0, gamma, potential = _PUMP
    gate_bulk, gate_source, gate_drain = u[0], u[0] - u[1], u[0] - u[2]
    high, low = jnp.maximum(gate_source, gate_drain), jnp.minimum(gate_source, gate_drain)
    flat = vt0 - gamma * np.sqrt(potential) - potential
    under = jnp.sqrt(jnp.maximum(potential - high + gate_bulk, 1e-12))
    threshold = vt0 + gamma * (under - np.sqrt(potential))
    above = jnp.maximum(gate_bulk - flat, 0.0)
    depleted = gamma * (jnp.sqrt((gamma / 2) ** 2 + above) - gamma / 2)
    on = high > threshold
    at_source = jnp.where(on, high - threshold, 1.0)
    at_drain = jnp.where(on & (low > threshold), low - threshold, 0.0)
    channel = at_source + at_drain - at_source * at_drain / (at_source + at_drain)
    gate = jnp.where(on, 2 / 3 * channel + gamma * under, depleted)
    gate = jnp.where(gate_bulk <= flat, gate_bulk - flat, gate)
    inverted = on & (gate_bulk > flat)
    return capacity * gate, capacity * jnp.where(inverted, -channel / 3, 0.0)


def charge_pump() -> BoardProblem:
    """Index 2: two capacitors and a transistor, driven by trapezoidal pulses of 20 V."""
    to_source, to_drain = 1.6e-12, 0.4e-12
    period = 120e-9

    def source(t):
        return 4 * pulse(t, 50e-9, 10e-9, 50e-9, 10e-9, period)

    def residual(t, x, xdot, args):
        charge, rate, u = x["charge"], xdot["charge"], x["u"]
        gate, channel = _pump_charges(u, args["oxide"])
        return {
            "gate": rate[0] + x["current"],
            "source": rate[1] + rate[2],
            "drain": rate[3] + rate[4],
            "supply": u[0] - source(t),
            "charges": charge
            - jnp.stack([gate, to_source * u[1], channel, to_drain * u[2], channel]),
        }

    gate, channel = (float(x) for x in _pump_charges(jnp.zeros(3), 4e-12))
    start = {
        "charge": np.array([gate, 0.0, channel, 0.0, channel]),
        "u": np.zeros(3),
        "current": np.asarray(0.0),
    }
    # The transistor is off at the end, the source falls by 2 V/ns: elementary. Of two published
    # values of the current one agrees with this to 7 digits, the other to 5.
    vt0, gamma, potential = _PUMP
    root = np.sqrt((gamma / 2) ** 2 + gamma * np.sqrt(potential) + potential - vt0)
    held, rate = 4e-12 * gamma * (root - gamma / 2), 4e-12 * gamma / (2 * root) * 2e9
    end = {"charge": [held] + [np.nan] * 4, "current": rate}
    jumps = tuple(k * period + at for k in range(10) for at in (50e-9, 60e-9, 110e-9, 120e-9))[:-1]
    return BoardProblem(
        residual,
        start,
        {"oxide": 4e-12},
        10 * period * (1 - 1e-14),
        end,
        "oxide",
        rtol=1e-8,
        atol=1e-8,
        jumps=jumps,
    )


_GATE = 0.6e-4
_NAND = Technology(
    4.0,
    10.0,
    _GATE,
    2.4e-5,
    1e-14,
    (Kind(-2.43, 0.2, 1.28, 5.35e-4, 5.35e-4), Kind(0.2, 0.035, 1.01, 1.748e-3, 1.748e-4)),
)


def nand_gate() -> BoardProblem:
    """Fourteen nodes; capacitances depend on voltages, `C(u) u' = i(t, u)`."""
    ground, supply, first, second = 14, 15, 16, 17
    # Nodes of their own, source, drain, gate, kind.
    parts = Transistors.of([(0, 4, supply, 4, 0), (5, 9, 4, first, 1), (10, ground, 9, second, 1)])
    load = np.zeros(14)
    load[[4, 9]] = 0.5e-4

    def inputs(t):
        driven = [pulse(t, 5, 5, 5, 5, 20), pulse(t, 15, 5, 15, 5, 40)]
        return jnp.stack([jnp.zeros_like(t), jnp.full_like(t, VDD), *driven])

    def residual(t, x, xdot, args):
        given, changing = jax.jvp(inputs, (t,), (jnp.ones_like(t),))
        u, du = jnp.concatenate([x["u"], given]), jnp.concatenate([xdot["u"], changing])
        displaced = stored(_NAND, parts, u, du, 14) + args["load"] * load * xdot["u"]
        return displaced - currents(_NAND, parts, u, 14)

    # Five nodes of bulk at VBB.
    start = np.array([5, 5, -2.5, -2.5, 5, 3.62385, 5, -2.5, -2.5, 3.62385, 0, 3.62385, -2.5, -2.5])
    end = [
        0.4971088699385777e1,
        0.4999752103929311e1,
        -0.2499998781491227e1,
        -0.2499999999999975e1,
        0.4970837023296724e1,
        -0.2091214032073855,
        0.4970593243278363e1,
        -0.2500077409198803e1,
        -0.2499998781491227e1,
        -0.2090289583878100,
        -0.2399999999966269e-3,
        -0.2091214032073855,
        -0.2499999999999991e1,
        -0.2500077409198803e1,
    ]
    jumps = tuple(np.arange(5.0, 80.0, 5.0))
    return BoardProblem(
        residual,
        {"u": start},
        {"load": 1.0},
        80.0,
        {"u": end},
        "load",
        rtol=1e-9,
        atol=1e-9,
        floor=1.0,
        jumps=jumps,
        short=12.0,
    )


def circuits() -> dict[str, BoardProblem]:
    return {
        "transistor amplifier": transistor_amplifier(),
        "charge pump": charge_pump(),
        "NAND gate": nand_gate(),
    }
