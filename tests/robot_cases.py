"""A five-bar robot as a URDF file: two arms of two links in the plane of x and z, and a hinge at the end of
one of them, whose other side is welded to the end of the other.

The left elbow is a ball joint as files have it: three hinges with links
without mass between them, so that no equation of the loop depends on another.
"""

import numpy as np


BASE = 0.3  # distance of the shoulders
LENGTHS = {"left": (0.25, 0.4), "right": (0.3, 0.35)}
CENTERS = {"left": (0.1, 0.18), "right": (0.17, 0.15)}  # along the links
MASSES = {"left": (0.8, 0.5), "right": (0.6, 0.7)}
INERTIAS = {"left": (0.004, 0.006), "right": (0.005, 0.003)}  # about y
START = {"left shoulder": -0.6, "right shoulder": 0.5}  # from the vertical
CLOSURES = {
    "closed_loop": [["left tip", "right tip"]],
    "type": ["6d"],
    "name_mot": ["left shoulder", "right shoulder"],
}
DAMPING = 0.02


def link(name, mass=0.0, inertia=0.0, center=0.0):
    if mass == 0:
        return f'<link name="{name}"/>'
    body = f'<inertia ixx="{0.9 * inertia}" iyy="{inertia}" izz="{0.4 * inertia}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><origin xyz="0 0 {center}"/><mass value="{mass}"/>{body}</inertial></link>'


def joint(name, kind, parent, child, origin=(0, 0, 0), axis=(0, 1, 0), more=""):
    xyz, along = (" ".join(map(str, vector)) for vector in (origin, axis))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{along}"/>{more}</joint>'
    )


def five_bar():
    limit = '<limit lower="-2" upper="1.5" effort="0" velocity="0"/>'
    parts = [link("base", 1.0, 0.1)]
    for side, x in (("left", 0.0), ("right", BASE)):
        centers, masses, inertias = CENTERS[side], MASSES[side], INERTIAS[side]
        upper, lower = f"{side} upper", f"{side} lower"
        parts += [
            link(upper, masses[0], inertias[0], centers[0]),
            link(lower, masses[1], inertias[1], centers[1]),
            link(f"{side} tip"),
            joint(f"{side} shoulder", "revolute", "base", upper, (x, 0, 0), more=limit),
        ]
    damping = f'<dynamics damping="{DAMPING}"/>'
    elbow = (0, 0, LENGTHS["right"][0])
    parts += [
        joint("right elbow", "continuous", "right upper", "right lower", elbow, more=damping),
        link("first"),
        link("second"),
        joint("about x", "revolute", "left upper", "first", (0, 0, LENGTHS["left"][0]), (1, 0, 0)),
        joint("about y", "revolute", "first", "second", axis=(0, 1, 0)),
        joint("about z", "revolute", "second", "left lower", axis=(0, 0, 1)),
        joint("end", "fixed", "left lower", "left tip", (0, 0, LENGTHS["left"][1]), (0, 0, 0)),
        joint("tip", "revolute", "right lower", "right tip", (0, 0, LENGTHS["right"][1])),
    ]
    return "<robot name='five-bar'>" + "".join(parts) + "</robot>"


def arm(side, angles, rates):
    """Return mass matrix, `h` of `M a + h`, Jacobian of the tip and its bias, of two links that are turned
    from the vertical by the angles, in absolute angles: a textbook double pendulum, upside down."""
    (l1, l2), (c1, c2), (m1, m2), (i1, i2) = (
        values[side] for values in (LENGTHS, CENTERS, MASSES, INERTIAS)
    )
    (a, b), (u, v), g = angles, rates, 9.81
    coupling = m2 * l1 * c2
    M = np.array(
        [
            [i1 + m1 * c1**2 + m2 * l1**2, coupling * np.cos(a - b)],
            [coupling * np.cos(a - b), i2 + m2 * c2**2],
        ]
    )
    h = np.array([coupling * np.sin(a - b) * v**2, -coupling * np.sin(a - b) * u**2])
    h -= g * np.array([(m1 * c1 + m2 * l1) * np.sin(a), m2 * c2 * np.sin(b)])
    J = np.array([[l1 * np.cos(a), l2 * np.cos(b)], [-l1 * np.sin(a), -l2 * np.sin(b)]])
    bias = -np.array([l1 * np.sin(a), l1 * np.cos(a)]) * u**2
    bias -= np.array([l2 * np.sin(b), l2 * np.cos(b)]) * v**2
    return M, h, J, bias


def tip(side, angles):
    (l1, l2), x = LENGTHS[side], 0.0 if side == "left" else BASE
    a, b = angles
    return np.array([x + l1 * np.sin(a) + l2 * np.sin(b), l1 * np.cos(a) + l2 * np.cos(b)])


# A chain of bodies with joints of all kinds, turned against each other.
CHAIN_TYPES = {"joint_name": ["ball", "cardan"], "joint_type": ["SPHERICAL", "UJOINT_ZX"]}


def chain():
    turned = lambda text: text.replace("<origin xyz", '<origin rpy="0.3 -0.7 1.1" xyz')
    parts = [link("base")]
    parts += [link(name, 1.0, 0.1, 0.2) for name in ("one", "two", "three", "four", "five")]
    parts += [link("between"), link("inside")]
    parts += [
        turned(joint("slide", "prismatic", "base", "one", (0.1, 0.2, 0.3), (1, 2, 0))),
        turned(joint("across first", "revolute", "one", "between", (0.3, 0, 0.1), (0, 0, 1))),
        joint("across second", "revolute", "between", "two", axis=(1, 1, 0)),
        turned(joint("turn", "continuous", "two", "inside", (0, 0.4, 0), (0, 1, 0))),
        joint("push", "prismatic", "inside", "three", axis=(0, 1, 0)),
        turned(joint("ball", "revolute", "three", "four", (0, 0, 0.5))),
        turned(joint("cardan", "revolute", "four", "five", (0.2, 0, 0.2))),
    ]
    return "<robot name='chain'>" + "".join(parts) + "</robot>"
