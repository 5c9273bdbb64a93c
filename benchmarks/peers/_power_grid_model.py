"""The IEEE 14-bus system after a short circuit: equations of its machines and of the network.

Round-rotor machines with two windings in each axis and saturation (P. Kundur, Power System Stability and Control,
1994, chapters 3 and 5; the model GENROU of other programs) at constant field voltage and mechanical power, lines and
transformers as pi circuits, loads of constant admittance. Per unit, with 100 MVA as the unit of power; times in s.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx


FREQUENCY = 60.0  # Hz
FAULT_REACTANCE = 1e-4  # of the short circuit

# From bus, to bus, resistance, reactance, susceptance of the line, ratio of the transformer at the first bus.
BRANCHES = np.array(
    [
        (1, 2, 0.01938, 0.05917, 0.0528, 1.0),
        (1, 5, 0.05403, 0.22304, 0.0492, 1.0),
        (2, 3, 0.04699, 0.19797, 0.0438, 1.0),
        (2, 4, 0.05811, 0.17632, 0.0340, 1.0),
        (2, 5, 0.05695, 0.17388, 0.0346, 1.0),
        (3, 4, 0.06701, 0.17103, 0.0128, 1.0),
        (4, 5, 0.01335, 0.04211, 0.0, 1.0),
        (6, 11, 0.09498, 0.19890, 0.0, 1.0),
        (6, 12, 0.12291, 0.25581, 0.0, 1.0),
        (6, 13, 0.06615, 0.13027, 0.0, 1.0),
        (7, 9, 0.0, 0.11001, 0.0, 1.0),
        (9, 10, 0.03181, 0.08450, 0.0, 1.0),
        (9, 14, 0.12711, 0.27038, 0.0, 1.0),
        (10, 11, 0.08205, 0.19207, 0.0, 1.0),
        (12, 13, 0.22092, 0.19988, 0.0, 1.0),
        (13, 14, 0.17093, 0.34802, 0.0, 1.0),
        (4, 7, 0.0, 0.20912, 0.0, 0.99677),
        (4, 9, 0.0, 0.55618, 0.0, 0.99677),
        (6, 5, 0.0, 0.25202, 0.0, 0.99677),
        (8, 7, 0.0, 0.17615, 0.0, 0.99677),
    ]
)
# Bus, active and reactive power.
LOADS = np.array(
    [
        (2, 0.217, 0.127),
        (3, 0.500, 0.250),
        (4, 0.478, 0.100),
        (5, 0.076, 0.016),
        (6, 0.150, 0.075),
        (9, 0.295, 0.166),
        (10, 0.090, 0.058),
        (11, 0.035, 0.018),
        (12, 0.061, 0.016),
        (13, 0.135, 0.058),
        (14, 0.200, 0.070),
    ]
)
SHUNTS = {9: 0.19, 14: 0.15}  # susceptances
BUSES = 14
MACHINES = np.array([1, 2, 3, 6, 8])  # their buses; the first one balances the powers
POWER = np.array([0.4, 0.4, 0.3, 0.35])  # of the others
VOLTAGE = np.array([1.03, 1.03, 1.01, 1.03, 1.03])
# Angles, deviations from the speed of synchronism, and voltages behind the windings; in the order of their equations.
MACHINE_UNKNOWNS = ("delta", "speed", "e1q", "e1d", "e2d", "e2q")


class Machines(NamedTuple):
    """Parameters of the machines, in Kundur's notation: inertia `M = 2 H` (s), synchronous, transient and
    subtransient reactances of both axes, open-circuit time constants (s), saturation at 1.0 and 1.2."""

    M: Any = np.array([8.0, 13.0, 10.0, 10.0, 10.0])
    Xd: Any = 1.8
    Xq: Any = 1.75
    Xd1: Any = 0.6
    Xq1: Any = 0.8
    X2: Any = np.array([0.23, 0.28, 0.34, 0.28, 0.34])  # of both axes
    Xl: Any = 0.15
    Td1: Any = 6.5
    Tq1: Any = 0.2
    Td2: Any = 0.06
    Tq2: Any = 0.05
    S10: Any = 0.09
    S12: Any = 0.38

    @property
    def saturation(self) -> tuple[Any, Any]:
        """`(A, B)` of the quadratic saturation `S = B (psi - A)^2 / psi` through both points."""
        ratio = jnp.sqrt(self.S10 / (1.2 * self.S12))
        A = (1 - 1.2 * ratio) / (1 - ratio)
        return A, self.S10 / (1 - A) ** 2


class Parameters(NamedTuple):
    """The machines, and the times of the short circuit and of its clearing."""

    machines: Machines
    times: Any


def admittance(offset: float = 0.0) -> np.ndarray:
    """Return the matrix of the network without loads; `offset` is added to all impedances."""
    Y = np.zeros((BUSES, BUSES), complex)
    for first, second, r, x, b, ratio in BRANCHES:
        i, j = int(first) - 1, int(second) - 1
        y = 1 / (r + offset + 1j * (x + offset))
        Y[i, i] += (y + 0.5j * b) / ratio**2
        Y[j, j] += y + 0.5j * b
        Y[i, j] -= y / ratio
        Y[j, i] -= y / ratio
    for bus, b in SHUNTS.items():
        Y[bus - 1, bus - 1] += 1j * b
    return Y


def power_flow(Y: np.ndarray) -> jax.Array:
    """Return the complex voltages of the steady state, from the powers and the voltages that are given."""
    load = np.zeros(BUSES, complex)
    load[LOADS[:, 0].astype(int) - 1] = LOADS[:, 1] + 1j * LOADS[:, 2]
    source, others = MACHINES - 1, MACHINES[1:] - 1
    free = np.setdiff1d(np.arange(BUSES), source)

    def mismatch(v: jax.Array, _: None) -> jax.Array:
        V = v[0] + 1j * v[1]
        power = V * jnp.conj(Y @ V) + load
        magnitude = jnp.abs(V[source]) - VOLTAGE
        active = power.real[others] - POWER
        passive = power[free]
        return jnp.concatenate([magnitude, v[1, :1], active, passive.real, passive.imag])

    start = jnp.stack([jnp.ones(BUSES), jnp.zeros(BUSES)])
    found = optx.root_find(mismatch, optx.Newton(rtol=1e-13, atol=1e-13), start, max_steps=50)
    return found.value[0] + 1j * found.value[1]


def with_loads(Y: np.ndarray, V: Any) -> Any:
    """Return the matrix of the network with the loads, which take their power at the voltages `V`."""
    at = LOADS[:, 0].astype(int) - 1
    load = (LOADS[:, 1] - 1j * LOADS[:, 2]) / jnp.abs(V[at]) ** 2
    return jnp.asarray(Y).at[at, at].add(load)


def steady_state(Y: np.ndarray, V: Any, m: Machines) -> tuple[dict[str, Any], Any, Any]:
    """Return the unknowns at the voltages `V` of a steady state, mechanical powers and field voltages."""
    at = MACHINES - 1
    current = (with_loads(Y, V) @ V)[at]
    flux = V[at] + 1j * m.X2 * current  # subtransient, in the frame of the network
    A, B = m.saturation
    size = jnp.abs(flux)
    S = jnp.where(size > A, B * (size - A) ** 2 / size, 0.0)
    # The q axis is that of the voltage behind the saturated synchronous reactance of the q axis.
    saturated = S * (m.Xq - m.Xl) / (m.Xd - m.Xl)
    delta = jnp.angle(flux * (1 + saturated) + 1j * (m.Xq - m.X2) * current)
    axes = jnp.exp(-1j * (delta - jnp.pi / 2))
    Id, Iq = (current * axes).real, (current * axes).imag
    psi_q, psi_d = (flux * axes).real, (flux * axes).imag
    field = (S + 1) * psi_d + (m.Xd - m.X2) * Id
    unknowns = {
        "delta": delta,
        "speed": jnp.zeros_like(delta),
        "e1q": field - S * psi_d - (m.Xd - m.Xd1) * Id,
        "e2d": field - S * psi_d - (m.Xd - m.Xl) * Id,
        "e1d": (m.Xq - m.Xq1) * Iq - saturated * psi_q,
        "e2q": (m.Xq - m.Xl) * Iq - saturated * psi_q,
        "voltage": jnp.stack([V.real, V.imag], axis=1),
        "fault": jnp.array(0.0),
    }
    return unknowns, (V[at] * jnp.conj(current)).real, field


def subtransient(m: Machines, x: Any) -> tuple[Any, Any]:
    """Return the subtransient flux linkages of both axes."""
    d = (m.X2 - m.Xl) / (m.Xd1 - m.Xl)
    q = (m.X2 - m.Xl) / (m.Xq1 - m.Xl)
    return d * x["e1q"] + (1 - d) * x["e2d"], q * x["e1d"] + (1 - q) * x["e2q"]


def windings(m: Machines, x: Any, rate: Any, current: Any, psi: Any, field: Any) -> tuple[Any, ...]:
    """Return the equations of the field winding and of the three dampers of each machine."""
    (Id, Iq), (psi_d, psi_q) = current, psi
    A, B = m.saturation
    size = jnp.hypot(psi_d, psi_q)
    S = jnp.where(size > A, B * (size - A) ** 2 / size, 0.0)
    to_d, to_q = m.Xd1 - m.Xl, m.Xq1 - m.Xl
    # Currents of the dampers that act on the transient fluxes.
    damper_d = (m.Xd1 - m.X2) / to_d**2 * (x["e1q"] - x["e2d"]) + (m.X2 - m.Xl) / to_d * Id
    damper_q = (m.Xq1 - m.X2) / to_q**2 * (x["e1d"] - x["e2q"]) - (m.X2 - m.Xl) / to_q * Iq
    field_current = x["e1q"] + (m.Xd - m.Xd1) * damper_d + S * psi_d
    q_current = x["e1d"] + (m.Xq - m.Xq1) * damper_q + S * psi_q * (m.Xq - m.Xl) / (m.Xd - m.Xl)
    return (
        m.Td1 * rate["e1q"] - (field - field_current),
        m.Tq1 * rate["e1d"] + q_current,
        m.Td2 * rate["e2d"] - (x["e1q"] - x["e2d"] - to_d * Id),
        m.Tq2 * rate["e2q"] - (x["e1d"] - x["e2q"] + to_q * Iq),
    )


class Grid(NamedTuple):
    """Matrix of the network with its loads, mechanical powers and field voltages of the machines, the steady state, and
    the bus where the short circuit is."""

    network: Any
    power: Any
    field: Any
    start: dict[str, Any]
    bus: int

    @classmethod
    def of(cls, machines: Machines, bus: int, offset: float = 0.0) -> "Grid":
        """Build the grid in its steady state."""
        Y = admittance(offset)
        V = power_flow(Y)
        start, power, field = steady_state(Y, V, machines)
        return cls(with_loads(Y, V), power, field, start, bus)

    def residual(self, t: Any, x: Any, rate: Any, parameters: Parameters) -> tuple[Any, ...]:
        """Return what is zero on solutions: the equations of `reduce_dae`."""
        m = parameters.machines
        V = x["voltage"][:, 0] + 1j * x["voltage"][:, 1]
        axes = jnp.exp(1j * (x["delta"] - jnp.pi / 2))
        v = V[MACHINES - 1] * jnp.conj(axes)
        psi_d, psi_q = subtransient(m, x)
        Id, Iq = (psi_d - v.imag) / m.X2, (v.real - psi_q) / m.X2
        injected = jnp.zeros(BUSES, complex).at[MACHINES - 1].set((Id + 1j * Iq) * axes)
        balance = injected - self.network @ V - self.short(x["fault"]) * V
        torque = v.real * Id + v.imag * Iq
        return (
            rate["delta"] - 2 * jnp.pi * FREQUENCY * x["speed"],
            m.M * rate["speed"] - (self.power - torque),
            *windings(m, x, rate, (Id, Iq), (psi_d, psi_q), self.field),
            balance.real,
            balance.imag,
            rate["fault"],
        )

    def short(self, fault: Any) -> Any:
        """Return the admittances to the ground, with `fault` 1 during the short circuit, else 0."""
        return jnp.zeros(BUSES, complex).at[self.bus - 1].set(fault / (1j * FAULT_REACTANCE))

    def derivatives(self, x: dict[str, Any], fault: float, m: Machines) -> dict[str, Any]:
        """Return the derivatives of the unknowns of the machines, the voltages eliminated by hand."""
        at = MACHINES - 1
        axes = jnp.exp(1j * (x["delta"] - jnp.pi / 2))
        psi_d, psi_q = subtransient(m, x)
        inner = (psi_q + 1j * psi_d) * axes  # voltages behind the subtransient reactances
        Y = self.network + jnp.diag(self.short(fault)).at[at, at].add(1 / (1j * m.X2))
        V = jnp.linalg.solve(Y, jnp.zeros(BUSES, complex).at[at].set(inner / (1j * m.X2)))
        x = {**x, "voltage": jnp.stack([V.real, V.imag], axis=1), "fault": jnp.asarray(fault)}
        zero = jax.tree.map(jnp.zeros_like, x)
        left = self.residual(0.0, x, zero, Parameters(m, jnp.zeros(2)))
        scale = (1.0, m.M, m.Td1, m.Tq1, m.Td2, m.Tq2)
        return {name: -left[i] / scale[i] for i, name in enumerate(MACHINE_UNKNOWNS)}
