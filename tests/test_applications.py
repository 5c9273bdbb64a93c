"""Curves followed through their folds, and constrained minima reached by a gradient flow."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import manifold_jax as mj


SUCCESS = dfx.RESULTS.successful
FAILURE = dfx.RESULTS.nonlinear_divergence


# Curves in the plane, all as `sum_ij C_ij x^i y^j = 0`, so that they share one program.


def polynomial(x, C):
    powers = jnp.stack([x**i for i in range(5)])
    return (powers[:, 0] @ C @ powers[:, 1])[None]


def coefficients(**terms):
    """`coefficients(x2=1, y2=1, one=-1)` is the unit circle."""
    C = np.zeros((5, 5))
    for name, value in terms.items():
        x = int(name[name.index("x") + 1]) if "x" in name else 0
        y = int(name[name.index("y") + 1]) if "y" in name else 0
        C[x, y] = value
    return jnp.asarray(C)


def circle(r=1.0):
    return coefficients(x2=1, y2=1, one=-(r**2))


def traced(C, x0, direction, length, tolerance, throw=True, **options):
    options = dict(points=21, rtol=tolerance, atol=tolerance, max_turning_points=4, **options)
    return mj.trace_curve(
        polynomial, x0, C, length=length, direction=direction, throw=throw, **options
    )


RNG = np.random.default_rng(0)
WEIGHTS = [RNG.normal(size=shape) for shape in ((21, 2), (21, 2), (2,), ())]


def weighted(points, tangents, turning_points, turning_arclengths):
    """A number that depends on everything that a trace consists of."""
    values = points, tangents, turning_points[0], turning_arclengths[0]
    return sum(jnp.sum(w * v) for w, v in zip(WEIGHTS, values))


@eqx.filter_jit
@eqx.filter_value_and_grad(has_aux=True)
def loud(C, *case):
    """Raises; and differentiates by the coefficients, in reverse mode."""
    trace = traced(C, *case)
    values = trace.points, trace.tangents, trace.turning_points, trace.turning_arclengths
    return weighted(*values), trace


quiet_batch = eqx.filter_jit(
    lambda *batch: jax.vmap(lambda *case: traced(*case, throw=False))(*batch)
)
NEIGHBOUR = circle(0.5), [0.5, 0.0], [0.0, 1.0], 1.0, 1e-6


def follow(C, x0, direction, length, tolerance=1e-8):
    """One trace, in a batch with a second one, on which it must leave no mark."""
    case = C, x0, direction, length, tolerance
    batch = [jnp.stack([jnp.asarray(a, float), jnp.asarray(b, float)])
             for a, b in zip(case, NEIGHBOUR)]  # fmt: skip
    traces = quiet_batch(*batch)
    trace, neighbour = (jax.tree.map(lambda leaf, i=i: leaf[i], traces) for i in (0, 1))
    assert neighbour.result == SUCCESS
    assert int(neighbour.stats["num_steps"]) == 50
    np.testing.assert_allclose(neighbour.points[-1], 0.5 * np.array([np.cos(2), np.sin(2)]),
                               rtol=1e-5)  # fmt: skip
    return trace


def follow_or_raise(C, x0, direction, length, tolerance=1e-8):
    return loud(C, *(jnp.asarray(v, float) for v in (x0, direction, length, tolerance)))


def test_circle_exactly_by_arclength():
    """Points, tangents and turning points; more than fit are counted. It goes round again."""
    trace = follow(circle(), [1.0, 0.0], [0.0, 1.0], 18.0)
    s = np.asarray(trace.arclengths)
    np.testing.assert_allclose(s, np.linspace(0, 18, 21), rtol=1e-15)
    np.testing.assert_allclose(trace.points, np.stack([np.cos(s), np.sin(s)], 1), atol=1e-8)
    np.testing.assert_allclose(trace.tangents, np.stack([-np.sin(s), np.cos(s)], 1), atol=1e-8)
    np.testing.assert_allclose(np.sum(np.square(trace.points), axis=1), 1, atol=1e-15)
    assert trace.result == SUCCESS
    assert int(trace.num_turning_points) == 6
    np.testing.assert_allclose(trace.turning_points, [[0, 1], [0, -1]] * 2, atol=1e-13)
    np.testing.assert_allclose(trace.turning_arclengths, np.pi * np.arange(0.5, 4), atol=1e-8)


@pytest.mark.parametrize("sense", [1, -1])
def test_cubic_fold(sense):
    """lambda = x - x^3 / 3 turns at x = -1 and x = 1, from either end; the rest is NaN."""
    arclength = lambda end: scipy.integrate.quad(lambda x: np.hypot(1, 1 - x**2), -2, end)[0]
    C = coefficients(x1=1, x3=-1 / 3, y1=-1)
    start = sense * np.array([-2.0, 2 / 3])
    trace = follow(C, start, [sense, 0.0], arclength(2))
    assert trace.result == SUCCESS
    np.testing.assert_allclose(trace.points[-1], -start, atol=1e-8)
    assert int(trace.num_turning_points) == 2
    expected = sense * np.array([[-1, -2 / 3], [1, 2 / 3]])
    np.testing.assert_allclose(trace.turning_points[:2], expected, atol=1e-14)
    exact = [arclength(-1), arclength(1)]
    np.testing.assert_allclose(trace.turning_arclengths[:2], exact, atol=1e-8)
    assert np.all(np.isnan(trace.turning_points[2:]))
    assert np.all(np.isnan(trace.turning_arclengths[2:]))


def test_what_counts_as_a_turning_point():
    """y = x^3 - 3 w^2 x turns at -w and w; an inflection does not turn, nor does a start at a
    fold, where the sign of the tangent component is a matter of rounding."""
    w = 0.1
    C = coefficients(x3=1, x1=-3 * w**2, y1=-1)
    trace = follow(C, [-0.5, -0.125 + 1.5 * w**2], [1.0, 0.0], 1.2)
    assert int(trace.num_turning_points) == 2
    np.testing.assert_allclose(trace.turning_points[:2, 0], [-w, w], atol=1e-13)
    inflection = coefficients(x3=1, y1=-1), [-0.5, -0.125], [1.0, 0.0], 1.2
    # To rounding at a fold, but on the side from which it is still crossed.
    folds = [(C, [w * (1 - sign * 1e-14), -2 * w**3], [sign, 0.0], 0.1) for sign in (-1.0, 1.0)]
    for case in inflection, *folds, (circle(), [0.0, 1.0], [1.0, 0.0], 3.0):
        trace = follow(*case)
        assert trace.result == SUCCESS
        assert int(trace.num_turning_points) == 0
        assert np.all(np.isnan(trace.turning_points))


SINGULAR = {
    "crossing lines": (coefficients(x1y1=1), [-1.0, 0.0], [1.0, 0.0], 2.0, 1.0),
    # (y - 0.3 x) (y - 0.29 x): half a degree apart, the sense agrees on the next branch
    "small angle": (
        coefficients(y2=1, x1y1=-0.59, x2=0.087), [-1.0, -0.3], [1.0, 0.3], 2.0, 1.0440306508910550,
    ),
    "pitchfork, trivial branch": (
        coefficients(x1y1=1, x3=-1), [0.0, -1.0], [0.0, 1.0], 2.0, 1.0,
    ),
    "pitchfork, curved branch": (
        coefficients(x1y1=1, x3=-1), [1.0, 1.0], [-1.0, -2.0], 3.0, 1.4789428575445975,
    ),
    # x (x^2 - 0.01) crosses y = 0 three times, and the sense is reversed twice
    "several crossings": (
        coefficients(x3y1=1, x1y1=-0.01), [-1.0, 0.0], [1.0, 0.0], 2.0, 0.9,
    ),
    "cusp": (coefficients(x2=1, y3=-1), [1.0, 1.0], [-1.0, -1.0], 2.5, 1.4397098733715500),
    "lemniscate": (
        coefficients(x4=1, x2y2=2, y4=1, x2=-1, y2=1), [1.0, 0.0], [0.0, 1.0], 4.0,
        1.3110287771460600,
    ),
}  # fmt: skip


@pytest.mark.parametrize("length_factor", [1.0, 1.0137])
@pytest.mark.parametrize("tolerance", [1e-8, 1e-5])
@pytest.mark.parametrize("name", SINGULAR)
def test_singular_points_end_the_trace(name, tolerance, length_factor):
    """Never on to another branch: everything before the singular point, NaN after it."""
    C, x0, direction, length, until = SINGULAR[name]
    trace = follow(C, x0, direction, length * length_factor, tolerance)
    assert trace.result == FAILURE
    reached = np.isfinite(trace.points[:, 0])
    s, spacing = np.asarray(trace.arclengths), length * length_factor / 20
    assert np.array_equal(reached, s < until - 1e-3) or np.array_equal(reached, s < until + 1e-3)
    chords = np.linalg.norm(np.diff(np.asarray(trace.points)[reached], axis=0), axis=1)
    assert np.all(chords <= spacing * (1 + 1e-6))
    assert np.all(chords >= 0.95 * spacing)
    assert np.all(np.isnan(trace.tangents[~reached]))


@pytest.mark.parametrize(("gap", "tolerance"), [(1e-2, 1e-4), (1e-6, 1e-8), (1e-10, 1e-8)])
def test_sharp_bends_are_followed(gap, tolerance):
    """xy = gap, the same lines pulled apart: radius of the bend about sqrt(2 gap)."""
    start = [-1.0, -gap]
    trace = follow(coefficients(x1y1=1, one=-gap), start, [1.0, 0.0], 1.9, tolerance)
    assert trace.result == SUCCESS
    assert np.all(np.asarray(trace.points) < 0)
    np.testing.assert_allclose(trace.points[:, 0] * trace.points[:, 1], gap, atol=1e-15)
    assert float(trace.points[-1, 1]) < -0.89


def test_bends_beyond_the_tolerance_are_refused():
    trace = follow(coefficients(x1y1=1, one=-1e-16), [-1.0, -1e-16], [1.0, 0.0], 1.9)
    assert trace.result == FAILURE


CROSSING = coefficients(x1y1=1)


@pytest.mark.parametrize(
    ("C", "x0", "direction", "length", "message"),
    [
        (circle(), [np.nan, 0.0], [0.0, 1.0], 1.0, "not finite at `x0`"),
        (CROSSING, [0.0, 0.0], [0.0, 1.0], 1.0, "`x0` is a singular point"),
        (coefficients(x2=1, y2=1, one=1), [0.5, 0.2], [0.0, 1.0], 1.0, "`x0` is not near"),
        (circle(), [1.0, 0.0], [1.0, 0.0], 1.0, "`direction` does not say"),
        (circle(), [1.0, 0.0], [0.0, 0.0], 1.0, "`direction` does not say"),
        (circle(), [1.0, 0.0], [0.0, np.nan], 1.0, "`direction` does not say"),
        (circle(), [1.0, 0.0], [0.0, 1.0], -1.0, "`length` must be positive"),
        (circle(), [1.0, 0.0], [0.0, 1.0], np.nan, "`length` must be positive"),
        (CROSSING, [-1.0, 0.0], [1.0, 0.0], 2.0, "meets a singular point"),
    ],
)
def test_run_time_errors_and_their_codes(C, x0, direction, length, message):
    """Lengths and directions are traced here, so that nothing is known before the run."""
    with pytest.raises(RuntimeError, match=f"(?s){message}"):
        follow_or_raise(C, x0, direction, length)
    trace = follow(C, x0, direction, length)
    assert trace.result == FAILURE
    assert np.isnan(trace.points[-1, 0])


def test_start_off_the_curve_is_moved_and_reported():
    trace = follow(circle(), [1.2, 0.0], [0.0, 1.0], 1.0)
    assert trace.result == SUCCESS
    np.testing.assert_allclose(trace.points[0], [1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(trace.stats["initial_correction"], 0.2 / 2.2, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(x0=jnp.ones((2, 1))), ValueError, r"`x0`.*\(n \+ 1,\).*\(2, 1\).*ravel_pytree"),
        (dict(x0=[1.0, 0.0]), ValueError, "`x0`.*list.*ravel_pytree"),
        (dict(x0=(jnp.ones(1), jnp.ones(1))), ValueError, "`x0`.*tuple"),
        (dict(x0=jnp.ones(1)), ValueError, "`x0`"),
        (dict(x0=np.array([1, 0])), TypeError, "`x0`.*int64.*float"),
        (dict(x0=jnp.ones(2, complex)), TypeError, "`x0`.*complex"),
        (dict(function=1.0), TypeError, "`function`.*float"),
        (dict(function=lambda x, r: x), ValueError, r"`function`.*\(1,\).*2 numbers.*shape \(2,\)"),
        (dict(function=lambda x, r: x @ x - r), ValueError, r"`function`.*shape \(1,\)"),
        (dict(function=lambda x, r: (x,)), ValueError, "`function`.*one array"),
        (dict(function=lambda x, r: jnp.ones(1, int)), TypeError, "`function`.*int"),
        (dict(length=0.0), ValueError, "`length` must be positive.*Got 0.0"),
        (dict(length=float("nan")), ValueError, "`length`"),
        (dict(points=1), ValueError, "`points`.*at least 2"),
        (dict(max_turning_points=0), ValueError, "`max_turning_points`"),
        (dict(max_steps=None), ValueError, "`max_steps`"),
        (dict(parameter=2), ValueError, "`parameter`.*2 components"),
        (dict(direction=jnp.ones(3)), ValueError, r"`direction`.*\(2,\).*\(3,\)"),
        (dict(solver=dfx.LeapfrogMidpoint()), ValueError, "`solver=LeapfrogMidpoint"),
    ],
)
def test_trace_arguments(change, error, message, as_a_user_meets_it):
    arguments = dict(
        function=lambda x, r: (x @ x - r)[None], x0=jnp.array([1.0, 0.0]), args=1.0, length=1.0
    )
    with pytest.raises(error, match=f"(?s){message}"):
        mj.trace_curve(**{**arguments, **change})


def test_reverse_derivatives_of_a_trace():
    """x(s) = r (cos s/r, sin s/r), by r."""
    _, slope = follow_or_raise(circle(), [1.0, 0.0], [0.0, 1.0], 2.0)
    s = np.linspace(0, 2, 21)
    cos, sin = np.cos(s), np.sin(s)
    moved = np.stack([cos + s * sin, sin - s * cos], 1)
    turned = np.stack([s * cos, s * sin], 1)
    exact = weighted(moved, turned, np.array([[0.0, 1.0]]), np.array([np.pi / 2]))
    np.testing.assert_allclose(-2 * slope[0, 0], exact, atol=1e-7)  # -r^2 is that coefficient


@pytest.mark.slow
def test_forward_reverse_and_differences_of_a_trace():
    """The cubic fold by its coefficient of x^3, start included."""

    def values(c, adjoint=None):
        H = lambda x, args: x[:1] + c * x[:1] ** 3 - x[1:]
        x0 = jnp.stack([jnp.asarray(-2.0), -2 - 8 * c])
        options = dict(length=6.0, points=7, direction=-1, rtol=1e-10, atol=1e-10)
        trace = mj.trace_curve(H, x0, adjoint=adjoint, **options)
        turns = trace.turning_points[:2].ravel(), trace.turning_arclengths[:2]
        return jnp.concatenate([trace.points.ravel(), trace.tangents.ravel(), *turns])

    c = jnp.asarray(-1 / 3)
    forward = jax.jit(jax.jacfwd(lambda c: values(c, dfx.ForwardMode())))(c)
    reverse = jax.jit(jax.jacrev(values))(c)
    np.testing.assert_allclose(forward, reverse, rtol=1e-7, atol=1e-8)
    f = jax.jit(values)
    np.testing.assert_allclose(forward, (f(c + 1e-4) - f(c - 1e-4)) / 2e-4, atol=2e-5)
    # x = -+ (-3 c)^(-1/2) there
    np.testing.assert_allclose(forward[-6:-2:2], [-1.5, 1.5], atol=1e-12)


def test_one_trace_equals_a_batch():
    case = circle(), [1.0, 0.0], [0.0, 1.0], 2.0
    ((_, single), _), batched = follow_or_raise(*case), follow(*case)
    assert single.result == SUCCESS
    assert int(single.num_turning_points) == int(batched.num_turning_points) == 1
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(batched)):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


N = 15  # interior points


def bratu(x, args):
    """u'' + lambda e^u = 0, u(0) = u(1) = 0, by central differences; also for NumPy."""
    exp, pad = (np.exp, np.pad) if isinstance(x, np.ndarray) else (jnp.exp, jnp.pad)
    u, p = x[:-1], pad(x[:-1], 1)
    return (p[2:] - 2 * u + p[:-2]) * (N + 1) ** 2 + args * x[-1] * exp(u)


def bratu_fold():
    """The fold from the extended system (H, H_u v, v.v - 1) in (u, lambda, v), by SciPy."""

    def extended(z):
        u, v = z[:N], z[N + 1 :]
        Hv = (np.pad(v, 1)[2:] - 2 * v + np.pad(v, 1)[:-2]) * (N + 1) ** 2 + z[N] * np.exp(u) * v
        return np.concatenate([bratu(z[: N + 1], 1.0), Hv, [v @ v - 1]])

    shape = np.sin(np.pi * np.arange(1, N + 1) / (N + 1))
    guess = np.concatenate([1.2 * shape, [3.5], shape / np.linalg.norm(shape)])
    root = scipy.optimize.root(extended, guess, tol=1e-14).x  # as far as rounding lets it
    np.testing.assert_allclose(extended(root), 0, atol=1e-9)
    return root[: N + 1]


@pytest.fixture(scope="module")
def bratu_trace():
    """And its derivative by the factor of lambda, in forward mode."""

    def values(factor):
        options = dict(length=12.0, points=41, adjoint=dfx.ForwardMode())
        trace = mj.trace_curve(bratu, jnp.zeros(N + 1), factor, **options)
        return (trace.points, trace.turning_points[0]), trace

    _, slope, trace = jax.jit(
        lambda factor: jax.jvp(values, (factor,), (jnp.ones_like(factor),), has_aux=True)
    )(jnp.asarray(1.0))
    return trace, slope


def test_bratu_fold(bratu_trace):
    """Sixteen unknowns, through the fold onto the upper branch."""
    trace, (_, slope) = bratu_trace
    fold = bratu_fold()
    assert int(trace.num_turning_points) == 1
    np.testing.assert_allclose(trace.turning_points[0], fold, atol=1e-10)
    # The continuous problem folds at 3.513830719; the differences are of second order.
    np.testing.assert_allclose(fold[-1], 3.513830719, rtol=3e-3)
    # factor * lambda is always the same at the fold.
    np.testing.assert_allclose(slope, np.append(np.zeros(N), -fold[-1]), atol=1e-9)
    residual = jax.vmap(lambda x: bratu(x, 1.0))(trace.points)
    assert np.abs(residual).max() < 1e-11
    assert float(trace.points[-1, -1]) < 1.5
    assert float(trace.points[-1, N // 2]) > 3.5


def bratu_by_scipy(factor):
    """The point at arclength 12; the tangent from a singular value decomposition."""

    def field(s, x):
        u = x[:-1]
        G = np.zeros((N, N + 1))
        G[:, :N] = (np.eye(N, k=1) - 2 * np.eye(N) + np.eye(N, k=-1)) * (N + 1) ** 2
        G[:, :N] += np.diag(factor * x[-1] * np.exp(u))
        G[:, N] = factor * np.exp(u)
        tau = np.linalg.svd(G)[2][-1]
        return tau * np.sign(np.linalg.det(np.vstack([G / (N + 1) ** 2, tau]))) * sense

    sense = 1.0
    sense = np.sign(field(0.0, np.zeros(N + 1))[-1])
    options = dict(method="DOP853", rtol=1e-11, atol=1e-11)
    return scipy.integrate.solve_ivp(field, (0, 12), np.zeros(N + 1), **options).y[:, -1]


def test_bratu_and_its_derivative_against_scipy(bratu_trace):
    trace, (slope, _) = bratu_trace
    np.testing.assert_allclose(trace.points[-1], bratu_by_scipy(1.0), atol=1e-6)
    difference = (bratu_by_scipy(1.001) - bratu_by_scipy(0.999)) / 0.002
    np.testing.assert_allclose(slope[-1], difference, atol=1e-5)


@pytest.mark.slow
def test_newton_homotopy():
    """H = F(x) - (1 - p) F(a) = 0 from a (p = 0) to a root of F (p = 1), for Freudenstein &
    Roth's system, on which Newton's method fails from a. Its only root is (5, 4)."""

    def F(x):
        first = x[0] - x[1] * (2 - x[1] * (5 - x[1])) - 13
        return jnp.stack([first, x[0] - x[1] * (14 - x[1] * (1 + x[1])) - 29])

    a = jnp.array([15.0, -2.0])

    @jax.jit
    def homotopy(a):
        H = lambda x, args: F(x[:2]) - (1 - x[2]) * F(a)
        return mj.trace_curve(H, jnp.append(a, 0.0), length=120.0, points=1201)

    trace = homotopy(a)
    points = np.asarray(trace.points)
    (crossing,) = np.flatnonzero((points[:-1, 2] < 1) & (points[1:, 2] >= 1))
    x, p = points[crossing : crossing + 2, :2], points[crossing : crossing + 2, 2]
    np.testing.assert_allclose(x[0] + (1 - p[0]) / (p[1] - p[0]) * (x[1] - x[0]), [5, 4], atol=1e-3)
    assert int(trace.num_turning_points) == 2  # p decreases on the way


# Quadratic objectives on quadrics, `f = x.Q x / 2 + b.x` on `x.D x = c`, in one program.


class Quadratic(eqx.Module):
    Q: jax.Array
    b: jax.Array
    D: jax.Array
    c: jax.Array

    def __init__(self, Q=None, b=None, D=None, c=1.0):
        fill = lambda value, default: jnp.asarray(default if value is None else value, float)
        self.Q, self.b = fill(Q, np.eye(3)), fill(b, np.zeros(3))
        self.D, self.c = fill(D, np.eye(3)), jnp.asarray(c, float)


# The state is a pytree, (x_1, x_2) apart from x_3.


def joined(x):
    return jnp.append(x["pair"], x["rest"])


def split(x):
    return {"pair": x[:2], "rest": x[2]}


def height(x, q):
    x = joined(x)
    return 0.5 * x @ q.Q @ x + q.b @ x


QUADRIC = mj.Constraint(lambda t, x, q: joined(x) @ q.D @ joined(x) - q.c)


def flow(q, x0, t1, **options):
    minimum = mj.gradient_flow(height, QUADRIC, split(x0), q, t1=t1, **options)
    return eqx.tree_at(lambda m: m.x, minimum, joined(minimum.x))


@eqx.filter_jit
def flow_loudly(q, x0, t1):
    """Raises; and differentiates (x, lambda, f) by all of q, in both modes."""
    theta, unravel = jfu.ravel_pytree(q)

    def values(theta):
        minimum = flow(unravel(theta), x0, t1)
        return jnp.concatenate([minimum.x, minimum.multipliers, minimum.objective[None]]), minimum

    _, forward, minimum = jax.linearize(values, theta, has_aux=True)
    reverse = jax.linear_transpose(forward, theta)
    by_columns = jax.vmap(forward, out_axes=1)(jnp.eye(theta.size))
    by_rows = jax.vmap(lambda v: reverse(v)[0])(jnp.eye(5))
    return minimum, by_columns, by_rows


flow_quietly = eqx.filter_jit(jax.vmap(lambda *case: flow(*case, throw=False)))


def descend(q, x0, t1=1e6):
    """One flow, in a batch with a second one, on which it must leave no mark."""
    case, neighbour = (q, np.asarray(x0, float), t1), (Quadratic(b=[0, 0, 1]), np.eye(3)[0], 1e6)
    batch = jax.tree.map(
        lambda *pair: jnp.stack([jnp.asarray(a, float) for a in pair]), case, neighbour
    )
    minima = flow_quietly(*batch)
    minimum, other = (jax.tree.map(lambda leaf, i=i: leaf[i], minima) for i in (0, 1))
    assert bool(other.is_minimum)
    np.testing.assert_allclose(other.x, [0, 0, -1], atol=1e-14)
    return minimum


SYMMETRIC = np.array([[2.0, 0.3, -0.4], [0.3, 5.0, 0.7], [-0.4, 0.7, 3.0]])


def test_a_start_that_cannot_be_left():
    """It is what was reached: the equations depend on each other there."""
    twice = mj.Constraint(lambda t, x, args: jnp.stack([x[0] - 2, 2 * x[0] - 4]))
    start = jnp.array([2.0, 1.0])
    minimum = mj.gradient_flow(lambda x, args: x @ x, twice, start, throw=False)
    assert minimum.result != SUCCESS
    np.testing.assert_array_equal(minimum.x, start)
    assert not minimum.is_minimum


def test_rayleigh_quotient():
    """The least eigenvalue, as the multiplier; the gap to the next one is the curvature."""
    values, vectors = np.linalg.eigh(SYMMETRIC)
    minimum = descend(Quadratic(SYMMETRIC), [0.0, 0.6, 0.8])
    assert minimum.result == SUCCESS
    assert bool(minimum.is_minimum)
    v = vectors[:, 0] * np.sign(vectors[:, 0] @ minimum.x)
    np.testing.assert_allclose(minimum.x, v, atol=1e-14)
    # Q x + 2 lambda x = 0
    np.testing.assert_allclose(minimum.multipliers, [-values[0] / 2], rtol=1e-14)
    np.testing.assert_allclose(minimum.objective, values[0] / 2, rtol=1e-14)
    np.testing.assert_allclose(minimum.curvature, values[1] - values[0], rtol=1e-12)
    assert float(minimum.violation) < 1e-15
    assert float(minimum.stationarity) < 1e-14


def test_nearest_point_on_an_ellipsoid():
    """x = p / (1 + 2 lambda d), lambda from the scalar equation x.D x = 1 (SciPy)."""
    p, d = np.array([2.0, -1.0, 0.5]), 1 / np.array([1.0, 2.0, 3.0]) ** 2
    root = scipy.optimize.brentq(
        lambda m: np.sum(d * (p / (1 + 2 * m * d)) ** 2) - 1, -0.4, 50, xtol=1e-15
    )
    start = -p / np.sqrt(p @ (d * p))  # the opposite side
    minimum = descend(Quadratic(b=-p, D=np.diag(d)), start)
    np.testing.assert_allclose(minimum.x, p / (1 + 2 * root * d), atol=1e-13)
    np.testing.assert_allclose(minimum.multipliers, [root], rtol=1e-12)
    assert bool(minimum.is_minimum)


@pytest.mark.parametrize("seed", range(4))
def test_against_slsqp(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(2, 3, 3))
    q = Quadratic(A @ A.T, rng.normal(size=3), B @ B.T + np.eye(3), 2.0)
    x0 = rng.normal(size=3)
    x0 *= np.sqrt(2 / (x0 @ q.D @ x0))
    minimum = descend(q, x0)
    Q, b, D = (np.asarray(a) for a in (q.Q, q.b, q.D))
    theirs = scipy.optimize.minimize(
        lambda x: 0.5 * x @ Q @ x + b @ x,
        minimum.x + 0.01 * rng.normal(size=3),
        jac=lambda x: Q @ x + b,
        method="SLSQP",
        constraints=dict(type="eq", fun=lambda x: x @ D @ x - 2, jac=lambda x: 2 * D @ x),
        options=dict(ftol=1e-15),
    )
    assert bool(minimum.is_minimum)
    np.testing.assert_allclose(minimum.x, theirs.x, atol=1e-6)
    np.testing.assert_allclose(minimum.objective, theirs.fun, rtol=1e-12)
    assert float(minimum.objective) <= float(height(split(jnp.asarray(x0)), q))


@pytest.mark.parametrize(("axis", "curvature"), [(1, -1.0), (2, -4.0)])
def test_a_saddle_or_maximum_is_not_called_a_minimum(axis, curvature):
    minimum = descend(Quadratic(np.diag([1.0, 2.0, 5.0])), np.eye(3)[axis])
    assert minimum.result == SUCCESS
    assert float(minimum.flow_time) == 0
    np.testing.assert_allclose(minimum.curvature, curvature, rtol=1e-14)
    assert not bool(minimum.is_minimum)


def test_a_valley_floor_is_not_certified():
    """The least eigenvalue is double: every point of a circle is a minimum, none is strict."""
    minimum = descend(Quadratic(np.diag([1.0, 1.0, 5.0])), [0.0, 0.6, 0.8])
    assert minimum.result == SUCCESS
    np.testing.assert_allclose(minimum.x, [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(minimum.curvature, 0, atol=1e-14)
    assert not bool(minimum.is_minimum)


def test_start_at_the_minimum_without_constraint():
    """grad f = 0 there up to rounding errors, which must not be taken for a slope."""
    q = Quadratic(SYMMETRIC, b=-SYMMETRIC @ np.array([0.6, 0.0, 0.8]))
    minimum = descend(q, [0.6, 0.0, 0.8])
    assert minimum.result == SUCCESS
    assert bool(minimum.is_minimum)
    np.testing.assert_allclose(minimum.multipliers, 0, atol=1e-15)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_of_the_objective_do_not_matter(scale):
    q = Quadratic(scale * SYMMETRIC, scale * np.array([0.3, 0.1, -0.2]))
    reference = descend(Quadratic(SYMMETRIC, [0.3, 0.1, -0.2]), [0.0, 0.6, 0.8])
    minimum = descend(q, [0.0, 0.6, 0.8], t1=1e9)
    assert bool(minimum.is_minimum)
    np.testing.assert_allclose(minimum.x, reference.x, atol=1e-13)
    np.testing.assert_allclose(minimum.multipliers, scale * reference.multipliers, rtol=1e-12)


@pytest.mark.parametrize(
    ("q", "x0", "t1", "message", "code"),
    [
        (Quadratic(), [1.1, 0.0, 0.0], 1e6, "`x0` does not satisfy.*mj.consistent_state", FAILURE),
        (Quadratic(c=0.0), np.zeros(3), 1e6, "does not have full rank at `x0`", FAILURE),
        (Quadratic(), [np.nan, 0, 1], 1e6, "`constraint` is not finite at `x0`", FAILURE),
        (Quadratic(b=[np.inf, 0, 0]), [0, 0, 1], 1e6, "`objective` or its gradient", FAILURE),
        (
            Quadratic(SYMMETRIC), [0, 0, 1], 0.1, "`t1` came before",
            dfx.RESULTS.nonlinear_max_steps_reached,
        ),
    ],
)  # fmt: skip
def test_flow_errors_and_their_codes(q, x0, t1, message, code):
    with pytest.raises(RuntimeError, match=f"(?s){message}"):
        flow_loudly(q, jnp.asarray(x0, float), jnp.asarray(t1))
    minimum = descend(q, x0, t1=t1)
    assert minimum.result == code
    assert not bool(minimum.is_minimum)


def test_one_flow_equals_a_batch():
    q, x0 = Quadratic(SYMMETRIC, [0.0, 0.0, 1.0]), jnp.array([0.0, 0.6, 0.8])
    (single, *_), batched = flow_loudly(q, x0, jnp.asarray(1e6)), descend(q, x0)
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(batched)):
        # The number of steps at a minimum is decided by rounding.
        rtol = 1e-2 if np.issubdtype(np.asarray(a).dtype, np.integer) else 1e-9
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-13)


def test_derivatives_of_a_minimizer():
    """The implicit function theorem for (Q + 2 lambda D) x + b = 0, x.D x = c by hand; the
    derivatives of the minimum are those of the Lagrangian at fixed x (envelope theorem)."""
    D = np.array([[1.0, 0.2, 0.0], [0.2, 0.5, 0.1], [0.0, 0.1, 2.0]])
    q = Quadratic(SYMMETRIC, [0.3, -0.2, 0.1], D, 2.0)
    minimum, *jacobians = flow_loudly(q, jnp.array([0.0, 0.0, 1.0]), jnp.asarray(1e6))
    x, multiplier = np.asarray(minimum.x), float(minimum.multipliers[0])
    kkt = np.block([[SYMMETRIC + 2 * multiplier * D, 2 * (D @ x)[:, None]], [2 * x @ D, 0]])
    e = np.eye(3)
    # d((Q x)_k) / dQ_ij with 0.5 x.Q x = 0.5 Q_ij x_i x_j, not assuming symmetry
    dQ = (np.einsum("ki,j->kij", e, x) + np.einsum("kj,i->kij", e, x)).reshape(3, 9) / 2
    by_Q, by_D = (
        np.append(dQ, np.zeros((1, 9)), 0),
        np.append(2 * multiplier * dQ, np.outer(x, x).reshape(1, 9), 0),
    )
    by_b, by_c = np.eye(4)[:, :3], -np.eye(4)[:, 3:]
    implicit = -np.linalg.solve(kkt, np.concatenate([by_Q, by_b, by_D, by_c], axis=1))
    xx = np.outer(x, x).ravel()
    envelope = np.concatenate([xx / 2, x, multiplier * xx, [-multiplier]])
    end = lambda c: descend(Quadratic(q.Q, q.b, q.D, c), [0.0, 0.0, np.sqrt(c / 2)]).x
    difference = (end(2.001) - end(1.999)) / 0.002
    for jacobian in jacobians:
        np.testing.assert_allclose(jacobian[:3, -1], difference, atol=1e-6)
        np.testing.assert_allclose(jacobian[:4], implicit, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(jacobian[4], envelope, rtol=1e-12, atol=1e-13)


@pytest.mark.slow
def test_second_derivatives_and_closures():
    """The derivative of the envelope theorem; `c` is closed over, `b` is in `args`."""

    def minimum(theta):
        constraint = mj.Constraint(lambda t, x, args: x @ x - theta[3])
        f = lambda x, b: 0.5 * x @ SYMMETRIC @ x + b @ x
        x0 = jnp.array([0.0, 0.6, 0.8]) * jnp.sqrt(theta[3])
        return mj.gradient_flow(f, constraint, x0, theta[:3], throw=False)

    theta = jnp.array([0.3, -0.2, 0.1, 1.3])
    hessian = jax.jit(jax.jacfwd(jax.grad(lambda theta: minimum(theta).objective)))(theta)
    at = minimum(theta)
    kkt = np.zeros((4, 4))
    kkt[:3, :3] = SYMMETRIC + 2 * float(at.multipliers[0]) * np.eye(3)
    kkt[:3, 3] = kkt[3, :3] = 2 * np.asarray(at.x)
    signs = np.diag([1.0, 1.0, 1.0, -1.0])
    np.testing.assert_allclose(hessian, -signs @ np.linalg.inv(kkt) @ signs, rtol=1e-9, atol=1e-11)


# Hock & Schittkowski, Test Examples for Nonlinear Programming Codes (1981).


def test_hock_schittkowski_51_and_52_in_one_batch():
    """Least squares with linear constraints, five unknowns; f = 0 and 1859/349."""
    A = np.array([[1.0, -1, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]])
    A = np.stack([A, A + np.eye(4, 5) * [3, 0, 0, 0, 0]])
    C = np.array([[1.0, 3, 0, 0, 0], [0, 0, 1, 1, -2], [0, 1, 0, 0, -1]])
    d = np.array([[4.0, 0, 0], [0, 0, 0]])
    x0 = np.array([[2.5, 0.5, 2, -1, 0.5], [0, 0, 0, 0, 0]])

    def solve(A, d, x0):
        f = lambda x, args: jnp.sum((A @ x - jnp.array([0.0, 2, 1, 1])) ** 2)
        return mj.gradient_flow(f, mj.Constraint(lambda t, x, args: C @ x - d), x0, throw=False)

    minima = jax.jit(jax.vmap(solve))(*(jnp.asarray(v) for v in (A, d, x0)))
    assert np.all(minima.is_minimum)
    expected = [np.ones(5), np.array([-33, 11, 180, -158, 11]) / 349]
    np.testing.assert_allclose(minima.x, expected, atol=1e-13)
    np.testing.assert_allclose(minima.objective, [0, 1859 / 349], rtol=1e-13, atol=1e-25)
    residual = 2 * np.einsum("bij,bi->bj", A, np.einsum("bij,bj->bi", A, expected) - [0, 2, 1, 1])
    multipliers = [-np.linalg.lstsq(C.T, r, rcond=None)[0] for r in residual]
    np.testing.assert_allclose(minima.multipliers, multipliers, atol=1e-12)


# Objective, constraint, start (theirs, or another that can be made feasible), optimum.
HOCK_SCHITTKOWSKI = {
    "HS6": (
        lambda x: (1 - x[0]) ** 2,
        lambda x: 10 * (x[1] - x[0] ** 2),
        [-1.2, 1.0], [1.0, 1.0],
    ),
    "HS7": (
        lambda x: jnp.log(1 + x[0] ** 2) - x[1],
        lambda x: (1 + x[0] ** 2) ** 2 + x[1] ** 2 - 4,
        [0.5, -1.0], [0.0, np.sqrt(3)],
    ),
    "HS27": (
        lambda x: 0.01 * (x[0] - 1) ** 2 + (x[1] - x[0] ** 2) ** 2,
        lambda x: x[0] + x[2] ** 2 + 1,
        [-2.0, 2.0, 1.0], [-1.0, 1.0, 0.0],
    ),
    "HS28": (
        lambda x: (x[0] + x[1]) ** 2 + (x[1] + x[2]) ** 2,
        lambda x: x[0] + 2 * x[1] + 3 * x[2] - 1,
        [-4.0, 1.0, 1.0], [0.5, -0.5, 0.5],
    ),
    "HS39": (
        lambda x: -x[0],
        lambda x: jnp.stack([x[1] - x[0] ** 3 - x[2] ** 2, x[0] ** 2 - x[1] - x[3] ** 2]),
        [0.5, 0.2, 0.3, 0.3], [1.0, 1.0, 0.0, 0.0],
    ),
    "HS40": (
        lambda x: -jnp.prod(x),
        lambda x: jnp.stack([x[0] ** 3 + x[1] ** 2 - 1, x[0] ** 2 * x[3] - x[2], x[3] ** 2 - x[1]]),
        [0.8, 0.8, 0.8, 0.8], [2 ** (-1 / 3), 2**-0.5, 2 ** (-11 / 12), 2**-0.25],
    ),
    "HS48": (
        lambda x: (x[0] - 1) ** 2 + (x[1] - x[2]) ** 2 + (x[3] - x[4]) ** 2,
        lambda x: jnp.stack([jnp.sum(x) - 5, x[2] - 2 * (x[3] + x[4]) + 3]),
        [3.0, 5.0, -3.0, 2.0, -2.0], [1.0] * 5,
    ),
    "HS50": (
        lambda x: (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 2 + (x[2] - x[3]) ** 4
        + (x[3] - x[4]) ** 2,
        lambda x: x[:3] + 2 * x[1:4] + 3 * x[2:] - 6,
        [35.0, -31.0, 11.0, 5.0, -5.0], [1.0] * 5,
    ),
    "HS77": (
        lambda x: (x[0] - 1) ** 2 + (x[0] - x[1]) ** 2 + (x[2] - 1) ** 2 + (x[3] - 1) ** 4
        + (x[4] - 1) ** 6,
        lambda x: jnp.stack([
            x[0] ** 2 * x[3] + jnp.sin(x[3] - x[4]) - 2 * np.sqrt(2),
            x[1] + x[2] ** 4 * x[3] ** 2 - 8 - np.sqrt(2),
        ]),
        [2.0] * 5, [1.166172, 1.182111, 1.380257, 1.506036, 0.6109203],
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", HOCK_SCHITTKOWSKI)
def test_hock_schittkowski(name):
    f, g, start, optimum = HOCK_SCHITTKOWSKI[name]
    constraint = mj.Constraint(lambda t, x, args: g(x))
    x0, _ = mj.consistent_state(constraint, 0.0, jnp.asarray(start))
    minimum = mj.gradient_flow(lambda x, args: f(x), constraint, x0)
    assert bool(minimum.is_minimum)
    np.testing.assert_allclose(minimum.x, optimum, atol=1e-12 if name != "HS77" else 1e-6)
    assert float(minimum.violation) < 1e-13
    assert float(minimum.stationarity) < 1e-12


@pytest.mark.slow
def test_hock_schittkowski_42_on_a_pytree():
    """Several constraints, nested state: (2, 2, 0.6 sqrt 2, 0.8 sqrt 2), f = 28 - 10 sqrt 2."""

    def f(x, args):
        return jnp.sum((x["a"] - jnp.array([1.0, 2.0])) ** 2) + jnp.sum((x["b"][0] - args) ** 2)

    constraint = mj.Constraint(lambda t, x, args: (x["a"][0] - 2, x["b"][0] @ x["b"][0] - 2))
    x0 = {"a": jnp.array([2.0, -1.0]), "b": [jnp.array([1.0, -1.0])]}
    minimum = mj.gradient_flow(f, constraint, x0, jnp.array([3.0, 4.0]))
    assert bool(minimum.is_minimum)
    np.testing.assert_allclose(minimum.x["a"], [2, 2], atol=1e-14)
    np.testing.assert_allclose(minimum.x["b"][0], np.sqrt(2) * np.array([0.6, 0.8]), atol=1e-14)
    np.testing.assert_allclose(minimum.objective, 28 - 10 * np.sqrt(2), rtol=1e-14)
    # 2 (a_1 - 1) + lambda_1 = 0,  2 (b - c) + 2 lambda_2 b = 0
    np.testing.assert_allclose(minimum.multipliers, [-2, 5 / np.sqrt(2) - 1], rtol=1e-13)


DEGENERATE = {
    "HS26": (
        lambda x, args: (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 4,
        lambda t, x, args: (1 + x[1] ** 2) * x[0] + x[2] ** 4 - 3,
        [-2.6, 2.0, 2.0],
        1.0,
    ),
    "no minimum": (lambda x, args: x[0] ** 3, lambda t, x, args: x[1], [1.0, 0.0], 0.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_points_are_not_certified(name):
    """The curvature is positive on the way and zero only at the point itself, which the flow
    approaches slowly: a minimum of fourth order, and a point of inflection."""
    f, g, start, end = DEGENERATE[name]
    x0, _ = mj.consistent_state(mj.Constraint(g), 0.0, jnp.asarray(start))
    minimum = mj.gradient_flow(f, mj.Constraint(g), x0)
    assert minimum.result == SUCCESS
    np.testing.assert_allclose(minimum.x, end, atol=1e-2)
    assert not bool(minimum.is_minimum)


@pytest.mark.slow
def test_as_many_constraints_as_unknowns():
    """Nothing is left to minimize: any feasible point is a strict minimum."""
    constraint = mj.Constraint(lambda t, x, args: jnp.stack([x[0] - 1, x @ x - 2]))
    minimum = mj.gradient_flow(lambda x, args: x[1], constraint, jnp.ones(2))
    assert bool(minimum.is_minimum)
    assert float(minimum.curvature) == np.inf
    # (0, 1) + lambda_1 (1, 0) + lambda_2 (2, 2) = 0
    np.testing.assert_allclose(minimum.multipliers, [1.0, -0.5], rtol=1e-14)


@pytest.mark.slow
def test_objective_without_a_minimum():
    constraint = mj.Constraint(lambda t, x, args: x[1])
    with pytest.raises(RuntimeError):
        mj.gradient_flow(lambda x, args: x[0], constraint, jnp.zeros(2))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(objective=1.0), TypeError, "`objective`.*float"),
        (dict(objective=lambda x, a: x), ValueError, r"`objective`.*sum.*shape \(2,\)"),
        (dict(objective=lambda x, a: (x[0],)), ValueError, "`objective`.*tuple"),
        (dict(objective=lambda x, a: jnp.asarray(1)), TypeError, "`objective`.*int"),
        (dict(constraint=lambda t, x, a: x[0]), TypeError, "`constraint`.*mj.Constraint"),
        (dict(constraint=mj.Constraint(lambda t, x, a: jnp.ones(3))), ValueError, "3 residuals"),
        (
            dict(constraint=mj.Constraint(lambda t, x, a: x @ x - 1, redundant=True)),
            ValueError,
            "`constraint` has `redundant=True`.*independent",
        ),
        (dict(x0=np.array([1, 0])), TypeError, "`x0`.*int64"),
        (dict(x0=()), ValueError, "`x0` has no array leaves"),
        (dict(tolerance=0.0), ValueError, "`tolerance`.*between 0 and 1"),
        (dict(solver=dfx.LeapfrogMidpoint()), ValueError, "`solver=LeapfrogMidpoint"),
    ],
)
def test_flow_arguments(change, error, message, as_a_user_meets_it):
    arguments = dict(
        objective=lambda x, a: x[0],
        constraint=mj.Constraint(lambda t, x, a: x @ x - 1),
        x0=jnp.array([1.0, 0.0]),
    )
    with pytest.raises(error, match=f"(?s){message}"):
        mj.gradient_flow(**{**arguments, **change})
