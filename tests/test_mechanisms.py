"""Mechanisms of the gallery: equations of motion, closed forms, published and verified numbers.

What holds for every problem of the gallery is tested in `test_problems.py`.
"""

import functools
import inspect

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import numpy_residuals
import pytest
import scipy.special

import manifold_jax as mj
from manifold_jax import problems
from manifold_jax.problems.heavy_top import BENCHMARK, BENCHMARK_DISPLACEMENT, BENCHMARK_QUATERNION
from manifold_jax.problems.slider_crank import PUBLISHED


NEW = [
    "double-pendulum",
    "chain",
    "slider-crank",
    "four-bar",
    "parallelogram",
    "spherical-pendulum",
    "heavy-top",
    "rolling-disc",
]
MECHANISMS = ["pendulum", "car-axis", *NEW]
every = pytest.mark.parametrize("name", NEW)


def pair(y):
    """(q, v) as JAX arrays."""
    return jtu.tree_map(jnp.asarray, y)


def derivative(f, t, h=1e-3):
    """Central differences of sixth order; `f` takes an array of times."""
    before3, before2, before, after, after2, after3 = f(t + h * np.array([-3, -2, -1, 1, 2, 3]))
    return (45 * (after - before) - 9 * (after2 - before2) + after3 - before3) / (60 * h)


@eqx.filter_jit
def both_fields(problem):
    """That of the problem, and that of its system."""
    return [
        jfu.ravel_pytree(terms.vf(problem.t0, problem.y0, problem.args))[0]
        for terms in (problem.terms, problem.system.terms)
    ]


def test_systems_belong_to_mechanisms():
    for name, build in problems.ALL.items():
        problem = build()
        assert (problem.system is not None) == (name in MECHANISMS)
        if problem.system is None:
            continue
        field, from_system = both_fields(problem)
        np.testing.assert_allclose(field, from_system, rtol=1e-12, atol=1e-12)
        assert eqx.tree_equal(problem.constraint, problem.system.constraint)
        other = problem.with_args(problem.args).with_initial(problem.y0)
        assert eqx.tree_equal(other.system, problem.system)


@every
def test_docstring_has_equations_units_and_source(name):
    text = inspect.getdoc(problems.ALL[name])
    for part in (
        "$$",
        "**Arguments:**",
        "Source",
        "`args`",
        "`with_args`",
        "The state is `(q, v)`",
    ):
        assert part in text


@every
def test_reference_satisfies_the_constraints(name):
    problem = problems.ALL[name]()
    t = np.linspace(problem.t0, problem.t1, 101)
    residual = getattr(numpy_residuals, name.replace("-", "_"))
    assert np.abs(residual(t, problem.reference(t))).max() < 1e-13
    # the residuals do not vanish everywhere
    moved = jtu.tree_map(
        lambda leaf: leaf + 0.01 * np.cos(np.arange(leaf.size).reshape(leaf.shape)),
        problem.reference(t),
    )
    assert np.all(np.abs(residual(t, moved)).max(axis=0) > 1e-4)


@eqx.filter_jit
def balance(problem, t, y, a):
    """`M a + C^T lambda - Q`, put together from the user's functions."""
    system, (q, v), args = problem.system, y, problem.args
    M = jnp.asarray(system.mass_matrix(t, q, v, args))
    Ma = M @ a if M.ndim == 2 else M * a
    rows = []
    if system.holonomic is not None:
        rows.append(jax.jacfwd(lambda q: jfu.ravel_pytree(system.holonomic(t, q, args))[0])(q))
    if system.nonholonomic is not None:
        rows.append(jax.jacfwd(lambda v: system.nonholonomic(t, q, v, args))(v))
    multipliers = system.multipliers(t, y, args)
    force = multipliers @ jnp.concatenate(rows)
    return Ma + force - system.force(t, q, v, args), force, system.accelerations(t, y, args)


@every
def test_multipliers_balance_the_accelerations_of_the_reference(name):
    problem = problems.ALL[name]()
    for t in (0.3 * problem.t1, 0.77 * problem.t1):
        y = problem.reference(t)
        velocity = derivative(lambda t: problem.reference(t)[0], t)
        np.testing.assert_allclose(velocity, y[1], rtol=0, atol=1e-9)
        a = derivative(lambda t: problem.reference(t)[1], t)
        rest, force, accelerations = balance(problem, jnp.asarray(t), pair(y), jnp.asarray(a))
        scale = np.abs(force).max()
        assert scale > 0.1
        np.testing.assert_allclose(rest, 0, rtol=0, atol=1e-8 * scale)
        np.testing.assert_allclose(accelerations, a, rtol=0, atol=1e-8 * np.abs(a).max())


@every
def test_reference_from_a_later_state(name):
    """The solution from where it is after a while is the solution from there on, also backwards."""
    problem = problems.ALL[name]()
    middle = 0.4 * problem.t1
    later = problem.with_initial(pair(problem.reference(middle)))
    times = np.array([problem.t1, 0.2 * problem.t1, middle, 0.0])
    for expected, actual in zip(problem.reference(times), later.reference(times - middle)):
        np.testing.assert_allclose(actual, expected, rtol=0, atol=2e-11)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("double-pendulum", dict(lengths=jnp.array([0.7, 1.6]))),
        ("chain", dict(lengths=jnp.array([0.7, 1.6, 2.0]))),
        ("slider-crank", dict(crank_length=0.8)),
        ("four-bar", dict(lengths=jnp.array([1.1, 2.4, 2.2, 2.1]))),
        ("parallelogram", dict(length=1.7, spacing=0.3)),
        ("spherical-pendulum", dict(length=0.4)),
        ("rolling-disc", dict(radius=0.9)),
    ],
)
def test_other_lengths_keep_the_angles(name, changes):
    problem = problems.ALL[name]()
    later = problem.with_initial(pair(problem.reference(0.63 * problem.t1)))
    for before in (problem, later):
        after = before.with_args(before.args._replace(**changes))
        residual = after.constraint(0.0, after.y0, after.args)
        assert max(np.abs(part).max(initial=0) for part in residual) < 3e-14
        assert np.abs(after.y0[0] - before.y0[0]).max() > 0.01 or name == "rolling-disc"
        for part in ("angles", "rates"):
            expected, actual = (kept(name, p, part) for p in (before, after))
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-13)
        # and the way the linkage is put together: nothing jumps
        nearby = before.with_args(jtu.tree_map(lambda leaf: leaf * (1 + 1e-9), before.args))
        np.testing.assert_allclose(nearby.y0[0], before.y0[0], rtol=0, atol=1e-6)


def kept(name, problem, part):
    """The coordinates that `with_args` promises to keep, or directions from which they follow."""
    q, v = (np.asarray(leaf) for leaf in problem.y0)
    x = q if part == "angles" else v
    if name in ("double-pendulum", "chain"):
        links = np.diff(x.reshape(-1, 2), axis=0, prepend=0.0)
        return links / np.asarray(problem.args.lengths)[:, None]
    if name == "spherical-pendulum":
        return q / problem.args.length if part == "angles" else v
    index = {"slider-crank": 0, "four-bar": 2, "parallelogram": slice(2, 6)}
    return x[index.get(name, slice(2, 4))]


# Published and verified numbers


# (links, angle pattern): position and velocity at t = 5, masses and links 1, g = 9.81. 10 digits,
# from two independent formulations (angles, and Cartesian coordinates with multipliers). Of
# the second velocity of (2, "fold") another value, 0.37672565453261177, is in circulation: it
# is off the manifold by 1.5e-9, while the others give it as -x vx / y.
CHAINS = {
    (2, "fold"): (
        (0.6874952916283009, -0.7261888349382117, 0.009192797516124895, -1.4609716099684933),
        (0.39792848916463114, 0.37672565253461170, -0.24065987659193516, 0.9662278781220942),
    ),
    (2, "line"): (
        (0.2661463434139324, -0.963932634517264, 0.7673583463319731, -1.829257156376483),
        (1.010385737301832, 0.2789722640266688, 1.5439158843873044, 0.5880028148578311),
    ),
    (3, "fold"): (
        (
            0.24616445152503444, -0.969228075741401, -0.5152911442410941,
            -1.6174451502438012, -0.4756178842551373, -2.6166578565491636,
        ),
        (
            -1.594481623851619, -0.40496628629121956, 0.07003729611015652,
            -2.3602638181194924, 2.3260688722907013, -2.2706891693049425,
        ),
    ),
    (5, "fold"): (
        (
            -0.3003218362727632, -0.9538379289259552, -0.31474929290768167, -1.953733847757034,
            -0.09530616485375648, -2.929359141376418, -1.088463081378463, -3.046146722733071,
            -0.33636056496126765, -2.387100590205975,
        ),
        (
            0.21325037539761085, -0.06714321414895023, 0.6638806093327747, -0.0736453390561938,
            -1.979183455407048, -0.6681381733509375, -2.026060535097903, -0.269497364280013,
            -0.592433483033773, -1.905550533011517,
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("links", "start"), CHAINS)
def test_chain_meets_verified_values(links, start):
    builds = [functools.partial(problems.chain, links)]
    builds += [problems.double_pendulum] if links == 2 else []
    for build in builds:
        problem = build() if start == "fold" else build(angles=(np.pi / 6,) * links)
        for actual, expected in zip(problem.reference(5.0), CHAINS[links, start]):
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-10)


def test_slider_crank_meets_published_values():
    problem = problems.slider_crank()
    for t, expected in PUBLISHED.items():
        np.testing.assert_allclose(problem.reference(t)[0], expected, rtol=6e-5)
    # 9 digits, by index reduction with two tolerances
    q, v = problem.reference(10.0)
    np.testing.assert_allclose(q, [1.2756758486, 1.0235785590, -0.4988130492], atol=2e-9)
    np.testing.assert_allclose(v, [-0.2399149972, 0.1337782832, 0.0397314960], atol=2e-9)


def test_slider_crank_meets_published_gradients():
    """The integral of the kinetic energy, and its gradient with respect to spring and damper."""
    nodes, weights = np.polynomial.legendre.leggauss(80)
    problem = problems.slider_crank()

    def integral(stiffness, damping):
        args = problem.args._replace(stiffness=stiffness, damping=damping)
        _, v = problem.with_args(args).reference(5 + 5 * nodes)
        return 5 * weights @ (0.5 * v**2 @ np.array([1.0, 1.0, 2.0]))

    h = 1e-3
    gradient = [integral(1 + h, 1) - integral(1 - h, 1), integral(1, 1 + h) - integral(1, 1 - h)]
    # SUNDIALS idasSlCrank_FSA_dns: 3.336616, (0.33345, -0.36375); the digits below verified
    np.testing.assert_allclose(integral(1.0, 1.0), 3.33660679948, rtol=0, atol=2e-11)
    np.testing.assert_allclose(
        np.array(gradient) / (2 * h), [0.3334481065, -0.3637540341], atol=1e-6
    )


def test_heavy_top_meets_the_benchmark():
    problem = problems.heavy_top(**BENCHMARK)
    q, _ = problem.reference(problem.t1)
    a, b, c, d = q
    np.testing.assert_allclose(q, BENCHMARK_QUATERNION, rtol=0, atol=2e-6)
    # the centre of mass is 1 m along the second axis of the body
    second_axis = np.array([2 * (b * c - a * d), a**2 - b**2 + c**2 - d**2, 2 * (c * d + a * b)])
    displacement = second_axis - np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(displacement, BENCHMARK_DISPLACEMENT, rtol=0, atol=2e-6)


# Closed forms


def height_by_elliptic_functions(t, roots, rate):
    """`u'^2 = rate^2 (u - u1) (u2 - u) (u3 - u)` from the upper turning point `u2`."""
    u1, u2, u3 = np.sort(roots)
    m = (u2 - u1) / (u3 - u1)
    s = scipy.special.ellipk(m) + rate * np.sqrt(u3 - u1) / 2 * t
    return u1 + (u2 - u1) * scipy.special.ellipj(s, m)[0] ** 2


def test_spherical_pendulum_closed_form():
    problem = problems.spherical_pendulum(gravity=5.0, length=2.0, t1=7.0)
    t = np.linspace(0.0, 7.0, 57)
    (x0, y0, z0), (vx, vy, _) = problem.y0
    w2, u0 = 5.0 / 2.0, float(z0) / 2
    momentum = float(x0 * vy - y0 * vx) / 4
    energy = float(vx**2 + vy**2) / 8 + w2 * u0
    # u'^2 = 2 (energy - w2 u) (1 - u^2) - momentum^2
    roots = np.roots([2 * w2, -2 * energy, -2 * w2, 2 * energy - momentum**2]).real
    height = functools.partial(height_by_elliptic_functions, roots=roots, rate=np.sqrt(2 * w2))
    q, _ = problem.reference(t)
    np.testing.assert_allclose(q[:, 2] / 2, height(t), rtol=0, atol=2e-13)
    # azimuth' = momentum / (1 - u^2), integrated from one time to the next
    nodes, weights = np.polynomial.legendre.leggauss(20)
    inner = t[:-1, None] + np.diff(t)[:, None] * (1 + nodes) / 2
    steps = np.diff(t) / 2 * ((momentum / (1 - height(inner) ** 2)) @ weights)
    azimuth = np.unwrap(np.arctan2(q[:, 1], q[:, 0]))
    np.testing.assert_allclose(azimuth[1:], np.cumsum(steps), rtol=0, atol=2e-13)


def test_heavy_top_closed_form():
    problem = problems.heavy_top()
    t = np.linspace(0.0, problem.t1, 41)
    u0, spin, beta = np.cos(0.6), 0.3 * 12.0 / 0.5, 2 * 1.0 * 9.81 * 0.5 / 0.5
    # released without nutation: u'^2 = (u0 - u) (beta (1 - u^2) - spin^2 (u0 - u))
    roots = [u0, *np.roots([-beta, spin**2, beta - spin**2 * u0])]
    q, v = problem.reference(t)
    height = q[:, 0] ** 2 - q[:, 1] ** 2 - q[:, 2] ** 2 + q[:, 3] ** 2
    expected = height_by_elliptic_functions(t, roots, np.sqrt(beta))
    np.testing.assert_allclose(height, expected, rtol=0, atol=5e-13)
    assert np.ptp(height) > 0.2
    # the spin about the axis of symmetry is constant: 2 (G(q) q')_3
    a, b, c, d = q.T
    axial = 2 * np.sum(np.stack([-d, c, -b, a], axis=1) * v, axis=1)
    np.testing.assert_allclose(axial, 12.0, rtol=0, atol=1e-12)


def test_heavy_top_is_the_system_of_its_lagrangian():
    problem = problems.heavy_top(inertia=(0.5, 0.7, 0.3), center=(0.1, -0.2, 0.5))

    def lagrangian(t, q, v, args):
        a, b, c, d = q
        rows = [[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]
        spin = 2 * jnp.stack([jnp.stack(row) for row in rows]) @ v
        up = jnp.stack([2 * (b * d - a * c), 2 * (c * d + a * b), a**2 - b**2 - c**2 + d**2])
        return 0.5 * spin @ (args.inertia * spin) - args.mass * args.gravity * (up @ args.center)

    def norm(t, q, args):
        return q @ q - 1

    derived = mj.MechanicalSystem.from_lagrangian(lagrangian, norm)

    @jax.jit
    def motions(t, y):
        return [
            (system.accelerations(t, y, problem.args), system.multipliers(t, y, problem.args))
            for system in (problem.system, derived)
        ]

    (a, force), (expected_a, expected_force) = motions(1.3, pair(problem.reference(1.3)))
    np.testing.assert_allclose(a, expected_a, rtol=0, atol=1e-11)
    np.testing.assert_allclose(force, expected_force, rtol=0, atol=1e-11)


def test_heavy_top_at_attitudes_where_a_pivot_is_small():
    """The null vector of the mass matrix is q; elimination ends in its last component."""
    problem = problems.heavy_top()

    @jax.jit
    @jax.vmap
    def accelerations(small):
        q = jnp.stack([0.6, 0.48, 0.64, small]) / jnp.sqrt(1 + small**2)
        v = jnp.stack([-0.48, 0.6, -small, 0.64]) / jnp.sqrt(1 + small**2)
        return problem.system.accelerations(0.0, (q, v), problem.args)

    small = np.logspace(-10, -1, 46)
    limit, *values = np.asarray(accelerations(np.concatenate([[0.0], small])))
    change = np.abs(np.array(values) - limit).max(axis=1)
    assert np.all(change <= 20 * small + 1e-11)


@pytest.mark.parametrize("links", [1, 2, 4])
def test_small_swings_of_a_chain(links):
    """Frequencies `sqrt(g x)`, x the zeros of the Laguerre polynomial (D. Bernoulli)."""
    i = np.arange(links)
    inertia = links - np.maximum.outer(i, i)
    zeros, _ = np.polynomial.laguerre.laggauss(links)
    for zero in zeros:
        # the mode: diag(N - i) p = x M p, with g and the length 1
        _, _, rows = np.linalg.svd(np.diag(links - i) - zero * inertia)
        problem = problems.chain(links, gravity=2.0, angles=1e-5 * rows[-1])
        q, _ = problem.reference(0.7)
        expected = np.cumsum(1e-5 * rows[-1]) * np.cos(np.sqrt(2.0 * zero) * 0.7)
        np.testing.assert_allclose(q[0::2], expected, rtol=0, atol=1e-13)


def test_a_chain_at_rest_carries_its_weight():
    problem = problems.chain(masses=(1.0, 2.0, 4.0), lengths=(1.0, 0.5, 2.0), angles=0.0)
    multipliers = problem.system.multipliers(0.0, problem.y0, problem.args)
    expected = 9.81 * np.array([7.0, 6.0, 4.0]) / np.array([1.0, 0.5, 2.0])
    np.testing.assert_allclose(multipliers, expected, rtol=1e-14)


def test_parallelogram_with_massless_cranks_is_a_pendulum():
    t = np.linspace(0.0, 10.0, 21)
    problem = problems.parallelogram(crank_mass=0.0, length=1.5, angle=0.7, rate=-0.4)
    q0 = 1.5 * np.array([np.sin(0.7), -np.cos(0.7)])
    v0 = -0.4 * 1.5 * np.array([np.cos(0.7), np.sin(0.7)])
    pendulum = problems.pendulum(length=1.5, q0=q0, v0=v0)
    (q, v), (expected_q, expected_v) = problem.reference(t), pendulum.reference(t)
    np.testing.assert_allclose(q[:, :2], expected_q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(v[:, :2], expected_v, rtol=0, atol=1e-13)


def test_four_bar_as_a_parallelogram():
    """Opposite links equal: a pendulum, `(m1 + 3 m2 + m3) / 3 l a'' = -(m1 + 2 m2 + m3) / 2 g sin a`,
    like the coupler of the linkage with three cranks when one of them has no mass."""
    t = np.linspace(0.0, 3.0, 13)
    four = problems.four_bar(
        masses=(0.75, 2.0, 0.75),
        lengths=(1.0, 2.0, 1.0, 2.0),
        crank_angle=1 - np.pi / 2,
        crank_rate=0,
    )
    # the linkage starts folded the other way: below the line of the pivots
    q = np.array(four.y0[0])
    q[3:6] = np.sin(1.0) + 1.0, -np.cos(1.0), 0.0
    q[6:9] = 2.0 + np.sin(1.0) / 2, -np.cos(1.0) / 2, 1 - np.pi / 2
    four = four.with_initial((jnp.asarray(q), jnp.zeros(9)))
    three = problems.parallelogram(crank_mass=0.5, angle=1.0)
    (bars, speeds), (expected, expected_speeds) = four.reference(t), three.reference(t)
    np.testing.assert_allclose(bars[:, 2], expected[:, 3] - np.pi / 2, rtol=0, atol=2e-12)
    np.testing.assert_allclose(speeds[:, 3:6], expected_speeds[:, :3], rtol=0, atol=1e-11)


def test_rolling_disc_closed_forms():
    # straight downhill: uniform acceleration 2/3 g sin(slope) of a homogeneous disc
    problem = problems.rolling_disc(slope=0.2)
    y0 = (jnp.zeros(4), jnp.array([0.5, 0.0, 0.0, 1.0]))
    k = 9.81 * np.sin(0.2) / 1.5
    q, v = problem.with_initial(y0).reference(3.0)
    np.testing.assert_allclose(q, [1.5 + 4.5 * k, 0, 0, 3 + 9 * k], rtol=0, atol=1e-13)
    np.testing.assert_allclose(v, [0.5 + 3 * k, 0, 0, 1 + 6 * k], rtol=0, atol=1e-13)
    # from rest the disc drifts sideways, by k t / (2 w) on average
    turning = problem.with_initial((jnp.zeros(4), jnp.array([0.0, 0.0, 2.0, 0.0])))
    q, _ = turning.reference(10 * np.pi)
    np.testing.assert_allclose(q[:2], [0.0, k / 4 * 10 * np.pi], rtol=0, atol=1e-12)


def test_rolling_disc_with_every_rate_of_turning():
    """The two ways to write the integrals agree where one gives way to the other."""
    problem = problems.rolling_disc()

    def end(rate, t):
        _, v0 = problem.y0
        y0 = (problem.y0[0], v0.at[2].set(rate))
        return np.concatenate(problem.with_initial(y0).reference(t))

    for rate in (1e-12, -0.1, 0.1, 3.0):
        t = 1 / abs(rate) if abs(rate) > 0.05 else 2.0
        inside, outside = end(rate, t * (1 - 1e-13)), end(rate, t * (1 + 1e-13))
        np.testing.assert_allclose(inside, outside, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(end(1e-12, 2.0), end(0.0, 2.0), rtol=0, atol=1e-11)


# What is refused


def test_references_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="below the horizontal"):
        problems.parallelogram(rate=4.0).reference(1.0)
    with pytest.raises(ValueError, match="below the horizontal"):
        problems.parallelogram(angle=1.6).reference(1.0)
    # coupler and rocker in line, which ends the way of the crank
    stuck = problems.four_bar(lengths=(2.0, 1.2, 1.2, 2.0), crank_angle=0.5)
    with pytest.raises(ValueError, match="does not reach t = 5"):
        stuck.reference(5.0)


def test_chain_refuses_wrong_shapes():
    with pytest.raises(ValueError, match=r"`masses` must be a scalar or of shape \(3,\)"):
        problems.chain(masses=(1.0, 2.0))
    with pytest.raises(ValueError, match=r"`angles` must be a scalar or of shape \(2,\)"):
        problems.double_pendulum(angles=(1.0, 2.0, 3.0))
