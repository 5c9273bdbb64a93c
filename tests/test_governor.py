"""Benchmark A05 of the IFToMM library, a stiff flyball governor, built of bodies and joints and
compared with an integration of its three coordinates by SciPy."""

import diffrax as dfx
import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import manifold_jax as mj


mb = mj.multibody
LENGTH, BALL, STIFFNESS, DAMPING, COUPLER, GRAVITY = 1.0, 5.0, 8e5, 4e4, 0.5, 9.81
ANGLE, RATE = np.pi / 6, 2 * np.pi
ROD = 3000 * LENGTH * 0.01**2  # also the shaft; the slider is a cube
THIN, LONG = ROD * 0.01**2 / 6, ROD * (LENGTH**2 + 0.01**2) / 12
SLIDER = 3000 * 0.1**3
CUBE = SLIDER * 0.1**2 / 6
# A rod with its ball: mass, distance of its centre of mass from the hinge, moment of inertia about it.
MASS = ROD + BALL
CENTRE = (ROD * LENGTH / 2 + BALL * LENGTH) / MASS
ACROSS = LONG + ROD * (CENTRE - LENGTH / 2) ** 2 + BALL * (LENGTH - CENTRE) ** 2
HEIGHT = -2 * COUPLER * np.cos(ANGLE)


def governor():
    slider = (0.0, 0.0, HEIGHT)
    bodies = [
        mb.Body("shaft", mass=ROD, inertia=(LONG, LONG, THIN), position=(0, 0, -LENGTH / 2)),
        mb.Body("slider", mass=SLIDER, inertia=(CUBE, CUBE, CUBE), position=slider),
    ]
    joints = [
        mb.Revolute(mb.GROUND, "shaft", at=(0, 0, 0), axis=(0, 0, 1)),
        mb.Prismatic("shaft", "slider", at=slider, axis=(0, 0, 1)),
    ]
    couplers = []
    for name, side in (("right", 1), ("left", -1)):
        along = np.array([side * np.sin(ANGLE), 0, -np.cos(ANGLE)])
        outer = np.outer(along, along)
        inertia = ACROSS * (np.eye(3) - outer) + THIN * outer
        bodies.append(mb.Body(name, mass=MASS, inertia=inertia, position=CENTRE * along))
        joints.append(mb.Revolute("shaft", name, at=(0, 0, 0), axis=(0, 1, 0)))
        between = (COUPLER * along, slider)
        values = dict(stiffness=STIFFNESS, damping=DAMPING, length=COUPLER)
        couplers.append(mb.Spring(name, "slider", between=between, **values))
    return mb.Assembly(bodies, joints, couplers, gravity=(0, 0, -GRAVITY))


def reduced(t, x):
    """Angle of the rods, height of the slider, rate of the shaft; rates of the first two."""
    del t
    a, z, w, da, dz = x
    s, c = np.sin(a), np.cos(a)
    about_hinge = MASS * CENTRE**2 + ACROSS
    inertia = THIN + CUBE + 2 * (about_hinge * s**2 + THIN * c**2)
    slope = 4 * (about_hinge - THIN) * s * c
    x, y = COUPLER * s, -COUPLER * c - z
    length = np.hypot(x, y)
    by_a, by_z = COUPLER * (x * c + y * s) / length, -y / length
    pull = STIFFNESS * (length - COUPLER) + DAMPING * (by_a * da + by_z * dz)
    dda = (slope * w**2 / 2 - 2 * MASS * GRAVITY * CENTRE * s - 2 * pull * by_a) / 2 / about_hinge
    ddz = -GRAVITY - 2 * pull * by_z / SLIDER
    return [da, dz, -slope * da * w / inertia, dda, ddz]


@pytest.mark.slow
def test_stiff_governor():
    assembly = governor()
    names = ("shaft", "slider", "right", "left")
    y0 = assembly.state(angular_velocities=dict.fromkeys(names, (0, 0, RATE)), assemble=True)
    ts = np.linspace(0, 1, 41)
    options = dict(method="Radau", rtol=1e-11, atol=1e-11, t_eval=ts)
    expected = solve_ivp(reduced, (0, 1), [ANGLE, HEIGHT, RATE, 0, 0], **options).y[1]
    sol = mj.diffeqsolve(
        assembly.system.terms,
        mj.Projected(mj.Rodas5P(), assembly.system.constraint),
        0.0,
        1.0,
        None,
        y0,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    )
    q, v = sol.ys
    np.testing.assert_allclose(q.position[:, 1, 2], expected, rtol=0, atol=1e-6)
    assert np.ptp(expected) > 0.02
    violation = jax.vmap(
        lambda t, q, v: mj.constraint_violation(assembly.system.constraint, t, (q, v), None)
    )
    assert violation(ts, q, v).max() < 1e-14
    assert sol.stats["num_steps"] < 1000
