"""A railway wheelset on a straight track, hunting: rolling contact with friction, index 2.

Source: Mazzia & Magherini, Test Set for Initial Value Problem Solvers (2008), problem `wheel`;
Simeon, Fuehrer & Rentrop, Surv. Math. Ind. 1 (1991) 1-37.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .problem import BoardProblem


MASS, GRAVITY, SPEED, RADIUS = 16.08, 9.81, 30.0, 0.1
I1, I2, HALF_WIDTH, SPRING = 0.0605, 0.366, 0.19, 6400.0
CONE, GAUGE, RAIL = 0.0262, 0.1506, 0.06
ELLIPSE_E, ELLIPSE_G, POISSON, SHEAR = 1.3537956, 0.7115218, 0.28, 7.92e10
C11, C22, C23 = 4.72772197, 4.27526987, 1.97203505
SPIN = SPEED / RADIUS
SCALE = 1e4  # of the multipliers


class Contact(NamedTuple):
    """One wheel on its rail: profiles with their derivatives, the direction of the constraint on
    the five velocities, the angle of the tangent plane, and the two conditions for the point."""

    wheel: Any
    wheel_slope: Any
    rail_slope: Any
    rail_bend: Any
    direction: Any
    angle: Any
    conditions: Any


def contact(side: float, p: Any, psi: Any, xi: Any) -> Contact:
    """`side` is 1 for the left wheel and -1 for the right one."""
    x, theta, phi = p[0], p[3], p[4]
    st, ct, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    s, c = jnp.sin(psi), jnp.cos(psi)
    wheel = RADIUS + np.tan(CONE) * (GAUGE - jnp.abs(xi))
    slope = -np.tan(CONE) * jnp.sign(xi)
    on_rail = x + xi * ct * cp + wheel * (ct * sp * c - st * s)
    across = jnp.abs(on_rail) - GAUGE - np.sin(CONE) * RAIL
    height = jnp.sqrt(RAIL**2 - across**2)
    rail_slope, rail_bend = -jnp.sign(on_rail) * across / height, -(RAIL**2) / height**3
    by_theta = rail_slope * (wheel * (-ct * s - c * sp * st) - cp * st * xi)
    by_phi = -c * wheel * sp - cp * xi + rail_slope * (cp * c * ct * wheel - ct * sp * xi)
    one = jnp.ones_like(by_phi)
    direction = jnp.stack([rail_slope, -one, 0 * one, by_theta, by_phi])
    up = (slope * cp - sp * c) * ct + s * st
    angle = jnp.arctan(up / (-side * (slope * sp + c * cp)))
    tangent = rail_slope * (slope * sp + cp * c) + slope * ct * cp - ct * sp * c + st * s
    along = slope * st * cp - st * sp * c - ct * s
    return Contact(
        wheel, slope, rail_slope, rail_bend, direction, angle, jnp.stack([tangent, along])
    )


def creep_force(
    side: float,
    at: Contact,
    friction: Any,
    normal: Any,
    p: Any,
    v: Any,
    rate: Any,
    psi: Any,
    xi: Any,
) -> Any:
    """Of the rail on the wheel, by Kalker's linear theory with saturation."""
    sp, cp, s, c = jnp.sin(p[4]), jnp.cos(p[4]), jnp.sin(psi), jnp.cos(psi)
    sd, cd = side * jnp.sin(at.angle), jnp.cos(at.angle)
    st, ct = jnp.sin(p[3] / cd), jnp.cos(p[3] / cd)
    r, spin = at.wheel, SPIN + rate
    curvature = 0.5 / (r * jnp.sqrt(1 + at.wheel_slope**2))
    curvature = curvature - 0.5 * at.rail_bend / (1 + at.rail_slope**2) ** 1.5
    load = 3 * jnp.abs(normal) * (1 - POISSON) * ELLIPSE_E
    size = (load / (2 * np.pi * curvature * SHEAR * np.sqrt(ELLIPSE_G))) ** (1 / 3)
    arm = xi * sp - r * cp * c
    slip = jnp.stack(
        [
            -spin * r * (st * c + ct * sp * s)
            + v[0]
            - v[3] * (r * (st * sp * c + ct * s) + xi * st * cp)
            - v[4] * ct * arm,
            spin * r * cp * s + v[1] + v[4] * (xi * cp + r * sp * c),
            -spin * r * (ct * c - st * sp * s)
            + SPEED
            + v[2]
            - v[3] * (xi * ct * cp + r * (ct * sp * c - st * s))
            + v[4] * st * arm,
        ]
    )
    rolling = slip - 2 * v[:3] - jnp.array([0.0, 0.0, 2 * SPEED])
    speed = 0.5 * jnp.sqrt(jnp.sum(rolling**2))
    ahead = jnp.stack([st, jnp.zeros_like(st), ct])
    aside = jnp.stack([ct * cd, sd, -st * cd])
    turn = (-sd * spin + cd * v[3]) / speed
    limit = friction * normal
    first = SHEAR * size**2 * C11 * (ahead @ slip) / speed
    second = SHEAR * size**2 * C22 * (aside @ slip) / speed + SHEAR * size**3 * C23 * turn
    forces = -limit * jnp.tanh(jnp.stack([first, second]) / limit)
    total = jnp.sqrt(jnp.sum(forces**2))
    forces = forces * jnp.where(total > jnp.abs(limit), jnp.abs(limit) / total, 1.0)
    return forces[0] * ahead + forces[1] * aside


def torques(at: Contact, force: Any, p: Any, psi: Any, xi: Any) -> Any:
    """Of a force at the contact, about the three axes of the equations."""
    st, ct, sp, cp = jnp.sin(p[3]), jnp.cos(p[3]), jnp.sin(p[4]), jnp.cos(p[4])
    s, c, r = jnp.sin(psi), jnp.cos(psi), at.wheel
    levers = [
        [-(xi * st + r * s * ct * cp), -r * s * sp, -xi * ct + r * s * st * cp],
        [-(xi * ct * sp - r * c * ct * cp), xi * cp + r * c * sp, xi * st * sp - r * c * st * cp],
        [-r * (c * st + s * ct * sp), r * s * cp, -r * (c * ct - s * st * sp)],
    ]
    return jnp.stack([jnp.stack(row) @ force for row in levers])


def residual(t: Any, x: Any, xdot: Any, args: Any) -> Any:
    p, v, rate, dv = x["p"], x["v"], x["rate"], xdot["v"]
    left = contact(1.0, p, *x["left"])
    right = contact(-1.0, p, *x["right"])
    push = SCALE * (x["force"][1] * left.direction + x["force"][0] * right.direction)
    sl, cl, sr, cr = (f(at.angle) for at in (left, right) for f in (jnp.sin, jnp.cos))
    deter = -sl * cr - sr * cl
    normals = (cr * push[0] - sr * push[1]) / deter, (-cl * push[0] - sl * push[1]) / deter
    TL = creep_force(1.0, left, args["friction"], normals[0], p, v, rate, *x["left"])
    TR = creep_force(-1.0, right, args["friction"], normals[1], p, v, rate, *x["right"])
    turn = torques(left, TL, p, *x["left"]) + torques(right, TR, p, *x["right"])
    sp, cp = jnp.sin(p[4]), jnp.cos(p[4])
    outer = jnp.stack([-2 * SPRING * p[0], -MASS * GRAVITY, -2 * SPRING * p[2]])
    steer, spin = -2 * HALF_WIDTH**2 * SPRING * p[3], SPIN + rate
    yaw = -I2 * (dv[3] * cp - v[3] * v[4] * sp) - I1 * spin * v[4] - (I1 - I2) * v[3] * sp * v[4]
    roll = -I2 * dv[4] + I1 * spin * v[3] * cp + (I1 - I2) * v[3] ** 2 * sp * cp
    wheel = -I1 * (xdot["rate"] + dv[3] * sp + v[3] * v[4] * cp)
    return {
        "kinematics": xdot["p"] - v,
        "forces": -MASS * dv[:3] + TL + TR + outer + push[:3],
        "yaw": yaw + turn[0] + cp * steer + push[3],
        "roll": roll + turn[1] + push[4],
        "rate": wheel + turn[2] + sp * steer,
        "left": left.conditions,
        "right": right.conditions,
        "contact": jnp.stack([right.direction @ v, left.direction @ v]),
    }


def wheelset() -> BoardProblem:
    start = {
        "p": np.array([0.14941e-2, 0.40089e-6, 0.11241e-5, -0.28573e-3, 0.26459e-3]),
        "v": np.zeros(5),
        "rate": np.asarray(0.0),
        "left": np.array([-7.4122380357667139e-6, -0.1521364296121248]),
        "right": np.array([7.5634406395172940e-6, 0.1490635714733819]),
        "force": np.array([-0.83593e-2, -0.74144e-2]),
    }
    end = {
        "p": [
            0.86355386965811e-2,
            0.13038281022727e-4,
            -0.93635784016818e-4,
            -0.13642299804033e-1,
            0.15292895005422e-2,
        ],
        "v": [
            -0.76985374142666e-1,
            -0.25151106429207e-3,
            0.20541188079539e-2,
            -0.23904837703692,
            -0.13633468454173e-1,
        ],
        "rate": -0.24421377661131,
        "left": [-0.33666751972196e-3, -0.15949425684022],
        "right": [0.37839614386969e-3, 0.14173214964613],
        "force": [-0.10124044903201e-1, -0.56285630573753e-2],
    }
    return BoardProblem(
        residual,
        start,
        {"friction": 0.12},
        10.0,
        end,
        "",
        rtol=1e-9,
        atol=1e-11,
        form="index-1",
    )
