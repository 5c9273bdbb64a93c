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
    return _columns(_dot(q, q) - 1, 2 * _dot(q, v))


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


def chain(t, y):
    """Links of length 1: any number of them."""
    q, v = y
    points, velocities = (part.reshape(*part.shape[:-1], -1, 2) for part in (q, v))
    links, rates = points.copy(), velocities.copy()
    links[..., 1:, :] -= points[..., :-1, :]
    rates[..., 1:, :] -= velocities[..., :-1, :]
    return np.concatenate([0.5 * _dot(links, links) - 0.5, _dot(links, rates)], axis=-1)


def double_pendulum(t, y):
    q, v = y
    x1, y1, x2, y2 = np.moveaxis(q, -1, 0)
    u1, w1, u2, w2 = np.moveaxis(v, -1, 0)
    return _columns(
        0.5 * (x1**2 + y1**2 - 1),
        0.5 * ((x2 - x1) ** 2 + (y2 - y1) ** 2 - 1),
        x1 * u1 + y1 * w1,
        (x2 - x1) * (u2 - u1) + (y2 - y1) * (w2 - w1),
    )


def slider_crank(t, y):
    q, v = y
    crank, x, rod = np.moveaxis(q, -1, 0)
    crank_rate, speed, rod_rate = np.moveaxis(v, -1, 0)
    return _columns(
        x - np.cos(rod) - 0.5 * np.cos(crank),
        np.sin(rod) + 0.5 * np.sin(crank),
        speed + np.sin(rod) * rod_rate + 0.5 * np.sin(crank) * crank_rate,
        np.cos(rod) * rod_rate + 0.5 * np.cos(crank) * crank_rate,
    )


def four_bar(t, y):
    """Ends of the three bodies as complex numbers, and their velocities."""
    q, v = y
    position, angle = q[..., 0::3] + 1j * q[..., 1::3], q[..., 2::3]
    velocity, rate = v[..., 0::3] + 1j * v[..., 1::3], v[..., 2::3]
    half = 0.5 * np.array([1.0, 2.5, 2.0]) * np.exp(1j * angle)
    gaps = []
    for center, arm in ((position, half), (velocity, 1j * rate * half)):
        first, last = center - arm, center + arm
        gaps += [first[..., 0], last[..., 0] - first[..., 1], last[..., 1] - last[..., 2]]
        gaps += [first[..., 2]]
    gaps[3] = gaps[3] - 2.2
    gaps = _columns(*gaps)
    return np.concatenate([gaps.real, gaps.imag], axis=-1)


def parallelogram(t, y):
    """Distances from the coupler's pins to the ends of the cranks, all of length 1."""
    q, v = y
    middle, tilt, angle = q[..., 0] + 1j * q[..., 1], q[..., 2], q[..., 3:]
    velocity, tilting, rate = v[..., 0] + 1j * v[..., 1], v[..., 2], v[..., 3:]
    columns = []
    for i, pivot in enumerate((-0.5, 0.0, 0.5)):
        arm, crank = pivot * np.exp(1j * tilt), -1j * np.exp(1j * angle[..., i])
        columns += [middle + arm - pivot - crank]
        columns += [velocity + 1j * tilting * arm - 1j * rate[..., i] * crank]
    gaps = _columns(*columns)
    return np.concatenate([gaps.real, gaps.imag], axis=-1)


def spherical_pendulum(t, y):
    q, v = y
    return _columns(_dot(q, q) - 1, 2 * _dot(q, v))


def heavy_top(t, y):
    q, v = y
    return _columns(_dot(q, q) - 1, 2 * _dot(q, v))


def rolling_disc(t, y):
    q, v = y
    speed = 0.5 * v[..., 3]
    return _columns(v[..., 0] - speed * np.cos(q[..., 2]), v[..., 1] - speed * np.sin(q[..., 2]))
