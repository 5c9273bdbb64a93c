"""Stiff equations with published solutions, for JAX and, with `numpy` for `np`, for SciPy."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import manifold_jax as mj


class StiffProblem(NamedTuple):
    """`M y' = f(t, y, args)`; `field(np)` is `f` in terms of a module like NumPy. `mass` is `None`
    for one of ones. `end` is the published solution at `t1`."""

    field: Callable[[Any], Callable]
    mass: Any
    y0: Any
    t1: float
    args: Any
    end: Any
    rtol: float
    atol: float


def robertson(np_: Any) -> Callable:
    def field(t, y, rates):
        slow, fast, back = rates[0] * y[0], rates[1] * y[1] ** 2, rates[2] * y[1] * y[2]
        return np_.stack([back - slow, slow - back - fast, fast])

    return field


def robertson_dae(np_: Any) -> Callable:
    """With the balance in place of the third equation."""

    def field(t, y, rates):
        change = robertson(np_)(t, y, rates)
        return np_.stack([change[0], change[1], y[0] + y[1] + y[2] - 1])

    return field


def transistor(np_: Any) -> Callable:
    """Currents into the eight nodes of a two-stage amplifier."""
    supply, thermal, gain, saturation, inner, outer = 6.0, 0.026, 0.99, 1e-6, 1000.0, 9000.0

    def field(t, y, args):
        signal = 0.1 * np_.sin(200 * np.pi * t)
        first = saturation * (np_.exp((y[1] - y[2]) / thermal) - 1)
        second = saturation * (np_.exp((y[4] - y[5]) / thermal) - 1)
        return np_.stack(
            [
                (y[0] - signal) / inner,
                (2 * y[1] - supply) / outer + (1 - gain) * first,
                y[2] / outer - first,
                (y[3] - supply) / outer + gain * first,
                (2 * y[4] - supply) / outer + (1 - gain) * second,
                y[5] / outer - second,
                (y[6] - supply) / outer + gain * second,
                y[7] / outer,
            ]
        )

    return field


def _capacitors() -> np.ndarray:
    M = np.zeros((8, 8))
    for k, nodes in enumerate([(0, 1), (2,), (3, 4), (5,), (6, 7)]):
        for i in nodes:
            for j in nodes:
                M[i, j] = 1e-6 * (k + 1) * (-1 if i == j else 1)
    return M


def chemical_akzo_nobel(np_: Any) -> Callable:
    def field(t, y, args):
        root = np_.sqrt(y[1])
        r1, r2 = 18.7 * y[0] ** 4 * root, 0.58 * y[2] * y[3]
        r3, r4 = 0.58 / 34.4 * y[0] * y[4], 0.09 * y[0] * y[3] ** 2
        r5, inflow = 0.42 * y[5] ** 2 * root, 3.3 * (0.9 / 737 - y[1])
        return np_.stack(
            [
                -2 * r1 + r2 - r3 - r4,
                -0.5 * r1 - r4 - 0.5 * r5 + inflow,
                r1 - r2 + r3,
                -r2 + r3 - 2 * r4,
                r2 - r3 + r5,
                115.83 * y[0] * y[3] - y[5],
            ]
        )

    return field


_ROBERTSON = dict(
    y0=np.array([1.0, 0.0, 0.0]),
    t1=1e11,
    args=np.array([0.04, 3e7, 1e4]),
    end=np.array([0.2083340149701255e-07, 0.8333360770334713e-13, 0.9999999791665050]),
    rtol=1e-8,
    atol=1e-14,
)

# Solutions: Mazzia & Magherini, Test Set for Initial Value Problem Solvers (2008).
PROBLEMS = {
    "Robertson": StiffProblem(robertson, None, **_ROBERTSON),
    "Robertson, DAE": StiffProblem(robertson_dae, np.array([1.0, 1.0, 0.0]), **_ROBERTSON),
    "transistor amplifier": StiffProblem(
        transistor,
        _capacitors(),
        np.array([0.0, 3.0, 3.0, 6.0, 3.0, 3.0, 6.0, 0.0]),
        0.2,
        None,
        np.array(
            [
                -0.5562145012262709e-2,
                0.3006522471903042e1,
                0.2849958788608128e1,
                0.2926422536206241e1,
                0.2704617865010554e1,
                0.2761837778393145e1,
                0.4770927631616772e1,
                0.1236995868091548e1,
            ]
        ),
        1e-8,
        1e-8,
    ),
    "chemical Akzo Nobel": StiffProblem(
        chemical_akzo_nobel,
        np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]),
        np.array([0.444, 0.00123, 0.0, 0.007, 0.0, 115.83 * 0.444 * 0.007]),
        180.0,
        None,
        np.array(
            [
                0.1150794920661702,
                0.1203831471567715e-2,
                0.1611562887407974,
                0.3656156421249283e-3,
                0.1708010885264404e-1,
                0.4873531310307455e-2,
            ]
        ),
        1e-8,
        1e-10,
    ),
}


# A stiff mechanism: a bead at the end of a rod of length 1, and another one tied to it by a hard
# spring with a damper, of rest length 1. Its fast times are 1e-5 and 1e-3.
STIFFNESS, DAMPING, GRAVITY = 1e8, 1e5, 9.81
MECHANISM_START = np.array([[1.0, 0.0], [2.0, 0.0]])


def pull(np_: Any, q: Any, v: Any) -> Any:
    """The force on the first bead."""
    gap, rate = q[1] - q[0], v[1] - v[0]
    length = np_.sqrt(gap @ gap)
    along = gap / length
    return (STIFFNESS * (length - 1) + DAMPING * (rate @ along)) * along


def stiff_mechanism() -> mj.MechanicalSystem:
    def force(t, q, v, args):
        F = pull(jnp, q, v)
        return jnp.stack([F, -F]) - jnp.array([[0.0, GRAVITY]])

    return mj.MechanicalSystem(1.0, lambda t, q, args: q[0] @ q[0] - 1, force)


def stiff_mechanism_reference(t1: float) -> np.ndarray:
    """Both positions, in the angle of the rod and the coordinates of the other bead, by SciPy."""

    def field(t, y):
        normal = np.array([-np.sin(y[0]), np.cos(y[0])])
        radial, speed = np.array([np.cos(y[0]), np.sin(y[0])]), y[1]
        q, v = np.stack([radial, y[2:4]]), np.stack([speed * normal, y[4:6]])
        F, weight = pull(np, q, v), np.array([0.0, -GRAVITY])
        return np.array([speed, (F + weight) @ normal, *v[1], *(weight - F)])

    start = [0.0, 0.0, *MECHANISM_START[1], 0.0, 0.0]
    y = solve_ivp(field, (0.0, t1), start, method="Radau", rtol=1e-11, atol=1e-12).y[:, -1]
    return np.array([[np.cos(y[0]), np.sin(y[0])], y[2:4]])
