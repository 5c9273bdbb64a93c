"""The bicycle of Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007) 1955-1982, by Kane's method.

Four rigid bodies: rear wheel R, rear frame with rider B, front frame H and front wheel F. Axes as in the paper: x
forward, y to the right, z down, the origin at the rear contact; measures of Table 1 without conversion.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import sympy as sm
import sympy.physics.mechanics as me


# Table 1: wheel base, trail, tilt of the steer axis, radii, centres of mass, masses, moments of inertia.
PARAMETERS = {
    **{"w": 1.02, "c": 0.08, "tilt": np.pi / 10, "g": 9.81, "r_R": 0.3, "r_F": 0.35},
    **{"x_B": 0.3, "z_B": -0.9, "x_H": 0.9, "z_H": -0.7},
    **{"m_R": 2.0, "m_B": 85.0, "m_H": 4.0, "m_F": 3.0},
    **{"I_Rxx": 0.0603, "I_Ryy": 0.12, "I_Fxx": 0.1405, "I_Fyy": 0.28},
    **{"I_Bxx": 9.2, "I_Byy": 11.0, "I_Bzz": 2.8, "I_Bxz": 2.4},
    **{"I_Hxx": 0.05892, "I_Hyy": 0.06, "I_Hzz": 0.00708, "I_Hxz": -0.00756},
}
# Table 2: the eigenvalues at forward speeds of 0, 1, ..., 10 m/s. Weave (real and imaginary part), capsize, castering; at
# 0 m/s all four are real.
PUBLISHED_AT_REST = (-5.53094371765393, -3.13164324790656, 3.13164324790656, 5.53094371765393)
PUBLISHED = {
    1: (3.52696170990070, 0.80774027519930, -3.13423125066578, -7.11008014637442),
    2: (2.68234517512745, 1.68066296590675, -3.07158645641514, -8.67387984831735),
    3: (1.70675605663975, 2.31582447384325, -2.63366137253667, -10.3510146724592),
    4: (0.41325331521125, 3.07910818603206, -1.42944427361326, -12.15861426576447),
    5: (-0.77534188219585, 4.46486771378823, -0.32286642900409, -14.07838969279822),
    6: (-1.52644486584142, 5.87673060598709, -0.00406690076970, -16.0853712309803),
    7: (-2.13875644258362, 7.19525913329805, 0.10268170574766, -18.1578846612526),
    8: (-2.69348683581097, 8.46037971396931, 0.14327879765713, -20.2794089439457),
    9: (-3.21675402252485, 9.69377351531791, 0.15790184030917, -22.4378855904086),
    10: (-3.72016840437287, 10.90681139476287, 0.16105338653172, -24.62459635017404),
}


class Bodies(NamedTuple):
    """The frames, points and bodies of the bicycle."""

    ground: me.ReferenceFrame
    heading: me.ReferenceFrame
    centers: tuple[me.Point, ...]  # of mass, of R, B, H, F
    front_contact: me.Point  # the material point of the front wheel
    bodies: tuple[me.RigidBody, ...]


def bodies(q: Any, u: Any) -> Bodies:
    """Place the bodies; angles are yaw, lean, pitch of the rear frame, steer, and those of the wheels."""
    s = {name: sm.Symbol(name) for name in PARAMETERS}
    yaw, lean, pitch, steer = q[2:6]
    N = me.ReferenceFrame("N")
    A = N.orientnew("A", "Axis", [yaw, N.z])
    L = A.orientnew("L", "Axis", [lean, A.x])
    B = L.orientnew("B", "Axis", [pitch, L.y])
    axis = sm.sin(s["tilt"]) * B.x + sm.cos(s["tilt"]) * B.z
    H = B.orientnew("H", "Axis", [steer, axis])
    A.set_ang_vel(N, u[0] * N.z)
    L.set_ang_vel(A, u[1] * A.x)
    B.set_ang_vel(L, u[2] * L.y)
    H.set_ang_vel(B, u[3] * axis)
    R, F = me.ReferenceFrame("R"), me.ReferenceFrame("F")  # their angles do not matter
    R.set_ang_vel(B, u[4] * B.y)
    F.set_ang_vel(H, u[5] * H.y)

    contact = me.Point("P")
    contact.set_vel(N, 0)
    at_R = contact.locatenew("R_o", -s["r_R"] * L.z)
    from_R = lambda x, z: x * B.x + (z + s["r_R"]) * B.z  # a point of B
    at_B = at_R.locatenew("B_o", from_R(s["x_B"], s["z_B"]))
    on_axis = at_R.locatenew("S", from_R(s["w"] + s["c"], 0))
    from_S = lambda x, z: (x - s["w"] - s["c"]) * H.x + z * H.z  # a point of H
    at_H = on_axis.locatenew("H_o", from_S(s["x_H"], s["z_H"]))
    at_F = on_axis.locatenew("F_o", from_S(s["w"], -s["r_F"]))
    down = (N.z - N.z.dot(H.y) * H.y).normalize()  # in the plane of the front wheel
    front = at_F.locatenew("Q", s["r_F"] * down)
    at_R.v2pt_theory(contact, N, R)
    for point, origin, frame in (
        (at_B, at_R, B),
        (on_axis, at_R, B),
        (at_H, on_axis, H),
        (at_F, on_axis, H),
        (front, at_F, F),
    ):
        point.v2pt_theory(origin, N, frame)

    of_wheel = lambda frame, i: me.inertia(frame, s[f"I_{i}xx"], s[f"I_{i}yy"], s[f"I_{i}xx"])
    of_frame = lambda frame, i: me.inertia(
        frame, s[f"I_{i}xx"], s[f"I_{i}yy"], s[f"I_{i}zz"], 0, 0, s[f"I_{i}xz"]
    )
    parts = (
        me.RigidBody("rear_wheel", at_R, R, s["m_R"], (of_wheel(B, "R"), at_R)),
        me.RigidBody("rear_frame", at_B, B, s["m_B"], (of_frame(B, "B"), at_B)),
        me.RigidBody("front_frame", at_H, H, s["m_H"], (of_frame(H, "H"), at_H)),
        me.RigidBody("front_wheel", at_F, F, s["m_F"], (of_wheel(H, "F"), at_F)),
    )
    return Bodies(N, A, (at_R, at_B, at_H, at_F), front, parts)


def kanes_method() -> tuple[me.KanesMethod, sm.Expr]:
    """Return the method with its equations formed, and the energy."""
    q = x, y, yaw, lean, pitch, steer, roll_R, roll_F = me.dynamicsymbols(
        "x y yaw lean pitch steer roll_R roll_F"
    )
    u = me.dynamicsymbols("u_yaw u_lean u_pitch u_steer u_R u_F")
    bike = bodies(q, u)
    N, A, g = bike.ground, bike.heading, sm.Symbol("g")
    speed = -sm.Symbol("r_R") * (u[2] + u[4])  # of the rear contact along the heading
    along = [x.diff() - speed * sm.cos(yaw), y.diff() - speed * sm.sin(yaw)]
    height = bike.front_contact.pos_from(bike.centers[0]).dot(N.z)
    height += -sm.Symbol("r_R") * sm.cos(lean)  # of the rear axle
    method = me.KanesMethod(
        N,
        q_ind=[x, y, yaw, lean, steer, roll_R, roll_F],
        q_dependent=[pitch],
        configuration_constraints=[height],
        u_ind=[u[1], u[3], u[4]],
        u_dependent=[u[0], u[2], u[5]],
        velocity_constraints=[bike.front_contact.vel(N).dot(e) for e in A],
        kd_eqs=[*along, *(angle.diff() - rate for angle, rate in zip(q[2:], u, strict=True))],
        constraint_solver="CRAMER",
    )
    weights = [
        (point, body.mass * g * N.z) for point, body in zip(bike.centers, bike.bodies, strict=True)
    ]
    method.kanes_equations(bike.bodies, weights)
    energy = sum(body.kinetic_energy(N) for body in bike.bodies)
    for point, body in zip(bike.centers, bike.bodies, strict=True):
        above = point.pos_from(bike.centers[0]).dot(N.z) - sm.Symbol("r_R") * sm.cos(lean)
        energy -= body.mass * g * above
    return method, energy


def straight_ahead(model: Any, args: dict[str, Any], speed: Any, **others: float) -> Any:
    """Return the state at a forward speed (m/s), upright unless `others` say something else."""
    wheels = {"u_R": -speed / args["r_R"], "u_F": -speed / args["r_F"]}
    return model.state({**wheels, **others}, args)


def eigenvalues(model: Any, args: dict[str, Any], speeds: Any) -> np.ndarray:
    """Return the four eigenvalues of lean and steer at each speed, of the equations linearized along the manifold.

    The lateral motion and the motion ahead are independent of each other to first order.
    """
    names, n = model.coordinates + model.speeds, len(model.coordinates)
    free = np.array([names.index(name) for name in ("lean", "steer", "u_lean", "u_steer")])
    others = np.array([names.index(name) for name in ("pitch", "u_yaw", "u_pitch", "u_F")])

    def linearized(speed: Any) -> Any:
        y = jnp.concatenate(straight_ahead(model, args, speed))
        of_vector = lambda f: lambda y: jnp.concatenate(f(0.0, (y[:n], y[n:]), args))
        A, G = (jax.jacfwd(of_vector(f))(y) for f in (model.terms.vf, model.constraint))
        tangent = jnp.zeros((len(names), 4)).at[free].set(jnp.eye(4))
        along = -jnp.linalg.solve(G[:, others], G[:, free])
        return A[free] @ tangent.at[others].set(along)

    matrices = jax.jit(jax.vmap(linearized))(jnp.asarray(speeds, float))
    return np.linalg.eigvals(np.asarray(matrices))


def published(speed: int) -> np.ndarray:
    """Return the four eigenvalues of Table 2."""
    if speed == 0:
        return np.array(PUBLISHED_AT_REST)
    real, imaginary, *others = PUBLISHED[speed]
    return np.array([real + 1j * imaginary, real - 1j * imaginary, *others])
