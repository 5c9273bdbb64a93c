"""A slider-crank whose rod is an elastic beam, with multipliers, from positions, index 3.

Source of equations, start and end values: Mazzia & Magherini, Test Set for Initial Value Problem
Solvers (2008), problem `crank`; B. Simeon, Math. Modelling of Systems 2 (1996) 1-18.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .problem import BoardProblem


class _Rod:
    """The elastic rod of the slider-crank: two bending and two stretching shapes."""

    density, width, length, young, pi = 7870.0, 0.008, 0.30, 2e11, 3.1415927
    weight = density * width**2 * length
    stiff = young * width**2 / length
    volume = width**2 * length
    mass = weight * np.array([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 8, 1], [0, 0, 1, 2]])
    stiffness = stiff * np.array(
        [
            [pi**4 / 24 * (width / length) ** 2, 0, 0, 0],
            [0, pi**4 * 2 / 3 * (width / length) ** 2, 0, 0],
            [0, 0, 16 / 3, -8 / 3],
            [0, 0, -8 / 3, 7 / 3],
        ]
    )
    _b13, _b14, _b24 = -16 / pi**3, 8 / pi**3 - 1 / pi, 0.5 / pi
    coupling = volume * np.array(
        [[0, 0, _b13, _b14], [0, 0, 0, _b24], [-_b13, 0, 0, 0], [-_b14, -_b24, 0, 0]]
    )
    c1 = volume * np.array([0, 0, 2 / 3, 1 / 6])
    c2 = volume * np.array([2 / pi, 0, 0, 0])
    c12 = length * volume * np.array([0, 0, 1 / 3, 1 / 6])
    c21 = length * volume * np.array([1 / pi, -0.5 / pi, 0, 0])


_CRANK, _J1, _J2, _M2, _M3 = 0.15, 0.002727, 0.0045339259, 0.151104, 0.075552


def _crank_mass(p: Any, q: Any) -> Any:
    """Of crank angle, rod angle, slider and the four shapes."""
    s, c, rho = jnp.sin(p[0] - p[1]), jnp.cos(p[0] - p[1]), _Rod.density
    m12 = 0.5 * _CRANK * _Rod.length * _M2 * c
    m12 = m12 + rho * _CRANK * (s * (_Rod.c2 @ q) + c * (_Rod.c1 @ q))
    m22 = _J2 + q @ _Rod.mass @ q + 2 * rho * (_Rod.c12 @ q)
    with_crank = rho * _CRANK * (-s * _Rod.c1 + c * _Rod.c2)
    with_rod = rho * (_Rod.c21 + q @ _Rod.coupling)
    rigid = jnp.zeros((3, 3)).at[0, 0].set(_J1 + _M2 * _CRANK**2).at[1, 1].set(m22)
    rigid = rigid.at[0, 1].set(m12).at[1, 0].set(m12).at[2, 2].set(_M3)
    mixed = jnp.stack([with_crank, with_rod, jnp.zeros(4)])
    return jnp.block([[rigid, mixed], [mixed.T, jnp.asarray(_Rod.mass)]])


def _crank_force(p: Any, q: Any, v: Any, w: Any) -> Any:
    s, c, rho = jnp.sin(p[0] - p[1]), jnp.cos(p[0] - p[1]), _Rod.density
    c1q, c2q, c1w, c2w = _Rod.c1 @ q, _Rod.c2 @ q, _Rod.c1 @ w, _Rod.c2 @ w
    lever = 0.5 * _CRANK * _Rod.length * _M2 * s
    crank = -lever * v[1] ** 2 + rho * _CRANK * v[1] ** 2 * (-s * c1q + c * c2q)
    crank = crank - 2 * rho * _CRANK * v[1] * (c * c1w + s * c2w)
    rod = lever * v[0] ** 2 + rho * _CRANK * v[0] ** 2 * (s * c1q - c * c2q)
    rod = rod - 2 * v[1] * (rho * (_Rod.c12 @ w) + w @ _Rod.mass @ q)
    rod = rod - rho * (w @ _Rod.coupling @ w)
    along = _Rod.c12 * v[1] ** 2 + _CRANK * v[0] ** 2 * (c * _Rod.c1 + s * _Rod.c2)
    along = along + 2 * v[1] * (_Rod.coupling @ w)
    shapes = v[1] ** 2 * (_Rod.mass @ q) + rho * along - _Rod.stiffness @ q
    return jnp.concatenate([jnp.stack([crank, rod, jnp.zeros_like(rod)]), shapes])


def slider_crank() -> BoardProblem:
    """Driven at a constant rate; the rod is an elastic beam."""

    def residual(t, x, xdot, args):
        p, q, v, w = x["p"], x["q"], x["v"], x["w"]

        def joints(pq):
            p, end = pq[:3], _Rod.length + pq[6]
            closed = _CRANK * jnp.sin(p[0]) + end * jnp.sin(p[1])
            slider = p[2] - _CRANK * jnp.cos(p[0]) - end * jnp.cos(p[1])
            return jnp.stack([closed, slider, p[0] - args["rate"] * t])

        value, pullback = jax.vjp(joints, jnp.concatenate([p, q]))
        inertia = _crank_mass(p, q) @ jnp.concatenate([xdot["v"], xdot["w"]])
        return {
            "kinematics": jnp.concatenate([xdot["p"] - v, xdot["q"] - w]),
            "motion": inertia - _crank_force(p, q, v, w) + pullback(x["force"])[0],
            "joints": value,
        }

    start = {
        "p": np.array([0.0, 0.0, 0.450016933]),
        "q": np.array([0.0, 0.0, 0.103339863e-4, 0.169327969e-4]),
        "v": np.array([150.0, -74.99576703969453, -0.268938671997904e-5]),
        "w": np.array(
            [
                0.444896112581599,
                0.463433931923867e-2,
                -0.178591076000055e-5,
                -0.268938671997904e-5,
            ]
        ),
        "force": np.zeros(3),
    }
    end = {
        "p": [np.nan, -0.331173498825626, 0.169737332842786],
        "q": [
            0.1893192899613509e-3,
            0.2375751249879174e-4,
            -0.5323896770569702e-5,
            -0.8363313279112129e-5,
        ],
        "v": [np.nan, 60.25346755138369, -8.753116326670527],
        "w": [
            -0.3005541400289738e-1,
            -0.5500431812571696e-2,
            0.4974111734266989e-3,
            0.1105560003626645e-2,
        ],
        "force": [-62.32935833287916, -163.7920993367306, 25.29857947066878],
    }
    # Axial vibrations without damping, which an explicit solver follows.
    return BoardProblem(
        residual,
        start,
        {"rate": 150.0},
        0.1,
        end,
        "rate",
        "Dopri8",
        1e-11,
        1e-15,
        1.0,
        short=0.01,
    )
