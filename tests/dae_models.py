"""Differential-algebraic equations as people write them, and what they reduce to by hand."""

import jax
import jax.numpy as jnp
import numpy as np


# Pendulum, index 3: x = (px, py, vx, vy, tension), args with m, g, L.
PENDULUM_ARGS = {"m": 1.3, "g": 9.81, "L": 1.1}


def pendulum(t, x, xdot, a):
    px, py, vx, vy, tension = x
    return jnp.stack(
        [
            xdot[0] - vx,
            xdot[1] - vy,
            a["m"] * xdot[2] + 2 * tension * px,
            a["m"] * xdot[3] + 2 * tension * py + a["m"] * a["g"],
            px**2 + py**2 - a["L"] ** 2,
        ]
    )


def pendulum_second_order(t, x, xdot, xddot, a):
    q, tension = x["q"], x["tension"]
    weight = jnp.stack([jnp.zeros_like(tension), a["m"] * a["g"]])
    return {
        "motion": a["m"] * xddot["q"] + 2 * tension * q + weight,
        "rod": jnp.sum(q**2) - a["L"] ** 2,
    }


def pendulum_field(t, z, a):
    px, py, vx, vy = z
    tension = a["m"] * (vx**2 + vy**2 - a["g"] * py) / (2 * (px**2 + py**2))
    return jnp.stack([vx, vy, -2 * tension * px / a["m"], -2 * tension * py / a["m"] - a["g"]])


def pendulum_constraint(t, z, a):
    px, py, vx, vy = z
    return jnp.stack([px**2 + py**2 - a["L"] ** 2, 2 * (px * vx + py * vy)])


# Chain of N links, index 3: positions and velocities (N, 2), N tensions.


def chain(t, x, xdot, a):
    p, v, tension = x["p"], x["v"], x["tension"]
    rods = jnp.diff(p, axis=0, prepend=jnp.zeros((1, 2), p.dtype))
    pull = tension[:, None] * rods
    force = -2 * pull + 2 * jnp.concatenate([pull[1:], jnp.zeros((1, 2), p.dtype)])
    weight = a["m"][:, None] * jnp.stack([jnp.zeros_like(a["g"]), a["g"]])[None, :]
    return {
        "kinematics": xdot["p"] - v,
        "motion": a["m"][:, None] * xdot["v"] - force + weight,
        "rods": jnp.sum(rods**2, axis=1) - a["L"] ** 2,
    }


def chain_example(N, seed=0):
    """A consistent state of the chain, and its parameters."""
    random = np.random.default_rng(seed)
    angle, rate = random.uniform(-0.9, 0.9, N), random.uniform(-1, 1, N)
    length = 1 + 0.3 * random.uniform(size=N)
    along = length[:, None] * np.stack([np.sin(angle), -np.cos(angle)], 1)
    across = (length * rate)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    x = {"p": np.cumsum(along, 0), "v": np.cumsum(across, 0), "tension": np.zeros(N)}
    a = {"m": 1 + random.uniform(size=N), "L": length, "g": np.asarray(9.81)}
    return jax.tree.map(jnp.asarray, x), jax.tree.map(jnp.asarray, a)


def chain_rods(p, a):
    rods = jnp.diff(p.reshape(-1, 2), axis=0, prepend=jnp.zeros((1, 2), p.dtype))
    return jnp.sum(rods**2, axis=1) - a["L"] ** 2


def chain_field(t, z, a):
    """`z = (p, v)`, by the Schur complement of the diagonal masses."""
    q, v = jnp.split(z, 2)
    J = jax.jacfwd(chain_rods)(q, a)
    gamma = jax.jvp(lambda q: jax.jvp(lambda q: chain_rods(q, a), (q,), (v,))[1], (q,), (v,))[1]
    inverse = jnp.repeat(1 / a["m"], 2)
    weight = jnp.tile(jnp.array([0.0, -1.0]), len(a["m"])) * a["g"]
    tension = jnp.linalg.solve((J * inverse[None, :]) @ J.T, J @ weight + gamma)
    return jnp.concatenate([v, weight - inverse * (J.T @ tension)])


def chain_constraint(t, z, a):
    q, v = jnp.split(z, 2)
    return jnp.concatenate(jax.jvp(lambda q: chain_rods(q, a), (q,), (v,)))


# Circuits.
RLC_ARGS = {"R": 0.7, "L": 0.4, "C": 1.3, "w": 2.0}


def rlc_series(t, x, xdot, a):
    """All branch voltages, index 1: `x = (uC, i, uR, uL)`."""
    uC, i, uR, uL = x
    return jnp.stack(
        [
            a["C"] * xdot[0] - i,
            a["L"] * xdot[1] - uL,
            uR - a["R"] * i,
            uR + uL + uC - jnp.sin(a["w"] * t),
        ]
    )


def rlc_field(t, z, a):
    uC, i = z
    return jnp.stack([i / a["C"], (jnp.sin(a["w"] * t) - uC - a["R"] * i) / a["L"]])


def capacitor_loop(t, x, xdot, a):
    """A source parallel to a capacitor and to a coil with a resistor, index 2:
    `x = (u, iC, iL, i)`."""
    u, iC, iL, i = x
    return jnp.stack(
        [
            u - jnp.sin(a["w"] * t),
            a["C"] * xdot[0] - iC,
            a["L"] * xdot[2] + a["R"] * iL - u,
            i - iC - iL,
        ]
    )


def capacitor_field(t, z, a):
    u, iL = z
    return jnp.stack([a["w"] * jnp.cos(a["w"] * t), (u - a["R"] * iL) / a["L"]])


DIODE_ARGS = {"R": 0.5, "C": 1.0, "Is": 1e-2, "Vt": 0.2, "Rd": 0.1, "w": 2.0}


def diode(t, x, xdot, a):
    """Source, resistor, and a capacitor parallel to a diode with a resistor, index 1:
    `x = (u, ud, i)`, with a law of the diode that cannot be solved for its voltage."""
    u, ud, i = x
    return jnp.stack(
        [
            a["C"] * xdot[0] - (jnp.sin(a["w"] * t) - u) / a["R"] + i,
            i - a["Is"] * (jnp.exp(ud / a["Vt"]) - 1),
            u - ud - a["Rd"] * i,
        ]
    )


def transistor(t, x, xdot, a):
    """The transistor amplifier of the IVP test set, index 1, with a singular matrix of capacities."""
    beta, UF, alpha, R, R0, Ub = 1e-6, 0.026, 0.99, 9000.0, 1000.0, 6.0
    C = 1e-6 * np.arange(1.0, 6.0)
    u, g = x, lambda v: beta * (jnp.exp(v / UF) - 1)
    source = 0.1 * jnp.sin(200 * jnp.pi * t)
    first, second = g(u[1] - u[2]), g(u[4] - u[5])
    f = [
        (source - u[0]) / R0,
        Ub / R - u[1] * 2 / R - (1 - alpha) * first,
        first - u[2] / R,
        Ub / R - u[3] / R - alpha * first,
        Ub / R - u[4] * 2 / R - (1 - alpha) * second,
        second - u[5] / R,
        Ub / R - u[6] / R - alpha * second,
        -u[7] / R,
    ]
    d = xdot
    charge = [
        C[0] * (d[0] - d[1]),
        C[0] * (d[1] - d[0]),
        C[1] * d[2],
        C[2] * (d[3] - d[4]),
        C[2] * (d[4] - d[3]),
        C[3] * d[5],
        C[4] * (d[6] - d[7]),
        C[4] * (d[7] - d[6]),
    ]
    return jnp.stack(charge) - jnp.stack(f)


# Chemistry.


def robertson(t, x, xdot, k):
    """Index 1, with the conservation of mass in the place of the third equation."""
    y1, y2, y3 = x
    return jnp.stack(
        [
            xdot[0] + k[0] * y1 - k[2] * y2 * y3,
            xdot[1] - k[0] * y1 + k[2] * y2 * y3 + k[1] * y2**2,
            y1 + y2 + y3 - 1,
        ]
    )


def akzo_nobel(t, x, xdot, a):
    """The chemical Akzo Nobel problem of the IVP test set, index 1."""
    k1, k2, k3, k4 = 18.7, 0.58, 0.09, 0.42
    K, klA, Ks, pressure, H = 34.4, 3.3, 115.83, 0.9, 737.0
    y1, y2, y3, y4, y5, y6 = x
    r1 = k1 * y1**4 * jnp.sqrt(y2)
    r2, r3 = k2 * y3 * y4, k2 / K * y1 * y5
    r4, r5 = k3 * y1 * y4**2, k4 * y6**2 * jnp.sqrt(y2)
    inflow = klA * (pressure / H - y2)
    f = [-2 * r1 + r2 - r3 - r4, -0.5 * r1 - r4 - 0.5 * r5 + inflow, r1 - r2 + r3]
    f += [-r2 + r3 - 2 * r4, r2 - r3 + r5]
    return jnp.stack([*(d - g for d, g in zip(xdot[:5], f)), Ks * y1 * y4 - y6])


# Robots and cranes.
ARM_ARGS = {
    **{"m1": 1.0, "m2": 0.8, "l1": 1.0, "l2": 0.9, "g": 9.81, "d": 0.3, "r": 0.5, "w": 1.1},
    "center": np.array([0.9, 0.5]),
}
ARM_ARGS = jax.tree.map(jnp.asarray, ARM_ARGS)


def arm_dynamics(q, v, a):
    """Mass matrix, and what the torques have to balance."""
    m1, m2, l1, l2, g = (a[name] for name in ("m1", "m2", "l1", "l2", "g"))
    c2, s2 = jnp.cos(q[1]), jnp.sin(q[1])
    m12 = m2 * l2**2 + m2 * l1 * l2 * c2
    m11 = (m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * c2
    M = jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m2 * l2**2])])
    coupling = m2 * l1 * l2 * s2
    weight = m2 * g * l2 * jnp.cos(q[0] + q[1])
    h1 = -coupling * (2 * v[0] * v[1] + v[1] ** 2) + (m1 + m2) * g * l1 * jnp.cos(q[0]) + weight
    return M, jnp.stack([h1, coupling * v[0] ** 2 + weight])


def arm_tip(q, a):
    angle = q[0] + q[1]
    return jnp.stack(
        [
            a["l1"] * jnp.cos(q[0]) + a["l2"] * jnp.cos(angle),
            a["l1"] * jnp.sin(q[0]) + a["l2"] * jnp.sin(angle),
        ]
    )


def arm_path(q, a):
    return jnp.sum((arm_tip(q, a) - a["center"]) ** 2) - a["r"] ** 2


def arm_on_path(t, x, xdot, a):
    """The tip stays on a circle, index 3, two degrees of freedom."""
    q, v = x["q"], x["v"]
    M, h = arm_dynamics(q, v, a)
    force = jax.grad(arm_path)(q, a) * x["force"]
    motion = M @ xdot["v"] + h + a["d"] * v + force
    return {"kinematics": xdot["q"] - v, "motion": motion, "path": arm_path(q, a)}


def arm_field(t, z, a):
    q, v = z[:2], z[2:]
    M, h = arm_dynamics(q, v, a)
    J = jax.grad(arm_path)(q, a)
    gamma = jax.jvp(lambda q: jax.grad(arm_path)(q, a) @ v, (q,), (v,))[1]
    K = jnp.block([[M, J[:, None]], [J[None, :], jnp.zeros((1, 1))]])
    found = jnp.linalg.solve(K, jnp.concatenate([-h - a["d"] * v, -gamma[None]]))
    return jnp.concatenate([v, found[:2]])


def arm_constraint(t, z, a):
    return jnp.stack(jax.jvp(lambda q: arm_path(q, a), (z[:2],), (z[2:],)))


def servo_path(t, a):
    return jnp.stack([1.0 + 0.3 * jnp.cos(a["w"] * t), 0.6 + 0.3 * jnp.sin(a["w"] * t)])


def servo(t, x, xdot, a):
    """The tip is led along a path, torques unknown, index 3: no degree of freedom."""
    q, v = x["q"], x["v"]
    M, h = arm_dynamics(q, v, a)
    return {
        "kinematics": xdot["q"] - v,
        "motion": M @ xdot["v"] + h - x["torque"],
        "path": arm_tip(q, a) - servo_path(t, a),
    }


CRANE_ARGS = {"m1": 1.4, "m2": 2.0, "J": 0.3, "rho": 0.2, "g": 9.81, "v0": 0.8}


def crane_path(t, a):
    return a["v0"] * t + 0.3 * jnp.sin(t), 5.0 + 0.5 * jnp.cos(0.7 * t)


def crane(t, x, xdot, a):
    """Overhead crane with prescribed path of the load (px down to pz), inputs unknown, index 5.

    `x`: load X, Z, trolley D, rope R, their velocities, angle, tension, inputs u1, u2.
    """
    X, Z, D, R, VX, VZ, VD, VR, angle, tension, u1, u2 = x
    s, c = jnp.sin(angle), jnp.cos(angle)
    px, pz = crane_path(t, a)
    return jnp.stack(
        [
            xdot[0] - VX,
            xdot[1] - VZ,
            xdot[2] - VD,
            xdot[3] - VR,
            a["m2"] * xdot[4] + tension * s,
            a["m2"] * xdot[5] + tension * c - a["m2"] * a["g"],
            a["m1"] * xdot[6] - u1 - tension * s,
            a["J"] * xdot[7] - u2 + a["rho"] ** 2 * tension,
            R * s + D - X,
            R * c - Z,
            X - px,
            Z - pz,
        ]
    )


CRANE_GUESS = (0.1, 5.4, 0.1, 5.6, 1.0, 0.1, 1.0, 0.1, 0.05, 19.0, 0.0, 0.0)


def crane_flat(t, a):
    """All unknowns, from the path of the load by differentiation: it is flat."""

    def d(f):
        return lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]

    X, Z = (lambda t, i=i: crane_path(t, a)[i] for i in (0, 1))
    ax, az = d(d(X)), d(d(Z))
    angle = lambda t: jnp.arctan2(-ax(t), a["g"] - az(t))
    tension = lambda t: a["m2"] * jnp.sqrt(ax(t) ** 2 + (a["g"] - az(t)) ** 2)
    R = lambda t: Z(t) / jnp.cos(angle(t))
    D = lambda t: X(t) - Z(t) * jnp.tan(angle(t))
    u1 = lambda t: a["m1"] * d(d(D))(t) - tension(t) * jnp.sin(angle(t))
    u2 = lambda t: a["J"] * d(d(R))(t) + a["rho"] ** 2 * tension(t)
    every = [X, Z, D, R, d(X), d(Z), d(D), d(R), angle, tension, u1, u2]
    return jnp.stack([f(t) for f in every])


# Published benchmarks of index 3, as residuals.


def car_axis(t, x, xdot, a):
    """The car axis of the IVP test set; its multipliers have the other sign there.

    `x = {"q": (4,), "v": (4,), "force": (2,)}`.
    """
    q, v, force = x["q"], x["v"], x["force"]
    k = a.mass * a.epsilon**2 / 2
    yb = a.road_amplitude * jnp.sin(a.road_frequency * t)
    xb = jnp.sqrt(a.length**2 - yb**2)
    xl, yl, xr, yr = q[0], q[1], q[2], q[3]
    left, right = jnp.hypot(xl, yl), jnp.hypot(xr - xb, yr - yb)
    springs = [
        (a.spring_length - left) * xl / left,
        (a.spring_length - left) * yl / left - k * a.gravity,
        (a.spring_length - right) * (xr - xb) / right,
        (a.spring_length - right) * (yr - yb) / right - k * a.gravity,
    ]
    reaction = [
        xb * force[0] + 2 * (xl - xr) * force[1],
        yb * force[0] + 2 * (yl - yr) * force[1],
        -2 * (xl - xr) * force[1],
        -2 * (yl - yr) * force[1],
    ]
    return {
        "kinematics": xdot["q"] - v,
        "motion": k * xdot["v"] - jnp.stack(springs) + jnp.stack(reaction),
        "joints": jnp.stack([xl * xb + yl * yb, (xl - xr) ** 2 + (yl - yr) ** 2 - a.length**2]),
    }


# Multipliers at t = 3, with the sign above. Source: Test Set for IVP Solvers, caraxis.
CAR_AXIS_FORCE = (0.473688659084893324729e-2, 0.110468033125734368808e-2)


def mechanism(mass, loops, force):
    """The residual of a mechanism of the benchmarks, by its parts."""

    def residual(t, x, xdot, a):
        q, v = x["q"], x["v"]
        _, pull = jax.vjp(lambda q: loops(t, q, a), q)
        return {
            "kinematics": xdot["q"] - v,
            "motion": mass(q, a) @ xdot["v"] - force(t, q, v, a) + pull(x["force"])[0],
            "loops": loops(t, q, a),
        }

    return residual
