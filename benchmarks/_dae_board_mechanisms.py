"""The mechanisms of the board, with multipliers: car axis, Andrews' mechanism, particles on a sphere
(Fekete) and a slider-crank with an elastic rod. All from positions, index 3.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problems `caraxis`, `andrews`, `fekete` and `crank`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from . import _andrews
from ._dae_board_problem import BoardProblem
from ._dae_board_tables import FEKETE_POSITIONS


def car_axis() -> BoardProblem:
    """A light axle on two springs, the right one over a bumpy road."""
    length, spring, epsilon, gravity, amplitude, frequency = 1.0, 0.5, 1e-2, 1.0, 0.1, 10.0

    def residual(t, x, xdot, args):
        q, v, force = x["q"], x["v"], x["force"]
        road = amplitude * jnp.sin(frequency * t)
        right = jnp.stack([jnp.sqrt(length**2 - road**2), road])
        wheels = jnp.stack([q[:2], q[2:] - right])
        size = jnp.sqrt(jnp.sum(wheels**2, axis=1, keepdims=True))
        pull = (spring - size) * wheels / size
        inertia = args["mass"] * epsilon**2 / 2
        weight = jnp.array([0.0, -gravity])
        joints = lambda q: jnp.stack([q[:2] @ right, jnp.sum((q[:2] - q[2:]) ** 2) - length**2])
        value, pullback = jax.vjp(joints, q)
        load = (pull + inertia * weight).reshape(4)
        return {
            "kinematics": xdot["q"] - v,
            "motion": inertia * xdot["v"] - load - pullback(force)[0],
            "joints": value,
        }

    start = {
        "q": np.array([0.0, 0.5, 1.0, 0.5]),
        "v": np.array([-0.5, 0.0, -0.5, 0.0]),
        "force": np.zeros(2),
    }
    end = {
        "q": [
            0.493455784275402809122e-1,
            0.496989460230171153861,
            0.104174252488542151681e1,
            0.373911027265361256927,
        ],
        "v": [
            -0.770583684040972357970e-1,
            0.744686658723778553466e-2,
            0.175568157537232222276e-1,
            0.770341043779251976443,
        ],
        "force": [-0.473688659084893324729e-2, -0.110468033125734368808e-2],
    }
    return BoardProblem(
        residual, start, {"mass": 10.0}, 3.0, end, "mass", "Dopri8", 1e-12, 1e-12, 1.0, short=0.5
    )


def andrews() -> BoardProblem:
    def residual(t, x, xdot, args):
        q, v = x["q"], x["v"]
        data = _andrews.AndrewsArgs(torque=args["torque"])
        loops, pullback = jax.vjp(lambda q: _andrews._loops(t, q, data), q)
        inertia = _andrews._mass(q, data) @ xdot["v"]
        return {
            "kinematics": xdot["q"] - v,
            "motion": inertia - _andrews._force(t, q, v, data) + pullback(x["force"])[0],
            "loops": loops,
        }

    start = {"q": np.asarray(_andrews.START), "v": np.zeros(7), "force": np.zeros(6)}
    return BoardProblem(
        residual,
        start,
        {"torque": 0.033},
        0.03,
        {"q": _andrews.END},
        "torque",
        "Dopri8",
        1e-12,
        1e-12,
        1.0,
        short=0.01,
    )


def _rings() -> np.ndarray:
    """Four rings of particles."""
    rings = ((3, 3 / 8, 13, 1), (7, 1 / 8, 29, 1), (6, -2 / 15, 7, 1), (4, -3 / 10, 17, 0))
    points = []
    for number, height, turn, first in rings:
        angle = 2 * np.pi * (np.arange(number) + first) / number + np.pi / turn
        up = np.full(number, np.pi * height)
        points.append(
            np.stack([np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)], 1)
        )
    return np.concatenate(points)


def fekete() -> BoardProblem:
    """Twenty particles on a sphere that repel each other, with friction."""
    number = 20
    off_diagonal = ~np.eye(number, dtype=bool)

    def residual(t, x, xdot, args):
        p, v = x["p"], x["v"]
        between = p[:, None, :] - p[None, :, :]
        squares = jnp.where(off_diagonal, jnp.sum(between**2, axis=2), 1.0)
        repulsion = jnp.sum(between / squares[:, :, None], axis=1)
        normal = 2 * x["force"][:, None] * p
        return {
            "kinematics": xdot["p"] - v,
            "motion": xdot["v"] + args["friction"] * v - normal - repulsion,
            "sphere": jnp.sum(p**2, axis=1) - 1,
        }

    start = {"p": _rings(), "v": np.zeros((number, 3)), "force": np.zeros(number)}
    return BoardProblem(
        residual,
        start,
        {"friction": 0.5},
        1000.0,
        {"p": FEKETE_POSITIONS},
        "friction",
        "Dopri8",
        1e-10,
        1e-10,
        1.0,
        short=5.0,
    )


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
    along = along + 2 * v[1] * (_Rod.coupling.T @ w)
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
        "v": np.array([150.0, -74.9957670, -0.268938672e-5]),
        "w": np.array([0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5]),
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
        "force": [-62.32935833287916, -163.7920993367306, 25.29857947066878],
    }
    return BoardProblem(
        residual, start, {"rate": 150.0}, 0.1, end, "rate", rtol=1e-7, atol=1e-9, short=0.01
    )


def _pendulum_for_casadi(ca: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    t, force = ca.SX.sym("t"), ca.SX.sym("force")
    x, xdot = ca.SX.sym("x", 4), ca.SX.sym("xdot", 4)
    parts = [xdot[0] - x[2], xdot[1] - x[3], xdot[2] + force * x[0], xdot[3] + force * x[1] + 9.81]
    rod = x[0] ** 2 + x[1] ** 2 - 1
    written = {"t": t, "x_impl": x, "dx_impl": xdot, "z": force, "alg": ca.vertcat(*parts, rod)}
    # States (q, v, q'), unknowns (v', q'', force).
    return written, {"x0": [1.0, 0, 0, 0, 0, 0], "z0": [0.0, -9.81, 0, -9.81, 0]}


def pendulum() -> BoardProblem:
    """Not of SciML's page: for CasADi's own reduction of the index."""

    def residual(t, x, xdot, args):
        q, v = x["q"], x["v"]
        return {
            "kinematics": xdot["q"] - v,
            "motion": xdot["v"] + x["force"] * q + jnp.array([0.0, 1.0]) * args["gravity"],
            "rod": q @ q - 1,
        }

    problem = mj.problems.pendulum(gravity=9.81, t1=10.0)
    q, v = (np.asarray(part)[-1] for part in problem.reference(np.array([0.0, 10.0])))
    start = {"q": np.array([1.0, 0.0]), "v": np.zeros(2), "force": np.asarray(0.0)}
    end = {"q": q, "v": v}
    return BoardProblem(
        residual,
        start,
        {"gravity": 9.81},
        10.0,
        end,
        "gravity",
        "Dopri8",
        1e-8,
        1e-8,
        1.0,
        short=1.0,
        for_casadi=_pendulum_for_casadi,
    )


def mechanisms() -> dict[str, BoardProblem]:
    return {
        "car axis": car_axis(),
        "Andrews": andrews(),
        "Fekete": fekete(),
        "slider-crank": slider_crank(),
        "pendulum": pendulum(),
    }
