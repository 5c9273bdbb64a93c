"""A five-bar robot with a load, as bodies and joints, and its poses.

The numbers are those of the robot in R. Bordalba's repository collocation_constrained_systems (Scherbot2.m, and for the
largest torque run_fivebars_statistics.m): two arms of two links from two motors to one joint with a load, in a vertical
plane.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


mb = mj.multibody
BASE, PROXIMAL, DISTAL = 0.12, 0.2, 0.15  # m
CENTERS = 0.11, 0.0746  # m from the inner joints
MASSES = 1.2093, 0.8925  # kg
INERTIAS = 7e-3, 2.3e-3  # kg m^2 about the centers
LOAD, RADIUS = 0.5, 0.06  # kg, m: a ball at the end of the left distal link
FRICTION = 0.0176  # N m s of each motor
GRAVITY = 9.81
MOST = 1.4  # N m
MOTORS = "left motor", "right motor"


class Link(NamedTuple):
    mass: float
    center: float
    inertia: float


def links() -> tuple[Link, ...]:
    """Return the links from the left motor to the right one, the load being part of the second."""
    proximal = Link(MASSES[0], CENTERS[0], INERTIAS[0])
    distal = Link(MASSES[1], CENTERS[1], INERTIAS[1])
    mass = distal.mass + LOAD
    center = (distal.mass * distal.center + LOAD * DISTAL) / mass
    inertia = distal.inertia + 0.4 * LOAD * RADIUS**2
    inertia += distal.mass * (distal.center - center) ** 2 + LOAD * (DISTAL - center) ** 2
    return proximal, Link(mass, center, inertia), distal, proximal


def angles(tool: Any) -> np.ndarray:
    """Return the angles of the links from the horizontal, each seen from its inner joint, with the elbows
    outwards."""
    found = []
    for base, side in ((np.zeros(2), -1), (np.array([BASE, 0.0]), 1)):
        to_tool = np.asarray(tool) - base
        far = np.hypot(*to_tool)
        bend = np.arccos((PROXIMAL**2 + far**2 - DISTAL**2) / (2 * PROXIMAL * far))
        first = np.arctan2(to_tool[1], to_tool[0]) + side * bend
        rest = np.asarray(tool) - base - PROXIMAL * np.array([np.cos(first), np.sin(first)])
        found.append((first, np.arctan2(rest[1], rest[0])))
    (a, b), (d, c) = found
    return np.array([a, b, c, d])


def along(angle: Any) -> Any:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def centers(theta: np.ndarray) -> np.ndarray:
    """Return the centers of the links, shape `(4, 2)`, from angles `(4,)`."""
    left, right = PROXIMAL * along(theta[0]), np.array([BASE, 0]) + PROXIMAL * along(theta[3])
    starts = np.stack([np.zeros(2), left, right, np.array([BASE, 0])])
    return starts + np.array([link.center for link in links()])[:, None] * along(theta)


def assembly(theta: np.ndarray, law: Any) -> mb.Assembly:
    """Return the robot drawn with these angles; `law(t, y, args)` are the torques of the motors."""
    at, names = centers(theta), ("left arm", "left rod", "right rod", "right arm")
    bodies = [
        mb.Body(name, mass=link.mass, inertia=link.inertia, position=tuple(place))
        for name, link, place in zip(names, links(), at, strict=True)
    ]
    left, right = PROXIMAL * along(theta[0]), np.array([BASE, 0]) + PROXIMAL * along(theta[3])
    joints = [
        mb.Revolute(mb.GROUND, "left arm", at=(0.0, 0.0), name=MOTORS[0]),
        mb.Revolute("left arm", "left rod", at=tuple(left)),
        mb.Revolute(
            "left rod", "right rod", at=tuple(left + DISTAL * along(theta[1])), name="tool"
        ),
        mb.Revolute("right arm", "right rod", at=tuple(right)),
        mb.Revolute(mb.GROUND, "right arm", at=(BASE, 0.0), name=MOTORS[1]),
    ]
    forces: list[Any] = [mb.JointSpring(motor, damping=FRICTION) for motor in MOTORS]
    return mb.Assembly(
        bodies, joints, [*forces, mb.Controller(MOTORS, law)], gravity=(0.0, -GRAVITY)
    )


def states(plant: mb.Assembly, drawn: np.ndarray, thetas: np.ndarray, ts: np.ndarray) -> Any:
    """Return the states along a path of angles `(K, 4)`, at rest at both ends."""
    places = np.concatenate(
        [np.stack([centers(theta) for theta in thetas]), (thetas - drawn)[:, :, None]], axis=2
    )
    rates = np.gradient(places, ts, axis=0)
    rates[[0, -1]] = 0
    pose = type(plant.state()[0])
    as_pose = lambda x: pose(jnp.asarray(x[:, :, :2]), jnp.asarray(x[:, :, 2]))
    return as_pose(places), as_pose(rates)
