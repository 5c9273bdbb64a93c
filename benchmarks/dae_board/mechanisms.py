"""The rigid mechanisms of the board, with multipliers: car axis, Andrews' mechanism, particles on a
sphere (Fekete) and a pendulum. All from positions, index 3.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problems `caraxis`, `andrews` and `fekete`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from ..tools import andrews as squeezer
from .problem import BoardProblem
from .tables import FEKETE_POSITIONS


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
        data = squeezer.AndrewsArgs(torque=args["torque"])
        loops, pullback = jax.vjp(lambda q: squeezer._loops(t, q, data), q)
        inertia = squeezer._mass(q, data) @ xdot["v"]
        return {
            "kinematics": xdot["q"] - v,
            "motion": inertia - squeezer._force(t, q, v, data) + pullback(x["force"])[0],
            "loops": loops,
        }

    start = {"q": np.asarray(squeezer.START), "v": np.zeros(7), "force": np.zeros(6)}
    return BoardProblem(
        residual,
        start,
        {"torque": 0.033},
        0.03,
        {"q": squeezer.END},
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
        1e-12,
        1e-12,
        1.0,
        short=1.0,
        for_casadi=_pendulum_for_casadi,
    )


def mechanisms() -> dict[str, BoardProblem]:
    return {
        "car axis": car_axis(),
        "Andrews": andrews(),
        "Fekete": fekete(),
        "pendulum": pendulum(),
    }
