"""Mechanisms of the gallery put together from bodies and joints, and one in natural coordinates."""

import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


mb = mj.multibody
BARS = ("crank", "coupler", "rocker")


def four_bar(args, closed=True):
    """Rods with their centres of mass in the middle; points are told in the frames of the bodies."""
    h = args.lengths / 2
    zero = jnp.zeros_like(h[0])
    along = lambda x: jnp.stack([x, zero])
    bodies = [
        mb.Body(name, args.masses[i], args.masses[i] * args.lengths[i] ** 2 / 12)
        for i, name in enumerate(BARS)
    ]
    joints = [
        mb.Revolute("crank", mb.GROUND, points=(along(-h[0]), along(zero))),
        mb.Revolute("crank", "coupler", points=(along(h[0]), along(-h[1]))),
        mb.Revolute("coupler", "rocker", points=(along(h[1]), along(h[2]))),
    ]
    if closed:
        pivot = along(args.lengths[3])
        joints.append(mb.Revolute("rocker", mb.GROUND, points=(along(-h[2]), pivot), name="pivot"))
    return mb.Assembly(bodies, joints, gravity=jnp.stack([zero, -args.gravity]))


def four_bar_state(robot, y):
    """That of the gallery's coordinates (x, y, angle of each body)."""
    q, v = (np.asarray(part).reshape(3, 3) for part in y)
    by_name = lambda rows: dict(zip(BARS, rows, strict=True))
    return robot.state(*(by_name(rows) for rows in (q[:, :2], q[:, 2], v[:, :2], v[:, 2])))


def four_bar_in_space(args, y, more=(), **options):
    """The same in the x-z plane of space, with the pose of `y` as the drawing, and `more` joints."""
    q = np.asarray(y[0]).reshape(3, 3)
    lengths, masses = np.asarray(args.lengths), np.asarray(args.masses)
    halves = np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], axis=1) * lengths[:3, None] / 2
    in_space = lambda p: np.array([p[0], 0.0, p[1]])
    axis = (0.0, -1.0, 0.0)
    bodies = [
        mb.Body(
            name,
            masses[i],
            masses[i] * lengths[i] ** 2 / 12 * np.array([0.02, 1.0, 1.0]),
            position=in_space(q[i, :2]),
            orientation=mb.quaternion(axis, q[i, 2]),
        )
        for i, name in enumerate(BARS)
    ]
    pairs = (("crank", mb.GROUND), ("crank", "coupler"), ("coupler", "rocker"))
    points = [q[0, :2] - halves[0], q[0, :2] + halves[0], q[1, :2] + halves[1]]
    pairs, points = (*pairs, ("rocker", mb.GROUND)), [*points, q[2, :2] - halves[2]]
    joints = [mb.Revolute(*pair, at=in_space(p), axis=axis) for pair, p in zip(pairs, points)]
    gravity = (0.0, 0.0, -float(args.gravity))
    return mb.Assembly(bodies, [*joints, *more], gravity=gravity, **options)


def slider_crank(args):
    """The mass of the slider is shared by rod and slider; the rod's frame is at the pin."""
    zero, one = jnp.zeros_like(args.push), jnp.ones_like(args.push)
    origin, pin = jnp.zeros(2), jnp.stack([one, zero])
    end = jnp.stack([args.crank_length, zero])
    bodies = [
        mb.Body("crank", 0.7, args.crank_inertia),
        mb.Body("rod", 0.25 * args.slider_mass, args.rod_inertia),
        mb.Body("slider", 0.75 * args.slider_mass, 1.0),
    ]
    joints = [
        mb.Revolute("crank", mb.GROUND, points=(origin, origin)),
        mb.Revolute("crank", "rod", points=(end, -pin)),
        mb.Revolute("rod", "slider", points=(origin, origin)),
        mb.Prismatic(mb.GROUND, "slider", points=(origin, origin), axis=(1.0, 0.0)),
    ]
    spring = mb.Spring(
        "crank",
        "rod",
        args.stiffness,
        args.spring_length,
        args.damping,
        points=(end / 2, -pin / 2),
    )
    push = mb.Force("rod", jnp.stack([args.push, zero]), point=(1.0, 0.0))
    return mb.Assembly(bodies, joints, [spring, push])


# Bricard's mechanism of the IFToMM benchmark: five rods along the edges of a cube, each 1 m and
# 1 kg, six hinges. Moments of inertia (along, across, across) of thick rods: of thin ones the natural
# coordinates have equations of such different strengths that some count as dependent.
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float
)
AXES = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=float)
MOMENTS = np.array([0.08, 1 / 12, 1 / 12])
RODS = tuple(f"rod {i}" for i in range(1, 6))


def rod_frames():
    """Middles and rotation matrices, the first axis along the rod."""
    along = np.diff(CORNERS, axis=0)
    others = np.roll(np.abs(along), 1, axis=1)
    return (CORNERS[1:] + CORNERS[:-1]) / 2, np.stack(
        [along, others, np.cross(along, others)], axis=2
    )


def bricard():
    middles, _ = rod_frames()
    whole = (mb.GROUND, *RODS, mb.GROUND)
    matrices = [R @ np.diag(MOMENTS) @ R.T for R in rod_frames()[1]]
    bodies = [
        mb.Body(name, 1.0, moments, position=x) for name, moments, x in zip(RODS, matrices, middles)
    ]
    joints = [mb.Revolute(whole[i], whole[i + 1], at=CORNERS[i], axis=AXES[i]) for i in range(6)]
    return mb.Assembly(bodies, joints, gravity=(0.0, -9.81, 0.0), redundant=True)


def bricard_in_natural_coordinates():
    """Middles and the three unit vectors of each rod; the mass matrix is constant and diagonal.

    Source: Garcia de Jalon & Bayo, Kinematic and Dynamic Simulation of Multibody Systems (1994).
    """
    middles, frames = rod_frames()
    spread = (MOMENTS.sum() - 2 * MOMENTS) / 2
    mass = {"x": jnp.ones((5, 3)), "R": jnp.broadcast_to(jnp.asarray(spread)[:, None], (5, 3, 3))}
    ends = [np.einsum("kji,kj->ki", frames, CORNERS[i : 5 + i] - middles) for i in (0, 1)]
    axes = [np.einsum("kji,kj->ki", frames, AXES[i : 5 + i]) for i in (0, 1)]

    def joints(t, q, args):
        turn = lambda s: jnp.einsum("kij,kj->ki", jnp.swapaxes(q["R"], 1, 2), jnp.asarray(s))
        first, last = (q["x"] + turn(s) for s in ends)
        axis_first, axis_last = turn(axes[0]), turn(axes[1])
        ground = jnp.asarray(CORNERS[[0, 5]]), jnp.asarray(AXES[[0, 5]])
        products = jnp.einsum("kij,klj->kil", q["R"], q["R"]) - jnp.eye(3)[None]
        return (
            products[:, jnp.triu_indices(3)[0], jnp.triu_indices(3)[1]] / 2,
            jnp.concatenate([first, ground[0][1:]]) - jnp.concatenate([ground[0][:1], last]),
            jnp.concatenate([axis_first, ground[1][1:]])
            - jnp.concatenate([ground[1][:1], axis_last]),
        )

    weight = jnp.asarray([[0.0, -9.81, 0.0]])
    force = lambda t, q, v, args: {"x": weight + jnp.zeros_like(q["x"]), "R": 0 * q["R"]}
    # rows of q["R"] are the unit vectors
    q0 = {"x": jnp.asarray(middles), "R": jnp.asarray(np.swapaxes(frames, 1, 2))}
    y0 = q0, jax.tree.map(jnp.zeros_like, q0)
    return mj.MechanicalSystem(mass, joints, force, redundant=True), y0
