"""A rigid body in space for long runs: a heavy top whose attitude is a unit quaternion."""

from typing import Any

import numpy as np

import manifold_jax as mj

from ._long_time_task import methods_of, Task


def quaternion_top() -> Task:
    """The symmetric top of the gallery, released tilted, turning about its axis at 12 rad/s."""
    problem = mj.problems.heavy_top()
    args = problem.args
    inertia, center = np.asarray(args.inertia), np.asarray(args.center)
    weight = float(args.mass * args.gravity)

    def field(t: float, y: np.ndarray) -> np.ndarray:
        """Euler's equations, and `q'' = (G(q')^T w + G(q)^T w') / 2`."""
        q, v = y[:4], y[4:]
        w = 2 * rates(q) @ v
        torque = weight * np.cross(up(q), center)
        turning = (np.cross(inertia * w, w) + torque) / inertia
        return np.concatenate([v, (w @ rates(v) + turning @ rates(q)) / 2])

    def spin(q: Any, v: Any) -> Any:
        return 2 * np.einsum("...ij,...j->...i", rates(q), v)

    def energy(q: Any, v: Any) -> Any:
        return (inertia * spin(q, v) ** 2).sum(-1) / 2 + weight * (center * up(q)).sum(-1)

    def momentum(q: Any, v: Any) -> Any:
        """About the vertical axis, and about that of the top."""
        own = inertia * spin(q, v)
        return np.stack([(own * up(q)).sum(-1), own[..., 2]], axis=-1)

    relative = lambda of: lambda q, v: of(np.asarray(q), np.asarray(v)) / np.abs(of(*y0)).max()
    y0 = tuple(np.asarray(leaf) for leaf in problem.y0)
    violation = lambda q, v: np.maximum(
        np.abs(np.linalg.norm(q, axis=-1) - 1),
        np.abs((q * v).sum(-1)) / np.maximum(np.linalg.norm(v, axis=-1), 1),
    )
    system = problem.system
    with_args = mj.MechanicalSystem(
        lambda q, _: system.mass_matrix.function(q, args),
        lambda t, q, _: system.holonomic(t, q, args),
        lambda t, q, v, _: system.force(t, q, v, args),
    )
    return Task(
        "top, a quaternion",
        with_args.terms,
        methods_of(with_args),
        2**-8,
        problem.y0,
        {"energy": relative(energy), "angular momentum": relative(momentum)},
        "energy",
        violation,
        field,
        0.1,
    )


def rates(p: Any) -> np.ndarray:
    """Return `G(p)`: the angular velocity in the body is `2 G(p) p'`."""
    a, b, c, d = np.moveaxis(np.asarray(p), -1, 0)
    rows = [[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def up(p: Any) -> np.ndarray:
    """Return the vertical in the body."""
    a, b, c, d = np.moveaxis(np.asarray(p), -1, 0)
    vertical = [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d]
    return np.stack(vertical, axis=-1)
