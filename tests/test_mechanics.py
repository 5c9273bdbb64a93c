"""Constrained mechanics: accelerations, multipliers, corrections, against NumPy written anew."""

from fractions import Fraction

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


GRAVITY = 9.81
TIGHT = dfx.PIDController(rtol=1e-10, atol=1e-10)


def two_rods(t, q, args):
    """A double pendulum of unit lengths; `q` of shape (2, 2)."""
    return {"first": q[0] @ q[0] - 1, "second": (q[1] - q[0]) @ (q[1] - q[0]) - 1}


def weight(t, q, v, args):
    return jnp.stack([jnp.zeros(2), -GRAVITY * jnp.ones(2)], axis=1) + 0.1 * t * v


def mass_matrix(q, args):
    """Symmetric, positive definite, full, and dependent on the configuration."""
    x = jnp.ravel(q)
    return jnp.diag(jnp.array([1.0, 2.0, 3.0, 4.0])) + 0.3 * jnp.outer(x, x)


STATE = (
    jnp.array([[0.6, -0.8], [1.4, -1.4]]),
    jnp.array([[0.8, 0.6], [0.2, -0.2]]),
)


def dense_solution(M, q, v, t):
    """`[[M, J^T], [J, 0]] [a, lambda] = [Q, -dJ/dt v]`, for the double pendulum above."""
    d, dv = q[1] - q[0], v[1] - v[0]
    J = 2 * np.array([[*q[0], 0, 0], [*-d, *d]])
    bias = 2 * np.array([v[0] @ v[0], dv @ dv])
    Q = np.ravel(np.stack([np.zeros(2), -GRAVITY * np.ones(2)], axis=1) + 0.1 * t * v)
    K = np.block([[M, J.T], [J, np.zeros((2, 2))]])
    solution = np.linalg.solve(K, np.concatenate([Q, -bias]))
    return solution[:4].reshape(2, 2), solution[4:]


@eqx.filter_jit
def motion(system, t, y, args=None):
    """Accelerations, multipliers and the vector field, compiled at once."""
    return (
        system.accelerations(t, y, args),
        system.multipliers(t, y, args),
        system.terms.vf(t, y, args),
    )


@pytest.mark.parametrize(
    ("mass", "matrix"),
    [
        (1.7, lambda q: 1.7 * np.eye(4)),
        (jnp.array([1.0, 1.0, 2.0, 2.0]), lambda q: np.diag([1.0, 1.0, 2.0, 2.0])),
        (jnp.array([[1.0, 1.0], [2.0, 2.0]]), lambda q: np.diag([1.0, 1.0, 2.0, 2.0])),
        (mass_matrix, lambda q: np.asarray(mass_matrix(q, None))),
    ],
    ids=["scalar", "diagonal", "like q", "matrix"],
)
def test_accelerations_and_multipliers_solve_the_dense_system(mass, matrix):
    """`M a + J^T lambda = Q` with the constraint differentiated twice, of which the library
    eliminates `a`."""
    system = mj.MechanicalSystem(mass, two_rods, weight)
    q, v = map(np.asarray, STATE)
    a, multipliers = dense_solution(matrix(q), q, v, 0.7)
    found_a, found_multipliers, field = motion(system, 0.7, STATE)
    np.testing.assert_allclose(found_a, a, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found_multipliers, multipliers, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(field[0], STATE[1])
    np.testing.assert_allclose(field[1], a, rtol=1e-13, atol=1e-13)


@pytest.mark.usefixtures("as_a_user_meets_it")
def test_masses_that_could_be_of_bodies_or_of_coordinates():
    """Masses (m1, m2) and q of shape (2, 2): they were spread over the columns of q."""
    for masses in (jnp.ones(2), jnp.ones((2, 1)), jnp.ones((1, 2))):
        for mass in (masses, lambda q, args, masses=masses: masses):
            with pytest.raises(ValueError, match=r"`mass_matrix`.*masses\[:, None\], q.shape"):
                mj.MechanicalSystem(mass, two_rods, weight).accelerations(0.7, STATE)
    q, v = STATE
    pair = ({"a": q[0], "b": q[1]}, {"a": v[0], "b": v[1]})
    rods = lambda t, q, args: two_rods(t, jnp.stack([q["a"], q["b"]]), args)
    force = lambda t, q, v, args: q
    for b, fits in ((2.0, True), (jnp.ones(2), True), (jnp.ones(1), False)):
        system = mj.MechanicalSystem({"a": 1.0, "b": b}, rods, force)
        if fits:
            system.accelerations(0.7, pair)
        else:
            with pytest.raises(ValueError, match=r"`mass_matrix`.*'b': \(1,\)"):
                system.accelerations(0.7, pair)


def exact_solution(A, b):
    """By elimination in rational numbers."""
    rows = [[Fraction(x) for x in (*row, c)] for row, c in zip(A.tolist(), b.tolist())]
    for k in range(len(rows)):
        pivot = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(len(rows)):
            if i != k:
                factor = rows[i][k] / rows[k][k]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k])]
    return np.array([float(row[-1] / row[k]) for k, row in enumerate(rows)])


def test_light_bodies_beside_heavy_ones():
    """In a full mass matrix they keep their digits: 1e-12 of the mass costs 1e-11, the condition of
    the Schur complement, not 1e-5."""
    masses = np.array([1.0, 1e-12, 1e-12, 1.0])
    M = np.sqrt(np.outer(masses, masses)) * (np.eye(4) + 0.1)
    C, force = np.array([[1.0, 1.0, 1.0, 0.5]]), masses * [0.3, 0.7, -0.2, 1.0]
    system = mj.MechanicalSystem(
        jnp.asarray(M), lambda t, q, args: jnp.asarray(C) @ q, lambda *_: jnp.asarray(force)
    )
    _, acceleration = system.terms.vf(0.0, (jnp.zeros(4), jnp.zeros(4)), None)
    A = np.block([[M, C.T], [C, np.zeros((1, 1))]])
    expected = exact_solution(A, np.append(force, 0.0))[:4]
    np.testing.assert_allclose(acceleration, expected, rtol=1e-9)


def test_singular_mass_matrix_with_regular_system():
    """Only motions across the rods have no mass."""
    q, v = map(np.asarray, STATE)
    d = q[1] - q[0]
    along = np.array([[-q[0][1], q[0][0], 0, 0], [-d[1], d[0], -d[1], d[0]]])
    M = along.T @ np.diag([2.0, 3.0]) @ along
    assert np.linalg.matrix_rank(M) == 2
    system = mj.MechanicalSystem(jnp.asarray(M), two_rods, weight)
    a, multipliers = dense_solution(M, q, v, 0.7)
    found_a, found_multipliers, _ = motion(system, 0.7, STATE)
    np.testing.assert_allclose(found_a, a, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found_multipliers, multipliers, rtol=1e-11, atol=1e-11)


def test_large_systems_use_the_library_and_agree():
    """Twelve points on rods: n = 24, m = 12, beyond the limit of unrolled arithmetic."""

    def rods(t, q, args):
        d = jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2)))
        return jnp.sum(d * d, axis=1) - 1

    angles = np.linspace(0.3, 1.9, 12)
    d = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    q = np.cumsum(d, axis=0)
    v = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0)
    M = np.diag(np.linspace(1, 2, 24)) + 0.01
    force = lambda t, q, v, args: -q
    dv = np.diff(v, axis=0, prepend=np.zeros((1, 2)))
    J = np.zeros((12, 12, 2))
    for i in range(12):
        J[i, i] = 2 * d[i]
        if i > 0:
            J[i, i - 1] = -2 * d[i]
    J = J.reshape(12, 24)
    K = np.block([[M, J.T], [J, np.zeros((12, 12))]])
    expected = np.linalg.solve(K, np.concatenate([-q.ravel(), -2 * (dv * dv).sum(1)]))
    system = mj.MechanicalSystem(jnp.asarray(M), rods, force)
    y = jnp.asarray(q), jnp.asarray(v)
    a, multipliers, _ = motion(system, 0.0, y)
    np.testing.assert_allclose(np.ravel(a), expected[:24], rtol=1e-10)
    np.testing.assert_allclose(multipliers, expected[24:], rtol=1e-10)
    off = (y[0] + 1e-4 * jnp.cos(y[0]), y[1])
    corrected, info = mj.project(system.constraint, 0.0, off)
    assert info.success
    assert max(np.abs(r).max() for r in system.constraint(0.0, corrected)) <= 1e-13


def test_velocity_correction_is_orthogonal_in_the_metric_of_the_masses():
    """J v = 0, and the kinetic energy is not increased."""
    system = mj.MechanicalSystem(mass_matrix, two_rods, weight)
    q, _ = STATE
    v = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2)))
    (q1, v1), info = mj.project(system.constraint, 0.0, (q, v))
    assert info.success
    M = np.asarray(mass_matrix(q, None))
    d = np.asarray(q[1] - q[0])
    J = 2 * np.array([[*q[0], 0, 0], [*-d, *d]])
    w, w1 = np.ravel(v), np.ravel(v1)
    np.testing.assert_allclose(q1, q, atol=1e-15)
    assert np.abs(J @ w1).max() <= 1e-14
    energy = lambda w: w @ M @ w / 2
    assert energy(w1) < energy(w)
    assert abs(w1 @ M @ (w - w1)) <= 1e-13
    # (w - w1) = M^-1 J^T z: the rest after fitting z
    directions = np.linalg.solve(M, J.T)
    z = np.linalg.lstsq(directions, w - w1, rcond=None)[0]
    assert np.abs(directions @ z - (w - w1)).max() <= 1e-13


def test_slightly_inconsistent_start_is_corrected_and_reported():
    system = mj.MechanicalSystem(mass_matrix, two_rods, weight)
    q, v = STATE
    d = q[1] - q[0]
    wrong = v + 1e-8 * jnp.stack([q[0], d])
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Heun(), system.constraint),
        0.0,
        0.1,
        0.1,
        (q, wrong),
        saveat=dfx.SaveAt(t0=True),
        max_steps=4,
    )
    w1, w = np.ravel(sol.ys[1][0]), np.ravel(wrong)
    J = 2 * np.array([[*q[0], 0, 0], [*-d, *d]])
    directions = np.linalg.solve(np.asarray(mass_matrix(q, None)), J.T)
    z = np.linalg.lstsq(directions, w - w1, rcond=None)[0]
    assert np.abs(directions @ z - (w - w1)).max() <= 1e-15
    assert np.abs(J @ w1).max() <= 1e-15
    change = np.max(np.abs(w1 - w) / (np.abs(w) + 1))
    np.testing.assert_allclose(sol.stats["initial_correction"], change, rtol=1e-6)
    assert 1e-9 < change < 2e-8


def test_lagrangian():
    """A pendulum in polar coordinates on a rod of prescribed length, with everything that makes
    the equations of motion interesting: masses that depend on position and on time."""

    def lagrangian(t, q, v, args):
        mass = 1 + 0.1 * jnp.sin(t)
        kinetic = mass / 2 * (v["r"] ** 2 + (q["r"] * v["angle"]) ** 2)
        return kinetic + mass * GRAVITY * q["r"] * jnp.cos(q["angle"])

    length = lambda t: 1 + 0.2 * jnp.cos(t)
    drag = lambda t, q, v, args: {"r": 0.0 * v["r"], "angle": -args * v["angle"]}
    rod = lambda t, q, args: q["r"] - length(t)
    system = mj.MechanicalSystem.from_lagrangian(lagrangian, rod, drag)
    t, c = 0.4, 0.3
    r, dr, ddr = 1 + 0.2 * np.cos(t), -0.2 * np.sin(t), -0.2 * np.cos(t)
    m, dm = 1 + 0.1 * np.sin(t), 0.1 * np.cos(t)
    angle, rate = 0.7, -0.5
    # d/dt (m r^2 rate) + m g r sin(angle) = -c rate
    turning = (
        -c * rate - m * GRAVITY * r * np.sin(angle) - (dm * r**2 + 2 * m * r * dr) * rate
    ) / (m * r**2)
    # d/dt (m r') - m r rate^2 - m g cos(angle) + lambda = 0
    tension = m * r * rate**2 + m * GRAVITY * np.cos(angle) - m * ddr - dm * dr
    y = (
        {"r": jnp.asarray(r), "angle": jnp.asarray(angle)},
        {"r": jnp.asarray(dr), "angle": jnp.asarray(rate)},
    )
    a, multipliers, _ = motion(system, t, y, c)
    np.testing.assert_allclose([a["r"], a["angle"]], [ddr, turning], rtol=1e-13)
    np.testing.assert_allclose(multipliers, [tension], rtol=1e-13)


def test_nonholonomic_constraint():
    """A skate on an incline: `v` along the blade; multipliers ordered as documented."""

    def blade(t, q, v, args):
        return jnp.sin(q["turn"]) * v["p"][0] - jnp.cos(q["turn"]) * v["p"][1]

    # The turn is prescribed by a rheonomic holonomic constraint.
    turning = lambda t, q, args: q["turn"] - 0.5 * t
    force = lambda t, q, v, args: {"p": jnp.array([1.5, 0.0]), "turn": jnp.zeros(())}
    system = mj.MechanicalSystem(1.0, turning, force, velocity_constraint=blade)
    y0 = (
        {"p": jnp.zeros(2), "turn": jnp.zeros(())},
        {"p": jnp.array([0.3, 0.0]), "turn": jnp.asarray(0.5)},
    )
    ts = jnp.linspace(0.0, 5.0, 21)
    for hook in (mj.Projected, mj.LocalCoordinates):
        sol = mj.diffeqsolve(
            system.terms,
            hook(dfx.Tsit5(), system.constraint),
            0.0,
            5.0,
            None,
            y0,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=TIGHT,
        )
        q, v = sol.ys
        # speed along the blade: u' = 1.5 cos(t / 2), u(0) = 0.3
        turn = 0.5 * np.asarray(ts)
        speed = 0.3 + 3.0 * np.sin(turn)
        np.testing.assert_allclose(q["turn"], turn, atol=1e-14)
        expected = speed[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        np.testing.assert_allclose(v["p"], expected, atol=1e-8)
        normal = np.sin(turn) * np.asarray(v["p"])[:, 0] - np.cos(turn) * np.asarray(v["p"])[:, 1]
        assert np.abs(normal).max() <= 1e-14
    multipliers = jax.jit(jax.vmap(system.multipliers))(ts, sol.ys)
    assert multipliers.shape == (21, 2)
    # across the blade: u turn' = 1.5 (-sin) + f_n with f = -A^T lambda, A = (sin, -cos)
    np.testing.assert_allclose(multipliers[:, 1], 0.5 * speed + 1.5 * np.sin(turn), atol=1e-7)
    np.testing.assert_allclose(multipliers[:, 0], 0.0, atol=1e-12)


def pendulum_system(gravity=GRAVITY, **options):
    return mj.MechanicalSystem(
        1.0,
        lambda t, q, args: q @ q - 1.0,
        lambda t, q, v, args: jnp.stack([0.0 * gravity, -gravity]),
        **options,
    )


def tension_of(gravity, **options):
    """|J^T lambda| on the output grid, released from the horizontal."""
    system = pendulum_system(gravity)
    ts = jnp.linspace(0.0, 3.0, 31)
    sol = mj.diffeqsolve(
        system.terms,
        mj.Projected(dfx.Dopri8(), system.constraint),
        0.0,
        3.0,
        None,
        (jnp.array([1.0, 0.0]), jnp.zeros(2)),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
        **options,
    )
    multipliers = jax.vmap(system.multipliers)(ts, sol.ys)[:, 0]
    return 2 * multipliers * jnp.linalg.norm(sol.ys[0], axis=1), sol.ys[0]


@pytest.mark.slow
def test_constraint_force_is_the_tension_of_the_string():
    forward = lambda g: tension_of(g, adjoint=dfx.ForwardMode())[0]
    with_slope = jax.jit(lambda g: jax.jvp(forward, (g,), (jnp.ones(()),)))
    tension, slope = with_slope(GRAVITY)
    # energy: |v|^2 = -2 g y; tension = |v|^2 - g y = -3 g y, from the exact solution
    exact, _ = mj.problems.pendulum().reference(np.linspace(0.0, 3.0, 31))
    np.testing.assert_allclose(tension, -3 * GRAVITY * exact[:, 1], atol=1e-8)
    later = (with_slope(GRAVITY + 1e-4)[0] - with_slope(GRAVITY - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(slope, later, atol=1e-5)
    value, reverse = jax.jit(jax.value_and_grad(lambda g: tension_of(g)[0][17]))(GRAVITY)
    np.testing.assert_allclose(value, tension[17], rtol=1e-10)
    np.testing.assert_allclose(reverse, slope[17], rtol=1e-10)


def parallelogram(redundant, third_crank=True):
    """A table of mass 1 on three equal cranks; two of them determine its motion."""

    def loops(t, q, args):
        corners = q[:2][None, :] + jnp.stack(
            [jnp.zeros(2), jnp.array([1.0, 0.0]), jnp.array([2.0, 0.0])]
        ) @ jnp.stack(
            [jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])]), jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])]
        )
        pivots = jnp.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        d = corners - pivots
        return jnp.sum(d * d, axis=1)[: 3 if third_crank else 2] - args["length"] ** 2

    def force(t, q, v, args):
        return jnp.stack([0.0 * args["gravity"], -args["gravity"], 0.0 * args["gravity"]])

    return mj.MechanicalSystem(jnp.array([1.0, 1.0, 0.4]), loops, force, redundant=redundant)


def crank(angle, length, gravity):
    """The table hangs from cranks at `angle` from the downward vertical, at rest."""
    q = jnp.stack([length * jnp.sin(angle), -length * jnp.cos(angle), 0.0 * angle])
    return (q, jnp.zeros(3)), {"length": length, "gravity": gravity}


@pytest.mark.slow
def test_redundant_constraints():
    """Accelerations, trajectories and gradients of the reduced mechanism, in a batch."""
    redundant, reduced = parallelogram(True), parallelogram(False, third_crank=False)
    angles = jnp.linspace(0.2, 1.2, 5)

    def end(system, angle, length):
        y0, args = crank(angle, length, GRAVITY)
        y0 = (y0[0], y0[1] + 0.3 * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0 * angle]))
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            1.0,
            0.02,
            y0,
            args,
            stepsize_controller=dfx.ConstantStepSize(),
        )
        return jnp.concatenate(sol.ys, axis=-1)[0]

    def both(system):
        def weighted(angle, length):
            state = end(system, angle, length)
            return state @ jnp.array([1.0, -2.0, 0.5, 0.3, 0.1, 0.7]), state

        gradient = jax.grad(weighted, argnums=(0, 1), has_aux=True)
        return jax.jit(jax.vmap(gradient, (0, None)))(angles, 1.3)

    for a, b in zip(jax.tree.leaves(both(redundant)), jax.tree.leaves(both(reduced))):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)

    y0, args = crank(jnp.asarray(0.9), jnp.asarray(1.3), GRAVITY)
    moving = (y0[0], 0.7 * jnp.stack([jnp.cos(0.9), jnp.sin(0.9), 0.0]))
    a = redundant.accelerations(0.0, moving, args)
    np.testing.assert_allclose(a, reduced.accelerations(0.0, moving, args), rtol=1e-10, atol=1e-10)
    # of all multipliers that give these accelerations those with the least forces
    multipliers = np.asarray(redundant.multipliers(0.0, moving, args))
    phi = lambda q: redundant.constraint.holonomic(0.0, q, args)
    J = np.asarray(jax.jacobian(phi)(moving[0]))
    assert np.linalg.matrix_rank(J) == 2
    masses = np.array([1.0, 1.0, 0.4])
    force = np.array([0.0, -GRAVITY, 0.0]) - masses * np.asarray(a)
    size = np.sqrt(np.sum(J**2 / masses, axis=1))
    least = np.linalg.lstsq(J.T / size, force, rcond=1e-10)[0] / size
    np.testing.assert_allclose(multipliers, least, rtol=1e-9, atol=1e-9)


def test_equations_that_depend_on_each_other_only_on_the_manifold():
    """Stages beside it see them nearly dependent: dividing by the rest would be wrong by O(1)."""

    def twice(t, q, args):
        sphere = q @ q - 1.0
        return jnp.stack([sphere, sphere * (1.5 + q[0])])

    once = lambda t, q, args: q @ q - 1.0
    force = lambda t, q, v, args: jnp.array([0.0, 0.0, -GRAVITY])
    y0 = (jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 1.0, 0.0]))

    def end(constraint, redundant, tolerance):
        """`tolerance` is traced: one program for all."""
        system = mj.MechanicalSystem(1.0, constraint, force, redundant=redundant)
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            1.5,
            None,
            y0,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        )
        return jnp.concatenate(sol.ys, axis=-1)[0]

    one = jax.jit(lambda tolerance: end(once, False, tolerance))
    both = jax.jit(lambda tolerance: end(twice, True, tolerance))
    exact = one(1e-11)
    for tolerance in (1e-4, 1e-8):
        error = np.abs(both(tolerance) - exact).max()
        assert error < 3 * np.abs(one(tolerance) - exact).max() + 10 * tolerance


def test_redundant_constraints_must_be_announced():
    system = parallelogram(False)
    y0, args = crank(jnp.asarray(0.9), jnp.asarray(1.3), GRAVITY)
    solver = mj.Projected(dfx.Heun(), system.constraint)
    with pytest.raises(RuntimeError, match="redundant=True"):
        mj.diffeqsolve(system.terms, solver, 0.0, 1.0, None, y0, args, stepsize_controller=TIGHT)


def drift(terms, solver, ts, y0, **options):
    sol = dfx.diffeqsolve(
        terms,
        solver,
        0.0,
        ts[-1],
        0.02,
        y0,
        saveat=dfx.SaveAt(steps=True),
        max_steps=4096,
        **options,
    )
    q = np.asarray(sol.ys[0])
    phi = np.abs((q * q).sum(1) - 1)
    t = np.asarray(sol.ts)
    return np.array([phi[t <= end + 1e-9].max() for end in ts])


def test_drift_exponents():
    """Index 1 drifts off 4 times as far per doubling of the time, the projected
    field 2 times, projection stays at round-off."""
    y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
    ts = np.array([8.0, 16.0, 32.0, 64.0])
    system, stabilized = (
        pendulum_system(),
        pendulum_system(stabilization=mj.VelocityStabilization()),
    )
    bare = drift(system.terms, dfx.Dopri5(), ts, y0)
    ratios = bare[1:] / bare[:-1]
    assert np.all((ratios > 3) & (ratios < 5)), ratios
    field = mj.Stabilized(
        dfx.Dopri5(),
        system.constraint,
        stabilization=mj.InvariantStabilization(0.0, projected=True),
    )
    for terms, solver in ((stabilized.terms, dfx.Dopri5()), (system.terms, field)):
        linear = drift(terms, solver, ts, y0)
        ratios = linear[1:] / linear[:-1]
        assert np.all((ratios > 1.6) & (ratios < 2.4)), ratios
        assert linear[-1] < bare[-1] / 50
    assert drift(system.terms, mj.Projected(dfx.Dopri5(), system.constraint), ts, y0).max() <= 1e-15


def flat_rhombus(hook):
    """Four equal rods, two opposite corners fixed one rod apart: a parallelogram that folds flat,
    where a second branch of solutions (cranks turning against each other) crosses."""

    def rods(t, q, args):
        d = q[1] - q[0]
        other = q[1] - jnp.array([1.0, 0.0])
        return jnp.stack([q[0] @ q[0], d @ d, other @ other]) - 1

    system = mj.MechanicalSystem(1.0, rods, lambda t, q, v, args: jnp.zeros((2, 2)))
    angle = 0.5 * np.pi
    start = jnp.array([[np.cos(angle), np.sin(angle)], [1 + np.cos(angle), np.sin(angle)]])
    speed = jnp.tile(jnp.array([np.sin(angle), -np.cos(angle)]), (2, 1))
    sol = mj.diffeqsolve(
        system.terms,
        hook(dfx.Bosh3(), system.constraint),
        0.0,
        3.0,
        None,
        (start, speed),
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.PIDController(rtol=1e-7, atol=1e-7),
        throw=False,
    )
    return sol, angle


@pytest.mark.parametrize("hook", [mj.Projected, mj.LocalCoordinates])
def test_singular_configuration_is_passed_or_reported(hook):
    sol, angle = flat_rhombus(hook)
    t, q = np.asarray(sol.ts), np.asarray(sol.ys[0])
    used = np.isfinite(t) & np.isfinite(q).all(axis=(1, 2))
    assert used.sum() >= np.isfinite(t).sum() - 1  # all but the step that failed
    t, q = t[used], q[used]
    turned = angle - t  # no force: both cranks turn uniformly
    crank = np.stack([np.cos(turned), np.sin(turned)], axis=1)
    exact = np.stack([crank, crank + np.array([1.0, 0.0])], axis=1)
    # Right wherever there is a value; without reaching the end only with a failure code.
    np.testing.assert_allclose(q, exact, atol=1e-4)
    print(sol.result, t[-1])
    assert sol.result != dfx.RESULTS.successful or t[-1] == 3.0
    assert t[-1] > 1.5  # the flat configuration is at t = pi / 2


INDEFINITE = jnp.array([[1.0, 0.0], [0.0, -1.0]])
BAD_SYSTEMS = {
    "not symmetric": (
        dict(mass_matrix=jnp.array([[1.0, 0.5], [0.0, 1.0]])),
        "`mass_matrix` is not symm",
    ),
    "indefinite": (dict(mass_matrix=INDEFINITE), "`mass_matrix` is not positive definite"),
    "negative": (dict(mass_matrix=-1.0), "`mass_matrix` is not positive definite"),
    "no mass at all": (
        dict(mass_matrix=jnp.zeros((2, 2))),
        "`mass_matrix` is not positive definite",
    ),
    "shape of M": (dict(mass_matrix=jnp.ones(3)), "`mass_matrix` must be"),
    "shape of Q": (dict(force=lambda t, q, v, args: jnp.zeros(3)), "`force` must return"),
    "no force": (dict(force=None), "`force` must be a callable"),
    "no constraint": (dict(position_constraint=None), "`position_constraint` is None"),
    "stabilization": (
        dict(stabilization=mj.InvariantStabilization(1.0)),
        "`stabilization` must be",
    ),
    "branches": (
        dict(
            position_constraint=lambda t, q, args: jax.lax.cond(
                q[0] > 0, lambda: jnp.ones(2), lambda: jnp.ones(1)
            )
        ),
        "same number of equations in every branch",
    ),
}


@pytest.mark.parametrize("case", BAD_SYSTEMS)
@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_systems(case):
    changed, message = BAD_SYSTEMS[case]
    arguments = dict(
        mass_matrix=1.0,
        position_constraint=lambda t, q, args: q @ q - 1.0,
        force=lambda t, q, v, args: jnp.array([0.0, -GRAVITY]),
    )

    def run():
        system = mj.MechanicalSystem(**{**arguments, **changed})
        mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Heun(), system.constraint),
            0.0,
            1.0,
            None,
            (jnp.array([1.0, 0.0]), jnp.zeros(2)),
            stepsize_controller=TIGHT,
        )

    with pytest.raises((ValueError, TypeError, RuntimeError), match=message):
        run()


@pytest.mark.parametrize(
    "y0", [jnp.ones(4), (jnp.ones(2), jnp.ones(3)), (jnp.ones(2), [jnp.ones(2)])]
)
@pytest.mark.usefixtures("as_a_user_meets_it")
def test_bad_states(y0):
    system = pendulum_system()
    with pytest.raises(ValueError, match="`y`"):
        mj.diffeqsolve(
            system.terms, mj.Projected(dfx.Tsit5(), system.constraint), 0.0, 1.0, 0.1, y0
        )


def test_indefinite_mass_in_one_lane_leaves_the_others_alone():
    system = mj.MechanicalSystem(
        lambda q, args: jnp.diag(jnp.stack([1.0 + 0.0 * args, args])),
        lambda t, q, args: q @ q - 1.0,
        lambda t, q, v, args: jnp.array([0.0, -GRAVITY]),
    )

    @jax.jit
    @jax.vmap
    def solve(mass):
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Bosh3(), system.constraint),
            0.0,
            0.5,
            None,
            (jnp.array([1.0, 0.0]), jnp.zeros(2)),
            mass,
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
            throw=False,
        )
        return sol.ys, sol.result == dfx.RESULTS.successful

    (good, okay), (mixed, mixed_okay) = (
        solve(jnp.array([1.0, 2.0, 3.0])),
        solve(jnp.array([1.0, -2.0, 3.0])),
    )
    assert okay.tolist() == [True, True, True]
    assert mixed_okay.tolist() == [True, False, True]
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(mixed)):
        np.testing.assert_array_equal(a[::2], b[::2])


def test_a_consistent_start_has_the_nearest_velocities():
    """In the metric of the masses at the corrected positions: `M (v - v0)` is a force of the rods."""
    system = mj.MechanicalSystem(mass_matrix, two_rods, weight)
    q0 = STATE[0] + jnp.array([[0.3, 0.1], [-0.2, 0.2]])
    v0 = STATE[1] + jnp.array([[0.3, 0.1], [-0.2, 0.4]])
    (q, v), info = mj.consistent_state(system.constraint, 0.0, (q0, v0))
    assert info.correction > 0.05
    assert np.abs(jax.flatten_util.ravel_pytree(two_rods(0.0, q, None))[0]).max() < 1e-14
    J = jax.jacobian(lambda x: jnp.stack(list(two_rods(0.0, x.reshape(2, 2), None).values())))
    J, change = J(q.ravel()), mass_matrix(q, None) @ (v - v0).ravel()
    np.testing.assert_allclose(J @ v.ravel(), 0, atol=1e-14)
    multipliers = np.linalg.lstsq(J.T, change)[0]
    np.testing.assert_allclose(J.T @ multipliers, change, rtol=0, atol=1e-13)


@pytest.mark.parametrize("light", [1e-3, 1e-8])
def test_a_light_body_between_heavy_ones_is_moved_to_rounding(light):
    """What both joints do to it alone is larger than what is left by the ratio of the masses."""

    def joints(t, q, args):
        return jnp.stack([q[0] - q[1], jnp.sin(q[1]) - jnp.sin(q[2])])

    masses = jnp.array([1.0, light, 3.0])
    system = mj.MechanicalSystem(masses, joints, lambda t, q, v, args: -q)
    start = jnp.array([0.4, 0.3, 0.2]), jnp.array([1.0, 0.0, 0.0])
    (q, v), info = mj.project(system.constraint, 0.0, start)
    assert info.residual < 1e-16
    np.testing.assert_allclose(q, jnp.full(3, q[0]), rtol=1e-15)
    np.testing.assert_allclose(v, jnp.full(3, 1 / masses.sum()), rtol=1e-7)
    np.testing.assert_allclose(v, jnp.full(3, v[0]), rtol=1e-15)
