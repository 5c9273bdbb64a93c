"""A car axis on a bumpy road: constrained mechanics with a time-dependent constraint."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import Problem, require_standard


Vector: TypeAlias = Float[Array, "4"]
State: TypeAlias = tuple[Vector, Vector]


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
    (0.493455784275402809122e-1, 0.496989460230171153861,
     0.104174252488542151681e1, 0.373911027265361256927),
    (-0.770583684040972357970e-1, 0.744686658723778553466e-2,
     0.175568157537232222276e-1, 0.770341043779251976443),
)  # fmt: skip


def _mass(q: Vector, args: CarAxisArgs) -> FloatScalar:
    return args.mass * args.epsilon**2 / 2


def _wheel(t: RealScalarLike, args: CarAxisArgs) -> tuple[FloatScalar, FloatScalar]:
    """Return the position of the right wheel, on the road."""
    y = args.road_amplitude * jnp.sin(args.road_frequency * t)
    return jnp.sqrt(args.length**2 - y**2), y


def _linkage(t: RealScalarLike, q: Vector, args: CarAxisArgs) -> Float[Array, "2"]:
    wheel_x, wheel_y = _wheel(t, args)
    dx, dy = q[0] - q[2], q[1] - q[3]
    return jnp.stack([wheel_x * q[0] + wheel_y * q[1], dx**2 + dy**2 - args.length**2])


def _force(t: RealScalarLike, q: Vector, v: Vector, args: CarAxisArgs) -> Vector:
    wheel_x, wheel_y = _wheel(t, args)
    xl, yl, xr, yr = q[0], q[1], q[2] - wheel_x, q[3] - wheel_y
    left = args.spring_length / jnp.sqrt(xl**2 + yl**2) - 1
    right = args.spring_length / jnp.sqrt(xr**2 + yr**2) - 1
    weight = _mass(q, args) * args.gravity
    return jnp.stack([left * xl, left * yl - weight, right * xr, right * yr - weight])


def _initial_state(args: CarAxisArgs, start: State | None) -> State:
    if start is not None:
        return start
    L, height = args.length, args.spring_length
    zero = jnp.zeros_like(L)
    # At t = 0 the wheel is at (L, 0) and rises with r w, so that the axis has to turn:
    # xb xl' + yb' yl = 0. For the standard parameters the speed is -1/2.
    speed = -args.road_amplitude * args.road_frequency * height / L
    return jnp.stack([zero, height, L, height]), jnp.stack([speed, zero, speed, zero])


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

    $q = (x_l, y_l, x_r, y_r)$ are the ends of the axis. The left wheel stays at the origin, the right
    one rides over the road at $(x_b, y_b)$, $y_b = r \sin \omega t$, $x_b = (L^2 - y_b^2)^{1/2}$:

    $$k q'' = Q(t, q) - J^T \lambda, \quad k = M \epsilon^2 / 2, \quad
    x_b x_l + y_b y_l = 0, \quad |q_l - q_r|^2 = L^2,$$

    with forces `(L0 - l) / l` times the vector along each spring of length `l` and
    `-k g` on both ends of the axis. The state is `(q, v)`, each of shape `(4,)`; four
    constraints, two positions and two velocities, all depending on time.

    From `q = (0, L0, L, L0)` with the velocity `(s, 0, s, 0)`, `s = -r w L0 / L`, that the moving road
    asks for, to `t = 3`. The state at the end alone is known (`reference_at_end_only`), for the
    standard parameters and initial state: position to 2e-13, velocity to 5e-12.

    **Arguments:**

    - `mass` M, `epsilon`, `length` L of the axis and of the wheel base, `spring_length`
        L0, `road_amplitude` r, `road_frequency` w, `gravity` g: scalars, `args`.
        `with_args` rebuilds the standard initial state; one of yours is kept.

    Known traps: of the 21 printed digits 12 are right, fewer in the velocity; the source
    prints multipliers with the opposite sign (`K q'' = f + J^T lambda`).

    Source: Mazzia & Magherini, Test Set for Initial Value Problem Solvers, problem caraxis.
    """
    args = CarAxisArgs(
        mass, epsilon, length, spring_length, road_amplitude, road_frequency, gravity
    )
    return Problem(
        "car-axis",
        system=MechanicalSystem(_mass, _linkage, _force),
        t1=3.0,
        args=args,
        initial_state=_initial_state,
        exact=_exact,
        reference_at_end_only=True,
    )
