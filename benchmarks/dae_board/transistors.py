"""Circuits of MOS transistors after Shichman and Hodges, of the NAND gate and the two-bit adder.

Each transistor has four nodes of its own (source, drain, and the bulk at both), and lies between
two nodes of the circuit, its terminals. Source: Mazzia & Magherini, Test Set for Initial Value
Problem Solvers (2008), problems `nand` and `tba`.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np


class Kind(NamedTuple):
    """Threshold voltage, bulk effect, potential and gain, the last also for reverse voltages."""

    threshold: float
    gamma: float
    potential: float
    gain: float
    reverse_gain: float


class Technology(NamedTuple):
    """Resistances (source and drain, bulk), capacitances (gate, bulk), current of the junctions."""

    channel: float
    bulk: float
    gate_capacitance: float
    bulk_capacitance: float
    junction: float
    kinds: tuple[Kind, ...]


VDD, VBB = 5.0, -2.5
MODULATION, THERMAL, JUNCTION_POTENTIAL = 0.02, 25.85, 0.87


class Transistors(NamedTuple):
    """Places in the vector of all voltages, which ends with ground, the supply and the inputs."""

    first: np.ndarray  # of the four nodes of their own
    source: np.ndarray
    drain: np.ndarray
    gate: np.ndarray
    kind: np.ndarray

    @staticmethod
    def of(rows: list[tuple[int, int, int, int, int]]) -> "Transistors":
        return Transistors(*np.array(rows, int).T)


def _saturated(gain: Any, along: Any, drive: Any) -> Any:
    """The current for a voltage `along >= 0` of the channel and `drive` above the threshold."""
    linear = along * (2 * drive - along)
    current = jnp.where(drive <= along, drive**2, linear)
    return jnp.where(drive <= 0, 0.0, gain * current * (1 + MODULATION * along))


def _threshold(kind: tuple[Any, ...], bulk: Any) -> Any:
    vt0, gamma, potential, *_ = kind
    inside = jnp.maximum(potential - bulk, 1e-12)
    return vt0 + gamma * (jnp.sqrt(inside) - np.sqrt(potential))


def channel_currents(technology: Technology, parts: Transistors, v: Any) -> Any:
    """From drain to source, counted negative."""
    kind = tuple(np.array(technology.kinds)[parts.kind].T)
    s, d, bs, bd = (v[parts.first + k] for k in range(4))
    S, D, gate = v[parts.source], v[parts.drain], v[parts.gate]
    forward = -_saturated(kind[3], d - s, gate - s - _threshold(kind, bs - S))
    backward = _saturated(kind[4], s - d, gate - d - _threshold(kind, bd - D))
    return jnp.where(d > s, forward, backward)


def _junction(technology: Technology, v: Any) -> Any:
    return jnp.where(v <= 0, -technology.junction * jnp.expm1(jnp.minimum(v, 0) / THERMAL), 0.0)


def currents(technology: Technology, parts: Transistors, v: Any, nodes: int) -> Any:
    """Into the nodes."""
    k, S, D = parts.first, parts.source, parts.drain
    channel = channel_currents(technology, parts, v)
    to_source = (v[S] - v[k]) / technology.channel
    to_drain = (v[D] - v[k + 1]) / technology.channel
    at_source, at_drain = (
        _junction(technology, v[k + 2] - v[S]),
        _junction(technology, v[k + 3] - v[D]),
    )
    into = jnp.zeros_like(v)
    into = into.at[k].add(to_source - channel).at[k + 1].add(to_drain + channel)
    into = into.at[k + 2].add((VBB - v[k + 2]) / technology.bulk + at_source)
    into = into.at[k + 3].add((VBB - v[k + 3]) / technology.bulk + at_drain)
    into = into.at[S].add(-to_source - at_source).at[D].add(-to_drain - at_drain)
    return into[:nodes]


def bulk_capacitance(technology: Technology, v: Any) -> Any:
    blocked = 1 / jnp.sqrt(1 - jnp.minimum(v, 0) / JUNCTION_POTENTIAL)
    open_ = 1 + jnp.maximum(v, 0) / (2 * JUNCTION_POTENTIAL)
    return technology.bulk_capacitance * jnp.where(v <= 0, blocked, open_)


def stored(technology: Technology, parts: Transistors, v: Any, of: Any, nodes: int) -> Any:
    """Capacitances at the voltages `v` times the voltages `of` (charges), or their rates."""
    k, S, D, gate = parts.first, parts.source, parts.drain, parts.gate
    plates = [
        (k, gate, technology.gate_capacitance),
        (k + 1, gate, technology.gate_capacitance),
        (k + 2, S, bulk_capacitance(technology, v[k + 2] - v[S])),
        (k + 3, D, bulk_capacitance(technology, v[k + 3] - v[D])),
    ]
    total = jnp.zeros_like(of)
    for one, other, capacitance in plates:
        charge = capacitance * (of[one] - of[other])
        total = total.at[one].add(charge).at[other].add(-charge)
    return total[:nodes]


def pulse(t: Any, delay: float, rise: float, high: float, fall: float, period: float) -> Any:
    """From 0 to 5 V and back."""
    time = jnp.mod(t, period) - delay
    up, down = jnp.clip(time / rise, 0, 1), jnp.clip((time - rise - high) / fall, 0, 1)
    return 5.0 * (up - down)
