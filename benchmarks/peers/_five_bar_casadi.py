"""The same task by direct collocation in CasADi, solved by IPOPT, with the accelerations of the closed loop.

The states are the four angles of the links and their rates, polynomials of degree three in each interval through Legendre
points; the constraint holds at the start and what is left of it afterwards is drift. This is the method that Bordalba,
Schoels, Ros, Porta & Diehl (2023) call basic.
"""

import time
from typing import Any, NamedTuple

import numpy as np

from . import _five_bar as robot


DEGREE = 3


class Collocated(NamedTuple):
    """The result of IPOPT: `again_s` are the seconds of a second solve, `drift` the largest gap of the loop in the
    polynomials (m)."""

    cost: float
    iterations: int
    build_s: float
    solve_s: float
    again_s: float
    status: str
    inputs: np.ndarray
    drift: float


def dynamics(ca: Any) -> tuple[Any, Any]:
    """Return CasADi functions: the rate of the state by state and torques, and the gap of the loop."""
    theta, rate, torque = ca.SX.sym("theta", 4), ca.SX.sym("rate", 4), ca.SX.sym("torque", 2)
    along = lambda i: ca.vertcat(ca.cos(theta[i]), ca.sin(theta[i]))
    base = ca.vertcat(robot.BASE, 0)
    elbows = robot.PROXIMAL * along(0), base + robot.PROXIMAL * along(3)
    starts = ca.vertcat(0, 0), elbows[0], elbows[1], base
    kinetic, potential = 0, 0
    for i, (link, start) in enumerate(zip(robot.links(), starts, strict=True)):
        center = start + link.center * along(i)
        speed = ca.jacobian(center, theta) @ rate
        kinetic += link.mass * ca.dot(speed, speed) / 2 + link.inertia * rate[i] ** 2 / 2
        potential += link.mass * robot.GRAVITY * center[1]
    momentum = ca.gradient(kinetic, rate)
    M = ca.jacobian(momentum, rate)
    bias = ca.jacobian(momentum, theta) @ rate - ca.gradient(kinetic, theta)
    friction = robot.FRICTION * rate
    force = ca.vertcat(torque[0] - friction[0], 0, 0, torque[1] - friction[3])
    loop = elbows[0] + robot.DISTAL * along(1) - elbows[1] - robot.DISTAL * along(2)
    J = ca.jacobian(loop, theta)
    matrix = ca.blockcat([[M, J.T], [J, ca.SX.zeros(2, 2)]])
    right = ca.vertcat(
        force - bias - ca.gradient(potential, theta), -ca.jacobian(J @ rate, theta) @ rate
    )
    acceleration = ca.solve(matrix, right)[:4]
    x = ca.vertcat(theta, rate)
    field = ca.Function("field", [x, torque], [ca.vertcat(rate, acceleration)])
    closed = ca.Function("closed", [x], [ca.vertcat(loop, J @ rate)])
    return field, closed


def solve(ts: np.ndarray, thetas: np.ndarray, rates: np.ndarray) -> Collocated:
    """Solve the task from a guess of the angles and their rates at the knots, `(K, 4)`."""
    import casadi as ca

    begin = time.perf_counter()
    field, closed = dynamics(ca)
    K, x_guess = ts.size, np.concatenate([thetas, rates], axis=1)
    points = np.append(0, ca.collocation_points(DEGREE, "legendre"))
    C, D, B = ca.collocation_coeff(points[1:].tolist())
    opti = ca.Opti()
    knots, u = opti.variable(8, K), opti.variable(2, K)
    inner = [opti.variable(8, DEGREE) for _ in range(K - 1)]
    cost = 0
    for k in range(K - 1):
        h, every = ts[k + 1] - ts[k], ca.horzcat(knots[:, k], inner[k])
        slopes = every @ C
        for j in range(DEGREE):
            part = points[j + 1]
            torque = (1 - part) * u[:, k] + part * u[:, k + 1]
            opti.subject_to(slopes[:, j] == h * field(inner[k][:, j], torque))
            cost += h * B[j] * ca.sumsqr(torque)
        opti.subject_to(every @ D == knots[:, k + 1])
        opti.set_initial(inner[k], np.stack([_between(x_guess, k, p) for p in points[1:]], axis=1))
    opti.subject_to(knots[:, 0] == x_guess[0])
    tangent = _null_space(closed, ca, x_guess[-1])
    opti.subject_to(tangent.T @ (knots[:, -1] - x_guess[-1]) == 0)
    opti.subject_to(opti.bounded(-robot.MOST, ca.vec(u), robot.MOST))
    opti.set_initial(knots, x_guess.T)
    opti.minimize(cost)
    options = dict(print_level=0, tol=1e-9, max_iter=2000, sb="yes")
    opti.solver("ipopt", dict(print_time=False), options)
    middle = time.perf_counter()
    found, status = _found(opti)
    end = time.perf_counter()
    _found(opti)  # from the same guess, with the program that is there now
    again = time.perf_counter() - end
    drift = 0.0
    for k in range(K - 1):
        every = np.concatenate([found.value(knots)[:, k : k + 1], found.value(inner[k])], axis=1)
        for s in np.linspace(0, 1, 11):
            x = every @ _lagrange(points, s)
            drift = max(drift, float(np.abs(np.array(closed(x)))[:2].max()))
    return Collocated(
        float(found.value(cost)),
        int(found.stats()["iter_count"]),
        middle - begin,
        end - middle,
        again,
        status,
        np.asarray(found.value(u)).T,
        drift,
    )


def _found(opti: Any) -> tuple[Any, str]:
    try:
        return opti.solve(), "solved"
    except RuntimeError as error:
        return opti.debug, str(error).strip().splitlines()[-1]


def _between(x: np.ndarray, k: int, part: float) -> np.ndarray:
    return (1 - part) * x[k] + part * x[k + 1]


def _null_space(closed: Any, ca: Any, x: np.ndarray) -> np.ndarray:
    """Return a basis of the tangent space at a state."""
    given = ca.SX.sym("x", 8)
    J = ca.Function("J", [given], [ca.jacobian(closed(given), given)])
    _, _, right = np.linalg.svd(np.array(J(x)))
    return right[4:].T


def _lagrange(points: np.ndarray, s: float) -> np.ndarray:
    """Return the values of the polynomials that are one at one of the points."""
    differences = s - points
    return np.array(
        [
            np.prod(np.delete(differences, i)) / np.prod(points[i] - np.delete(points, i))
            for i in range(points.size)
        ]
    )
