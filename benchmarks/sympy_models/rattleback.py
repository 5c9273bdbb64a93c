"""The rattleback of Kane & Levinson, Int. J. Non-Linear Mech. 17 (1982) 175-186, by Kane's method.

A half of an ellipsoid, whose principal axes of inertia are turned against those of its surface, rolls on a table. Spun in
one direction it begins to rattle, stops, and turns in the other direction.
"""

import numpy as np
import scipy.integrate
import sympy as sm
import sympy.physics.mechanics as me


# Semi-axes, distance of the centre of mass from the centre of the ellipsoid, moments and product of inertia, damping; SI units.
PARAMETERS = {
    **{"a": 0.2, "b": 0.03, "c": 0.02, "h": 0.01, "m": 1.0, "g": 9.81},
    **{"A": 2e-4, "B": 1.6e-3, "C": 1.7e-3, "D": -2e-5, "sigma": 1e-4},
}
# Half a degree of tilt about both axes, and a spin about the third.
START = {"alpha": np.deg2rad(0.5), "beta": np.deg2rad(0.5), "w3": -5.0, "z": -0.01}


def kanes_method() -> tuple[me.KanesMethod, sm.Expr]:
    """Return the method with its equations formed, and the energy. The third axis of space points down."""
    q = gamma, alpha, beta, x, y, z = me.dynamicsymbols("gamma alpha beta x y z")
    u = w1, w2, w3, v1, v2, v3 = me.dynamicsymbols("w1 w2 w3 v1 v2 v3")
    a, b, c, h, m, g, A, B, C, D, sigma = sm.symbols("a b c h m g A B C D sigma")
    N, R = me.ReferenceFrame("N"), me.ReferenceFrame("R")
    R.orient_body_fixed(N, (gamma, alpha, beta), "ZXY")
    of_angles, spin = R.ang_vel_in(N), w1 * R.x + w2 * R.y + w3 * R.z
    R.set_ang_vel(N, spin)
    origin, center = me.Point("O"), me.Point("G")
    origin.set_vel(N, 0)
    center.set_pos(origin, x * N.x + y * N.y + z * N.z)
    center.set_vel(N, v1 * N.x + v2 * N.y + v3 * N.z)
    mu = [N.z.dot(e) for e in R]  # the contact is where the normal points down
    length = sm.sqrt((a * mu[0]) ** 2 + (b * mu[1]) ** 2 + (c * mu[2]) ** 2)
    to_contact = a**2 * mu[0] * R.x + b**2 * mu[1] * R.y + c**2 * mu[2] * R.z
    contact = center.locatenew("P", to_contact / length - h * R.z)
    sliding = center.vel(N) + spin.cross(contact.pos_from(center))
    body = me.RigidBody("body", center, R, m, (me.inertia(R, A, B, C, D, 0, 0), center))
    method = me.KanesMethod(
        N,
        q_ind=q[:5],
        q_dependent=[z],
        configuration_constraints=[contact.pos_from(origin).dot(N.z)],
        u_ind=u[:3],
        u_dependent=u[3:],
        velocity_constraints=[sliding.dot(e) for e in N],
        kd_eqs=[(of_angles - spin).dot(e) for e in R]
        + [place.diff() - speed for place, speed in zip(q[3:], u[3:], strict=True)],
    )
    method.kanes_equations([body], [(center, m * g * N.z), (R, -sigma * spin)])
    return method, body.kinetic_energy(N) - m * g * z


def published_equations(t: float, state: np.ndarray) -> np.ndarray:
    """The three angles and angular velocities of the paper, without the coordinates of the centre: Newton's and Euler's
    equations, from which the force at the contact is eliminated."""
    p = PARAMETERS
    (alpha, beta, _), w = state[:3], state[3:]
    mu = np.array([-np.cos(alpha) * np.sin(beta), np.sin(alpha), np.cos(alpha) * np.cos(beta)])
    axes2 = np.array([p["a"], p["b"], p["c"]]) ** 2
    length, mu_rate = np.sqrt(axes2 @ mu**2), np.cross(mu, w)
    r = axes2 * mu / length - np.array([0.0, 0.0, p["h"]])
    r_rate = axes2 * (mu_rate / length - mu * (axes2 @ (mu * mu_rate)) / length**3)
    inertia = np.array([[p["A"], p["D"], 0.0], [p["D"], p["B"], 0.0], [0.0, 0.0, p["C"]]])
    known = np.cross(w, -np.cross(w, r)) - np.cross(w, r_rate)  # the acceleration without w'
    torque = p["m"] * np.cross(r, known - p["g"] * mu) - np.cross(w, inertia @ w) - p["sigma"] * w
    of_contact = inertia + p["m"] * (r @ r * np.eye(3) - np.outer(r, r))
    gamma_rate = (w[2] * np.cos(beta) - w[0] * np.sin(beta)) / np.cos(alpha)
    alpha_rate = w[2] * np.sin(beta) + w[0] * np.cos(beta)
    beta_rate = w[1] - gamma_rate * np.sin(alpha)
    return np.array([alpha_rate, beta_rate, gamma_rate, *np.linalg.solve(of_contact, torque)])


def published_motion(times: np.ndarray, tolerance: float = 1e-10) -> np.ndarray:
    """Return alpha, beta, gamma and the angular velocities at these times, a row each, by SciPy."""
    start = np.array([START["alpha"], START["beta"], 0.0, 0.0, 0.0, START["w3"]])
    span, options = (times[0], times[-1]), {"rtol": tolerance, "atol": tolerance}
    solved = scipy.integrate.solve_ivp(
        published_equations, span, start, method="DOP853", t_eval=times, **options
    )
    return solved.y.T
