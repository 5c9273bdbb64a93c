"""Constraints of the gallery written a second time, in NumPy, from the definitions.

Each takes times of shape `(times,)` and states with that leading axis and returns the
absolute residuals, shape `(times, m)`. Nothing here calls the library.
"""

import numpy as np


def _columns(*columns):
    return np.stack(columns, axis=-1)


def _dot(a, b):
    return (a * b).sum(axis=-1)


def harmonic_oscillator(t, y):
    return _columns(_dot(y, y) - 1)


def pendulum(t, y):
    q, v = y
    return _columns(_dot(q, q) - 1, _dot(q, v))


def rigid_body(t, y):
    inertia = np.array([2.0, 1.0, 2.0 / 3.0])
    start = np.array([np.cos(1.1), 0.0, np.sin(1.1)])
    energy = lambda y: 0.5 * (y * y / inertia).sum(axis=-1)
    return _columns(_dot(y, y) - 1, energy(y) - energy(start))


def kepler(t, y):
    q, v = y
    e = 0.6
    energy = 0.5 * _dot(v, v) - 1 / np.sqrt(_dot(q, q))
    momentum = q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0]
    # -mu / 2a with a = 1, and sqrt(mu a (1 - e^2)).
    return _columns(energy + 0.5, momentum - np.sqrt(1 - e**2))


def lotka_volterra(t, y):
    u, w = y[..., 0], y[..., 1]
    p0, p1, p2, p3 = 1.5, 1.0, 3.0, 1.0
    value = p3 * u - p2 * np.log(u) + p1 * w - p0 * np.log(w)
    return _columns(value - (p3 + p1))


def car_axis(t, y):
    q, v = y
    xl, yl, xr, yr = np.moveaxis(q, -1, 0)
    ul, wl, ur, wr = np.moveaxis(v, -1, 0)
    r, w = 0.1, 10.0
    yb, dyb = r * np.sin(w * t), r * w * np.cos(w * t)
    xb = np.sqrt(1 - yb**2)
    dxb = -yb * dyb / xb
    return _columns(
        xb * xl + yb * yl,
        (xl - xr) ** 2 + (yl - yr) ** 2 - 1,
        dxb * xl + xb * ul + dyb * yl + yb * wl,
        2 * (xl - xr) * (ul - ur) + 2 * (yl - yr) * (wl - wr),
    )


def jay2(t, y):
    return _columns(y[..., 0] ** 2 * y[..., 1] - 1)


def arevalo(t, y):
    q, v = y
    return _columns(_dot(q, q) - 1, _dot(q, v))


def skate(t, y):
    _, v = y
    return _columns(-v[..., 0] * np.sin(t) + v[..., 1] * np.cos(t))


def sphere_flow(t, y):
    return _columns(_dot(y, y) - 1)


def rotation(t, y):
    gram = np.einsum("...ki,...kj->...ij", y, y) - np.eye(3)
    return gram.reshape(*gram.shape[:-2], 9)
