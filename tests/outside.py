"""A problem that is not in the gallery: exact, time-dependent, asymmetric, a pytree.

A point turns on the unit sphere, `u' = omega x u`, and the sphere is stretched in time:
`y = D(t) u` with `D = diag(1 + 0.3 sin t, 2, 0.6 + 0.2 cos 2t)`. Both the stretched sphere
and the cone `omega . u = const` are kept, so `n = 3`, `m = 2`.
"""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


OMEGA = np.array([0.4, -1.1, 0.7])
START = np.array([0.6, 0.0, 0.8])
T0, T1 = 0.2, 4.2


class Parameters(NamedTuple):
    omega: jax.Array


def parameters(omega=OMEGA):
    return Parameters(jnp.asarray(omega))


def _stretch(t):
    return jnp.stack([1 + 0.3 * jnp.sin(t), 2.0 + 0.0 * t, 0.6 + 0.2 * jnp.cos(2 * t)])


def _unpack(y):
    return jnp.stack([y["plane"][0], y["plane"][1], y["height"]])


def _pack(y):
    return {"plane": y[:2], "height": y[2]}


def field(t, y, args):
    D, dD = jax.jvp(_stretch, (t,), (jnp.ones_like(t),))
    u = _unpack(y) / D
    return _pack(dD * u + D * jnp.cross(args.omega, u))


def residual(t, y, args):
    u = _unpack(y) / _stretch(t)
    return {"sphere": u @ u - 1, "cone": args.omega @ u - args.omega @ jnp.asarray(START, u.dtype)}


def exact(t, omega=OMEGA):
    """Rodrigues' formula; `t` of shape (times,)."""
    t = np.asarray(t)
    rate = np.linalg.norm(omega)
    axis, s = omega / rate, rate * (t - T0)
    cos, sin = np.cos(s)[..., None], np.sin(s)[..., None]
    u = cos * START + sin * np.cross(axis, START) + (1 - cos) * axis * (axis @ START)
    D = np.stack([1 + 0.3 * np.sin(t), 2 + 0 * t, 0.6 + 0.2 * np.cos(2 * t)], axis=-1)
    y = D * u
    return {"plane": y[..., :2], "height": y[..., 2]}


def residual_numpy(t, y, omega=OMEGA):
    t = np.asarray(t)
    D = np.stack([1 + 0.3 * np.sin(t), 2 + 0 * t, 0.6 + 0.2 * np.cos(2 * t)], axis=-1)
    u = np.concatenate([np.asarray(y["plane"]), np.asarray(y["height"])[..., None]], axis=-1) / D
    return np.stack([(u * u).sum(-1) - 1, u @ omega - omega @ START], axis=-1)


def terms():
    return dfx.ODETerm(field)


def constraint():
    return mj.Constraint(residual)


def y0():
    return jax.tree.map(jnp.asarray, exact(T0))
