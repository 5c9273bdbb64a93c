"""Linearizations on the tangent space, and feedback with gains from them."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import manifold_jax as mj


mb = mj.multibody


def double_pendulum(args):
    """Hanging at rest, in Cartesian coordinates; `args` are masses, lengths and gravity."""

    def rods(t, q, args):
        _, lengths, _ = args
        first, second = q[:2], q[2:] - q[:2]
        return jnp.stack([first @ first, second @ second]) - lengths**2

    weight = lambda t, q, v, args: jnp.repeat(args[0], 2) * jnp.array([0.0, -1, 0, -1]) * args[2]
    system = mj.MechanicalSystem(lambda q, args: jnp.repeat(args[0], 2), rods, weight)
    l1, l2 = args[1]
    return system, (jnp.stack([0 * l1, -l1, 0 * l1, -l1 - l2]), jnp.zeros(4))


@jax.jit
def fastest(args):
    system, y = double_pendulum(args)
    return mj.linearize(system.terms, system.constraint, 0.0, y, args).eigenvalues()[-1].imag


ARGS = jnp.array([1.0, 2.0]), jnp.array([0.7, 1.1]), jnp.array(9.81)


def test_frequencies_of_a_double_pendulum_and_their_gradient():
    """Those of the textbook in angles: four eigenvalues, without zeros of the eight coordinates."""
    (m1, m2), (l1, l2), g = jax.tree.map(np.asarray, ARGS)
    M = np.array([[(m1 + m2) * l1**2, m2 * l1 * l2], [m2 * l1 * l2, m2 * l2**2]])
    K = g * np.diag([(m1 + m2) * l1, m2 * l2])
    squares = scipy.linalg.eigh(K, M, eigvals_only=True)
    system, y = double_pendulum(ARGS)
    near = mj.linearize(system.terms, system.constraint, 0.0, y, ARGS)
    values = near.eigenvalues()
    expected = np.sort(np.concatenate([np.sqrt(squares), -np.sqrt(squares)]))
    np.testing.assert_allclose(values.imag, expected, rtol=1e-13)
    np.testing.assert_allclose(values.real, 0, atol=1e-12)
    np.testing.assert_allclose(near.coordinates(y), 0, atol=1e-15)
    gradient, h = jax.jit(jax.grad(fastest))(ARGS), 1e-3
    for k, part in enumerate(ARGS):
        along = part * jnp.linspace(1.0, 0.4, part.size).reshape(part.shape)
        f = lambda s, k=k, to=along: fastest((*ARGS[:k], ARGS[k] + s * to, *ARGS[k + 1 :]))
        slope = (8 * (f(h) - f(-h)) - f(2 * h) + f(-2 * h)) / (12 * h)
        assert float(jnp.sum(gradient[k] * along)) == pytest.approx(float(slope), rel=1e-9)


def cart_and_pole(law):
    """A pole of 0.3 kg and 0.5 m on a cart of 1 kg, upright."""
    bodies = [
        mb.Body("cart", 1.0, 1.0),
        mb.Body("pole", 0.3, 0.3 * 0.5**2 / 12, position=(0.0, 0.25)),
    ]
    joints = [
        mb.Prismatic(mb.GROUND, "cart", at=(0.0, 0.0), axis=(1.0, 0.0), name="rail"),
        mb.Revolute("cart", "pole", at=(0.0, 0.0), name="hinge"),
    ]
    return mb.Assembly(bodies, joints, [mb.Controller(("rail",), law)], gravity=(0.0, -9.81))


def linearized(assembly, args):
    system = assembly.system
    return mj.linearize(system.terms, system.constraint, 0.0, assembly.state(), args)


def test_a_regulator_holds_a_pole():
    free = cart_and_pole(lambda t, y, args: args)
    near = linearized(free, jnp.zeros(1))
    # (M + m) m g c / ((M + m) (I + m c^2) - m^2 c^2), c half of the length
    growth = np.sqrt(1.3 * 0.3 * 9.81 * 0.25 / (1.3 * 0.3 * 0.25 / 3 - 0.075**2))
    assert float(jnp.max(near.eigenvalues().real)) == pytest.approx(growth, rel=1e-12)
    A, B = near.matrix, near.by_args
    gains = B.T @ scipy.linalg.solve_continuous_are(A, B, np.eye(4), np.eye(1))
    held = cart_and_pole(lambda t, y, args: -gains @ near.coordinates(y))
    found = np.sort_complex(linearized(held, None).eigenvalues())
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(A - B @ gains)), rtol=1e-9)


@pytest.mark.parametrize("constraint", [None, mj.Constraint(lambda t, y, args: jnp.zeros(0))])
def test_without_a_constraint(constraint):
    """The pole in the coordinates of its joints, a tree: those of the textbook."""
    joints = mb.JointCoordinates(cart_and_pole(lambda t, y, args: args))
    near = mj.linearize(joints.terms, constraint, 0.0, joints.state(), jnp.zeros(1))
    M = np.array([[1.3, -0.075], [-0.075, 0.3 * 0.25 / 3]])
    fall = np.linalg.solve(M, np.diag([0, 9.81 * 0.075]))
    push = np.linalg.solve(M, [[1.0], [0.0]])
    nothing = np.zeros((2, 2))
    np.testing.assert_allclose(near.basis, np.eye(4))
    np.testing.assert_allclose(
        near.matrix, np.block([[nothing, np.eye(2)], [fall, nothing]]), atol=1e-12
    )
    np.testing.assert_allclose(near.by_args, np.vstack([0 * push, push]), atol=1e-13)


def test_controllers_are_checked():
    two = cart_and_pole(lambda t, y, args: jnp.zeros(2))
    with pytest.raises(ValueError, match=r"one value for each of its joints, shape \(1,\)"):
        two.system.accelerations(0.0, two.state(), None)
    with pytest.raises(TypeError, match=r"callable `f\(t, y, args\)`"):
        cart_and_pole(lambda t, args: args)
    bodies = [mb.Body("a", 1.0, 1.0), mb.Body("b", 1.0, 1.0)]
    welded = [mb.Fixed("a", "b", at=(0.0, 0.0), name="weld")]
    with pytest.raises(ValueError, match="'weld' is a Fixed.*Controllers belong to"):
        mb.Assembly(bodies, welded, [mb.Controller(("weld",), lambda t, y, args: 0)])
    with pytest.raises(ValueError, match="at least one hinge or slider"):
        mb.Assembly(bodies, welded, [mb.Controller((), lambda t, y, args: 0)])


def test_equations_that_depend_on_each_other():
    """On a circle that is described twice."""
    turning = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
    twice = lambda t, y, args: jnp.stack([y @ y - 1, 2 * (y @ y) - 2])
    y = jnp.array([0.6, 0.8])
    with pytest.raises(ValueError, match="1 of the 2 equations depend on others in `y`"):
        mj.linearize(turning, mj.Constraint(twice), 0.0, y)
    assert np.isnan(
        eqx.filter_jit(mj.linearize)(turning, mj.Constraint(twice), 0.0, y).matrix
    ).all()
    known = mj.Constraint(twice, redundant=True)
    # Neighbours on the circle stay as far away as they are.
    np.testing.assert_allclose(mj.linearize(turning, known, 0.0, y).matrix, [[0.0]], atol=1e-15)
    with pytest.raises(ValueError, match="outside of `jit`"):
        eqx.filter_jit(mj.linearize)(turning, known, 0.0, y)
