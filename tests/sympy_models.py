"""Small models of `sympy.physics.mechanics`."""

import sympy as sm
import sympy.physics.mechanics as me


def pendulum_by_lagrange():
    """A mass on a rod, in Cartesian coordinates, with y upwards."""
    q = x, y = me.dynamicsymbols("x y")
    m, g, length = sm.symbols("m g length")
    v = [c.diff() for c in q]
    energy = m * (v[0] ** 2 + v[1] ** 2) / 2 - m * g * y
    method = me.LagrangesMethod(energy, q, hol_coneqs=[x**2 + y**2 - length**2])
    method.form_lagranges_equations()
    return method


def four_bar_by_lagrange(drive=None):
    """Three uniform rods from the origin to the point (d, 0), by their angles; a torque acts on the first."""
    q = me.dynamicsymbols("a b c")
    lengths, masses = sm.symbols("l1:4"), sm.symbols("m1:4")
    d, g = sm.symbols("d g")
    N, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(N, 0)
    end, energy = sm.zeros(2, 1), 0
    for angle, length, mass in zip(q, lengths, masses):
        along = length * sm.Matrix([sm.cos(angle), sm.sin(angle)])
        center = end + along / 2
        v = center.diff(me.dynamicsymbols._t)
        rotation = mass * length**2 / 12 * angle.diff() ** 2
        energy += (mass * v.dot(v) + rotation) / 2 - mass * g * center[1]
        end += along
    forces = []
    if drive is not None:
        A = N.orientnew("A", "Axis", [q[0], N.z])
        forces = [(A, drive * N.z)]
    method = me.LagrangesMethod(
        energy, q, hol_coneqs=[end[0] - d, end[1]], forcelist=forces, frame=N
    )
    method.form_lagranges_equations()
    return method


def disc_by_kane(explicit=True):
    """The gallery's `rolling_disc`: an upright disc on an inclined plane."""
    q = me.dynamicsymbols("x y heading roll")
    heading = q[2]
    u = vx, vy, turning, spin = me.dynamicsymbols("vx vy turning spin")
    m, R, J, steering, g, slope = sm.symbols(
        "mass radius rolling_inertia steering_inertia gravity slope"
    )
    N = me.ReferenceFrame("N")
    A = N.orientnew("A", "Axis", [heading, N.z])
    A.set_ang_vel(N, turning * N.z)
    D = me.ReferenceFrame("D")
    D.set_ang_vel(A, spin * A.y)
    center = me.Point("C")
    center.set_vel(N, vx * N.x + vy * N.y)
    body = me.RigidBody("disc", center, D, m, (me.inertia(A, steering, J, steering), center))
    method = me.KanesMethod(
        N,
        q_ind=q,
        u_ind=[turning, spin],
        u_dependent=[vx, vy],
        velocity_constraints=[vx - R * spin * sm.cos(heading), vy - R * spin * sm.sin(heading)],
        kd_eqs=[2 * (c.diff() - v) for c, v in zip(q, u)],
        explicit_kinematics=explicit,
    )
    method.kanes_equations([body], [(center, m * g * sm.sin(slope) * N.x)])
    return method


def pendulum_by_kane(push=None):
    """The same mass on a rod; y and its speed are dependent. `push` is a force along x."""
    x, y, u, v = me.dynamicsymbols("x y u v")
    m, g, length = sm.symbols("m g length")
    N, point = me.ReferenceFrame("N"), me.Point("P")
    point.set_vel(N, u * N.x + v * N.y)
    body = me.Particle("bob", point, m)
    method = me.KanesMethod(
        N,
        q_ind=[x],
        q_dependent=[y],
        configuration_constraints=[x**2 + y**2 - length**2],
        u_ind=[u],
        u_dependent=[v],
        velocity_constraints=[x * u + y * v],
        kd_eqs=[x.diff() - u, y.diff() - v],
    )
    force = -m * g * N.y + (0 if push is None else push) * N.x
    method.kanes_equations([body], [(point, force)])
    return method
