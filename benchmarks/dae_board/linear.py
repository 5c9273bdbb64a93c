"""The linear systems `E x' = A x + B u(t)` of the board, with their elementary solutions.

Source: the page "Linear DAE" of SciML's benchmarks, after the DAEV repository of linear DAEs.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from .problem import BoardProblem


def _linear(E: Any, A: Any, B: Any, u: Callable) -> Callable:
    E, A, B = (np.asarray(matrix, float) for matrix in (E, A, B))

    def residual(t, x, xdot, args):
        return {"x": E @ xdot["x"] - A @ x["x"] - args["gain"] * (B @ jnp.atleast_1d(u(t)))}

    return residual


def _problem(E: Any, A: Any, B: Any, u: Callable, start: Any, t1: float, end: Any, **options: Any):
    return BoardProblem(
        _linear(E, A, B, u),
        {"x": np.asarray(start, float)},
        {"gain": 1.0},
        t1,
        {"x": np.asarray(end, float)},
        "gain",
        floor=1.0,
        **options,
    )


def _rlc() -> BoardProblem:
    """Index 1: `x = (iL, vC, iR, iC)`, with `(iL, iR)` by the exponential of a matrix."""
    L, C, R, t1 = 1e-3, 1e-6, 1e3, 1e-3
    E = [[L, 0, 0, 0], [0, 0, 1, 0], [0] * 4, [0] * 4]
    A = [[0, 1, 0, 0], [1 / C, 0, 0, 0], [-R, 0, 0, 1], [0, 1, 1, 1]]
    reduced = np.array([[-R / L, -1 / L, 1 / L], [1 / C, 0, 0], [0, 0, 0]])
    iL, iR, _ = scipy.linalg.expm(t1 * reduced) @ [0.0, 0.0, 1.0]
    end = [iL, 1 - iR - R * iL, iR, R * iL]
    return _problem(E, A, [[0], [0], [0], [-1]], jnp.ones_like, np.zeros(4), t1, end)


def _masses() -> BoardProblem:
    """Two rotating masses, index 2: `x = (th1, th2, w1, w2)`."""
    E = np.diag([1.0, 1.0, 0.0, 0.0])
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, -1, -1], [-1, 1, 0, 0]]
    B = [[1, 0], [0, 1], [0, 0], [0, 0]]
    u = lambda t: jnp.stack([jnp.ones_like(t), 0.5 * jnp.sin(2 * np.pi * t)])
    t1 = 1.0
    angle = (t1 + (1 - np.cos(2 * np.pi * t1)) / (4 * np.pi)) / 2
    rate = (0.5 * np.sin(2 * np.pi * t1) - 1) / 2
    return _problem(E, A, B, u, np.zeros(4), t1, [angle, angle, rate, -rate])


def _network() -> BoardProblem:
    """A network of a resistor and a coil, index 2: `x = (i1, i2, v)`, all constant."""
    A = [[-1, 1, 0], [1, -1, -1], [0, 1, 0]]
    E = np.diag([0.0, 0.0, 1.0])
    return _problem(E, A, [[1], [0], [0]], jnp.ones_like, np.zeros(3), 1.0, [1.0, 0.0, 1.0])


def _cart() -> BoardProblem:
    """A linearized cart with pendulum, index 3: `x = (x, y, angle, x', y', angle', force)`."""
    E = np.diag([1.0, 1, 1, 1, 1, 0, 0])
    A = np.zeros((7, 7))
    A[0, 3] = A[1, 4] = A[2, 5] = A[3, 6] = A[4, 6] = 1
    A[5, 2], A[6, 0], A[6, 2] = -9.81, 1, -1
    B = np.zeros((7, 1))
    B[3] = 1
    u, t1 = lambda t: jnp.exp(-t), 1.0
    force, speed = np.exp(-t1), 1 - np.exp(-t1)
    return _problem(E, A, B, u, np.zeros(7), t1, [0, speed - t1, 0, 0, -speed, 0, -force])


def _generator() -> BoardProblem:
    """A generator, index 1: `x = (w, i, v_emf, v_load)`."""
    E = np.diag([1.0, 0, 0, 0])
    A = [[0, -1, 0, 0], [1, 0, -1, 0], [0, -1, 1, -1], [0, -1, 0, 1]]
    t1, a, b = 1.0, 0.5, 2 * np.pi
    u = lambda t: 1 + 0.5 * jnp.cos(b * t)
    forced = lambda t: 1 / a + 0.5 * (a * np.cos(b * t) + b * np.sin(b * t)) / (a**2 + b**2)
    w = forced(t1) + (1 - forced(0.0)) * np.exp(-a * t1)
    start = [1.0, 0.0, 0.0, 0.0]
    return _problem(E, A, [[1], [0], [0], [0]], u, start, t1, [w, w / 2, w, w / 2])


def _springs() -> BoardProblem:
    """Two masses that move together, index 3: `x = (x1, x2, v1, v2, force)`, pushed until 0.1."""
    m, k, d, t1, until = 100.0, 2.0, 5.0, 1.0, 0.1
    E = np.diag([1.0, 1, m, m, 0])
    A = [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-k, 0, -d, 0, 1], [k, -k, d, -d, -1], [1, -1, 0, 0, 0]]
    B = [[0], [0], [1], [0], [0]]
    u = lambda t: jnp.where(t < until, 10.0, 0.1 * jnp.exp(-5 * t))
    # Of (x, v, push), where the push is constant or decays.
    reduced = lambda decay: (
        np.array([[0, 1, 0], [-k, -d, 1], [0, 0, -2 * m * decay]])
        / (np.array([[1.0], [2 * m], [2 * m]]))
    )
    x, v, _ = scipy.linalg.expm(until * reduced(0.0)) @ [0.0, 0.0, 10.0]
    after = [x, v, 0.1 * np.exp(-5 * until)]
    x, v, push = scipy.linalg.expm((t1 - until) * reduced(5.0)) @ after
    force = m * (-k * x - d * v + push) / (2 * m) + k * x + d * v - push
    end = [x, x, v, v, force]
    return _problem(E, A, B, u, np.zeros(5), t1, end, jumps=(until,))


def linear_problems() -> dict[str, BoardProblem]:
    return {
        "linear: RLC": _rlc(),
        "linear: masses": _masses(),
        "linear: RL network": _network(),
        "linear: cart": _cart(),
        "linear: generator": _generator(),
        "linear: springs": _springs(),
    }
