"""A car axis on a bumpy road: constrained mechanics with a time-dependent constraint."""

from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._constraint import Constraint
from .._custom_types import FloatScalar, RealScalarLike
from ._problem import Problem, require_standard


State: TypeAlias = tuple[Float[Array, "4"], Float[Array, "4"]]


class CarAxisArgs(NamedTuple):
    """Parameters of `car_axis`, all dimensionless as in the source."""

    mass: Any = 10.0
    epsilon: Any = 1e-2
    length: Any = 1.0
    spring_length: Any = 0.5
    road_amplitude: Any = 0.1
    road_frequency: Any = 10.0
    gravity: Any = 1.0


# Position and velocity at t = 3 for the standard parameters. Source: Test Set for IVP
# Solvers, problem caraxis, the version printed with 21 digits. Right to 2e-13 (position)
# and 5e-12 (velocity; the worst is the second component).
END = (
    (
        0.493455784275402809122e-1,
        0.496989460230171153861,
        0.104174252488542151681e1,
        0.373911027265361256927,
    ),
    (
        -0.770583684040972357970e-1,
        0.744686658723778553466e-2,
        0.175568157537232222276e-1,
        0.770341043779251976443,
    ),
)


class _Road(NamedTuple):
    """The right wheel `(x, y)` and its first and second time derivatives."""

    x: FloatScalar
    y: FloatScalar
    dx: FloatScalar
    dy: FloatScalar
    ddx: FloatScalar
    ddy: FloatScalar


def _road(t: RealScalarLike, args: CarAxisArgs) -> _Road:
    r, w = args.road_amplitude, args.road_frequency
    y, dy = r * jnp.sin(w * t), r * w * jnp.cos(w * t)
    ddy = -(w**2) * y
    x = jnp.sqrt(args.length**2 - y**2)
    dx = -y * dy / x
    ddx = -(dy**2 + y * ddy + dx**2) / x
    return _Road(x, y, dx, dy, ddx, ddy)


def _field(t: RealScalarLike, y: State, args: CarAxisArgs) -> State:
    q, v = y
    road = _road(t, args)
    xl, yl, xr, yr = q[0], q[1], q[2], q[3]
    vxl, vyl, vxr, vyr = v[0], v[1], v[2], v[3]
    # accelerations by springs and gravity alone; the mass matrix is k times the identity
    k = args.mass * args.epsilon**2 / 2
    left = (args.spring_length / jnp.sqrt(xl**2 + yl**2) - 1) / k
    right = (args.spring_length / jnp.sqrt((xr - road.x) ** 2 + (yr - road.y) ** 2) - 1) / k
    axl, ayl = left * xl, left * yl - args.gravity
    axr, ayr = right * (xr - road.x), right * (yr - road.y) - args.gravity
    # rows of J = d phi / d q: (xb, yb, 0, 0) and 2 (dx, dy, -dx, -dy);
    # right-hand side J a_free + gamma, where J a + gamma = phi''
    dx, dy = xl - xr, yl - yr
    rhs1 = road.x * axl + road.y * ayl + road.ddx * xl + road.ddy * yl
    rhs1 = rhs1 + 2 * (road.dx * vxl + road.dy * vyl)
    rhs2 = 2 * (dx * (axl - axr) + dy * (ayl - ayr) + (vxl - vxr) ** 2 + (vyl - vyr) ** 2)
    # Schur complement J J^T (2 x 2) by Cramer's rule: mu = lambda / k
    s11 = road.x**2 + road.y**2
    s12 = 2 * (road.x * dx + road.y * dy)
    s22 = 8 * (dx**2 + dy**2)
    determinant = s11 * s22 - s12**2
    mu1 = (s22 * rhs1 - s12 * rhs2) / determinant
    mu2 = 2 * (s11 * rhs2 - s12 * rhs1) / determinant
    acceleration = [
        axl - mu1 * road.x - mu2 * dx,
        ayl - mu1 * road.y - mu2 * dy,
        axr + mu2 * dx,
        ayr + mu2 * dy,
    ]
    return v, jnp.stack(acceleration)


def _residual(
    t: RealScalarLike, y: State, args: CarAxisArgs
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    q, v = y
    road = _road(t, args)
    xl, yl, dx, dy = q[0], q[1], q[0] - q[2], q[1] - q[3]
    position = [road.x * xl + road.y * yl, dx**2 + dy**2 - args.length**2]
    velocity = [
        road.x * v[0] + road.y * v[1] + road.dx * xl + road.dy * yl,
        2 * (dx * (v[0] - v[2]) + dy * (v[1] - v[3])),
    ]
    return jnp.stack(position), jnp.stack(velocity)


def _initial_state(args: CarAxisArgs, start: State | None) -> State:
    if start is not None:
        return start
    L, height = args.length, args.spring_length
    zero = jnp.zeros_like(L)
    # At t = 0 the wheel is at (L, 0) and rises with r w, so that the axis has to turn:
    # xb xl' + yb' yl = 0. For the standard parameters the speed is -1/2.
    speed = -args.road_amplitude * args.road_frequency * height / L
    return jnp.stack([zero, height, L, height]), jnp.stack([speed, zero, speed, zero])


def _make_constraint(args: CarAxisArgs, y0: State) -> Constraint:
    del args, y0
    return Constraint(_residual)


def _exact(t: np.ndarray, args: CarAxisArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    standard = (np.array([0.0, 0.5, 1.0, 0.5]), np.array([-0.5, 0.0, -0.5, 0.0]))
    require_standard("car-axis", (CarAxisArgs(), standard), (args, y0))
    q, v = END
    return np.tile(np.array(q), (t.size, 1)), np.tile(np.array(v), (t.size, 1))


def car_axis(
    *,
    mass: Any = 10.0,
    epsilon: Any = 1e-2,
    length: Any = 1.0,
    spring_length: Any = 0.5,
    road_amplitude: Any = 0.1,
    road_frequency: Any = 10.0,
    gravity: Any = 1.0,
) -> Problem:
    r"""A car axis between two springs on a bumpy road (index 3).

    $q = (x_l, y_l, x_r, y_r)$ are the ends of the axis. The left wheel stays at the
    origin, the right one rides over the road at $(x_b, y_b)$,
    $y_b = r \sin \omega t$, $x_b = (L^2 - y_b^2)^{1/2}$:

    $$k q'' = Q(t, q) - J^T \lambda, \quad k = M \epsilon^2 / 2, \quad
    x_b x_l + y_b y_l = 0, \quad |q_l - q_r|^2 = L^2,$$

    with forces `(L0 - l) / l` times the vector along each spring of length `l` and
    `-k g` on both ends of the axis. The state is `(q, v)`, each of shape `(4,)`; four
    constraints, two positions and two velocities, all depending on time.

    From `q = (0, L0, L, L0)` with the velocity `(s, 0, s, 0)`, `s = -r w L0 / L`, that the
    moving road asks for, to `t = 3`. The state at the end alone is known
    (`reference_at_end_only`), for the standard parameters and initial state: position to
    2e-13, velocity to 5e-12.

    **Arguments:**

    - `mass` M, `epsilon`, `length` L of the axis and of the wheel base, `spring_length`
        L0, `road_amplitude` r, `road_frequency` w, `gravity` g: scalars, `args`.
        `with_args` rebuilds the standard initial state; one of yours is kept.

    Known traps: of the 21 printed digits 12 are right, fewer in the velocity; the source
    prints multipliers with the opposite sign (`K q'' = f + J^T lambda`).

    Source: Mazzia & Magherini, Test Set for Initial Value Problem Solvers, problem
    caraxis.
    """
    return Problem(
        "car-axis",
        diffrax.ODETerm(_field),
        t1=3.0,
        args=CarAxisArgs(
            mass,
            epsilon,
            length,
            spring_length,
            road_amplitude,
            road_frequency,
            gravity,
        ),
        initial_state=_initial_state,
        make_constraint=_make_constraint,
        exact=_exact,
        at_end_only=True,
    )
