"""Andrews' squeezing mechanism: seven bodies, three loops, one motor and one spring.

Seven angles and six constraints, in coordinates relative to the body before, with a full mass
matrix that depends on them. A check of it, by itself: `python -m benchmarks.tools.andrews`.

Source: Hairer & Wanner, Solving ODEs II (1996), section VII.7; Mazzia & Magherini, Test Set for
IVP Solvers (2008), problem `andrews`.
"""

from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from .measure import use_double_precision


class AndrewsArgs(NamedTuple):
    """Torque of the motor (N m), stiffness (N/m) and length (m) of the spring."""

    torque: Any = 0.033
    stiffness: Any = 4530.0
    length: Any = 0.07785


# Of the bodies: masses (kg) and moments of inertia (kg m^2).
M1, M2, M3, M4, M5, M6, M7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498
I1, I2, I3, I4 = 2.194e-6, 4.41e-7, 5.255e-6, 5.667e-7
I5, I6, I7 = 1.169e-5, 5.667e-7, 1.912e-5
# Fixed points, and lengths of and on the bodies (m).
A, B, C = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)
RR, RA, D, DA, SS, SA, SB, SC, SD = (
    0.007,
    92e-5,
    0.028,
    0.0115,
    0.035,
    0.01874,
    0.01043,
    0.018,
    0.02,
)
E, EA, ZF, FA, ZT, TA, TB = 0.02, 0.01421, 0.02, 0.01421, 0.04, 0.02308, 0.00916
U, UA, UB = 0.04, 0.01228, 0.00449

# beta, Theta, gamma, Phi, delta, Omega, epsilon; at rest.
START = (
    -0.0617138900142764496358948458001,
    0.0,
    0.455279819163070380255912382449,
    0.222668390165885884674473185609,
    0.487364979543842550225598953530,
    -0.222668390165885884674473185609,
    1.23054744454982119249735015568,
)
# What is published with them: accelerations and multipliers, which are zero where not given, ...
ACCELERATIONS = (14222.4439199541138705911625887, -10666.8329399655854029433719415)
MULTIPLIERS = (98.5668703962410896057654982170, -6.12268834425566265503114393122)
# ... and the angles at t = 0.03.
END = (
    15.81077119629904,
    -15.75637105984298,
    0.04082224013073101,
    -0.5347301163226948,
    0.5244099658805304,
    0.5347301163226948,
    1.048080741042263,
)


def _mass(q: Any, args: AndrewsArgs) -> Any:
    del args
    theta, phi, omega = q[1], q[3], q[5]
    e, f = E - EA, ZF - FA
    m12 = M2 * (DA**2 - DA * RR * jnp.cos(theta)) + I2
    m22 = M2 * DA**2 + I2
    m11 = M1 * RA**2 + M2 * (RR**2 - 2 * DA * RR * jnp.cos(theta) + DA**2) + I1 + I2
    m33 = M3 * (SA**2 + SB**2) + I3
    m44 = M4 * e**2 + I4
    m45 = M4 * (e**2 + ZT * e * jnp.sin(phi)) + I4
    m55 = M4 * (ZT**2 + 2 * ZT * e * jnp.sin(phi) + e**2) + M5 * (TA**2 + TB**2) + I4 + I5
    m66 = M6 * f**2 + I6
    m67 = M6 * (f**2 - U * f * jnp.sin(omega)) + I6
    m77 = M6 * (f**2 - 2 * U * f * jnp.sin(omega) + U**2) + M7 * (UA**2 + UB**2) + I6 + I7
    entries = (m11, m12, m12, m22, m33, m44, m45, m45, m55, m66, m67, m67, m77)
    values = jnp.stack([jnp.asarray(entry, q.dtype) for entry in entries])
    rows = np.array([0, 0, 1, 1, 2, 3, 3, 4, 4, 5, 5, 6, 6])
    columns = np.array([0, 1, 0, 1, 2, 3, 4, 3, 4, 5, 6, 5, 6])
    return jnp.zeros((7, 7), q.dtype).at[rows, columns].set(values)


def _turned(angle: Any, x: float, y: float) -> Any:
    s, c = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack([x * c - y * s, x * s + y * c])


def _loops(t: Any, q: Any, args: AndrewsArgs) -> Any:
    """From the motor to the joint of the bodies 2, 3, 4 and 6, and three ways to there."""
    del t, args
    beta, theta, gamma, phi, delta, omega, epsilon = q
    joint = _turned(beta, RR, 0) - _turned(beta + theta, D, 0)
    third = np.asarray(B) + _turned(gamma, 0, -SS)
    upper = np.asarray(A) + _turned(phi + delta, 0, -E) + _turned(delta, ZT, 0)
    lower = np.asarray(A) + _turned(omega + epsilon, ZF, 0) + _turned(epsilon, 0, -U)
    return jnp.concatenate([joint - third, joint - upper, joint - lower])


def _force(t: Any, q: Any, v: Any, args: AndrewsArgs) -> Any:
    """The motor, the spring, and the gyroscopic terms of the mass matrix."""
    del t
    e, f = E - EA, ZF - FA
    beta, theta, _, phi, delta, omega, epsilon = v
    end = np.asarray(B) + _turned(q[2], SD, -SC)
    stretch = end - np.asarray(C)
    length = jnp.sqrt(jnp.sum(stretch**2))
    pull = -args.stiffness * (length - args.length) / length * stretch
    lever = _turned(q[2], SC, SD)
    arm = M2 * DA * RR * jnp.sin(q[1])
    left, right = M4 * ZT * e * jnp.cos(q[3]), M6 * U * f * jnp.cos(q[5])
    forces = [
        args.torque - arm * theta * (theta + 2 * beta),
        arm * beta**2,
        jnp.sum(pull * lever),
        left * delta**2,
        -left * phi * (phi + 2 * delta),
        -right * epsilon**2,
        right * omega * (omega + 2 * epsilon),
    ]
    return jnp.stack(forces)


def andrews() -> mj.MechanicalSystem:
    return mj.MechanicalSystem(_mass, _loops, _force)


def initial_state() -> tuple[Any, Any]:
    return jnp.asarray(START), jnp.zeros(7)


def check() -> None:
    """The published start, its accelerations and multipliers, and the published end."""
    use_double_precision()
    system, (q, v), args = andrews(), initial_state(), AndrewsArgs()
    loops = np.asarray(_loops(0.0, q, args))
    assert np.max(np.abs(loops)) < 1e-16, loops
    a, multipliers = system.accelerations(0.0, (q, v), args), system.multipliers(0.0, (q, v), args)
    np.testing.assert_allclose(a, np.append(ACCELERATIONS, np.zeros(5)), rtol=1e-10, atol=1e-6)
    np.testing.assert_allclose(
        multipliers, np.append(MULTIPLIERS, np.zeros(4)), rtol=1e-10, atol=1e-9
    )
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Tsit5(), system.constraint),
        0.0,
        0.03,
        None,
        (q, v),
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
        max_steps=10_000,
    )
    difference = np.max(np.abs(np.asarray(sol.ys[0][0]) - END))
    print(
        f"angles at t = 0.03 as published up to {difference:.1e}, {int(sol.stats['num_steps'])} steps"
    )
    assert difference < 1e-6


if __name__ == "__main__":
    check()
