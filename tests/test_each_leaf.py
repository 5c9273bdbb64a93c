"""The derivative of the equations of motion by each leaf of what they depend on *alone*: what takes
part in a derivative rule differs with what is differentiated."""

import itertools

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax import multibody as mb


LARGE = {
    "chain of 9": lambda: mj.problems.chain(9),
    "delta robot": mj.problems.delta_robot,
    "cable net": lambda: mj.problems.cable_net(3, 4),
    "falling truss": lambda: mj.problems.falling_truss(4),
    "n four-bars": lambda: mj.problems.n_four_bar(4),
    "polymer": lambda: mj.problems.polymer(12),
}
SLOW = ["delta robot", "cable net", "falling truss", "n four-bars"]


def total(tree):
    x, _ = jfu.ravel_pytree(tree)
    return x @ jnp.cos(jnp.arange(1.0, x.size + 1))


def check(f, *parts, order=1):
    """`f` by each leaf of `parts` alone, along one direction, backwards and forwards."""
    leaves, structure = jax.tree.flatten(jax.tree.map(lambda x: jnp.asarray(x, float), parts))
    directions = [jnp.sin(1.0 + jnp.arange(x.size, dtype=float)).reshape(x.shape) for x in leaves]
    at = lambda i, x, f=f: f(*structure.unflatten([*leaves[:i], x, *leaves[i + 1 :]]))

    def derivatives(leaves):
        found = []
        for i, (x, along) in enumerate(zip(leaves, directions)):
            reverse = jnp.vdot(jax.grad(lambda x, i=i: at(i, x))(x), along)
            _, forward = jax.jvp(lambda x, i=i: at(i, x), (x,), (along,))
            found.append((reverse, forward))
        return found

    value = jax.jit(f)
    for i, (reverse, forward) in enumerate(jax.jit(derivatives)(leaves)):
        size = 1e-4 * max(1.0, float(jnp.max(jnp.abs(leaves[i]))))
        slope, level = difference(lambda x, i=i: at(i, x, value), leaves[i], directions[i], size)
        noise = 1e-12 * max(1.0, level) / size
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=noise)
        np.testing.assert_allclose(forward, slope, rtol=1e-6, atol=10 * noise)


def difference(f, x, along, h):
    """Of fourth order, and the size of the values."""
    moved = lambda k: f(x + k * h * along)
    slope = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
    return slope, abs(float(moved(0)))


def check_problem(problem):
    field = lambda t, y, args: total(problem.terms.vf(t, y, args))
    if problem.system is not None and problem.system.redundant:
        # Off the manifold equations that depend on each other contradict each other.
        return check(lambda args: field(0.1, problem.y0, args), problem.args)
    aside = lambda x: x + 0.01 * jnp.cos(jnp.arange(x.size)).reshape(x.shape)
    return check(field, jnp.asarray(0.1), jax.tree.map(aside, problem.y0), problem.args)


@pytest.mark.parametrize("name", mj.problems.ALL)
def test_gallery(name):
    check_problem(mj.problems.ALL[name]())


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in LARGE]
)
def test_large(name):
    check_problem(LARGE[name]())


def chain_of_bodies(args, count):
    """Hinged to each other and to the ground, with forces of every kind."""
    names = [f"body {i}" for i in range(count)]
    half = jnp.stack([args["length"] / 2, 0 * args["length"]])
    bodies = [mb.Body(name, args["mass"], args["inertia"]) for name in names]
    origin = jnp.zeros(2)
    joints = [mb.Revolute(names[0], mb.GROUND, points=(-half, origin), name="axle")]
    joints += [mb.Revolute(a, b, points=(half, -half)) for a, b in itertools.pairwise(names)]
    spring = args["stiffness"], args["spring_length"], args["damping"]
    forces = [
        mb.Spring(names[0], names[-1], *spring, points=(half, half)),
        mb.Force(names[-1], args["push"], point=half),
        mb.Motor("axle", args["torque"]),
    ]
    down = jnp.stack([0 * args["gravity"], -args["gravity"]])
    return mb.Assembly(bodies, joints, forces, gravity=down)


BODIES = dict(length=1.1, mass=1.3, inertia=0.2, stiffness=3.0, spring_length=0.7, damping=0.4)
BODIES |= dict(push=jnp.array([0.3, 0.2]), torque=0.8, gravity=9.81)


@pytest.mark.parametrize("count", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_bodies(count):
    """Four equations and ten: dense systems of more than eight are solved in another way."""
    angles = jnp.linspace(0.3, 1.2, count)
    directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    ends = jnp.cumsum(directions * BODIES["length"], axis=0)
    centres = ends - directions * BODIES["length"] / 2
    robot = chain_of_bodies(BODIES, count)
    by_name = lambda x: dict(zip(robot.names, np.asarray(x)))
    y = robot.state(by_name(centres), by_name(angles))
    q, v = jax.tree.map(jnp.asarray, y)
    v = jax.tree.map(lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), v)

    def motion(q, v, args):
        system = chain_of_bodies(args, count).system
        a, forces = system.accelerations(0.0, (q, v), None), system.multipliers(0.0, (q, v), None)
        return total((a, forces))

    check(motion, q, v, BODIES)
