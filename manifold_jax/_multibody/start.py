"""States of an assembly: from what a user says of some bodies, and whether they satisfy the joints.

Source of the assembly analysis: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems
(1989), ch. 4, here with steps of least norm.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._base.types import Args
from .bodies import check_orientation, Pose
from .checks import check_number, check_vector, is_concrete, stack
from .rotations import rates_matrix, rotation_matrix
from .traced_start import assemble_traced


# Joints count as closed below this gap (m, or the cosine of an angle), or this many units of rounding.
CLOSED, ROUNDING = 1e-6, 50
ITERATIONS = 50
# Singular values below this fraction of the largest belong to equations that depend on others; at
# least a hundred units of rounding.
DEPENDENT = 1e-9


def _closed(x: np.ndarray) -> float:
    largest = float(np.abs(x).max(initial=1))
    return max(CLOSED, ROUNDING * float(np.finfo(x.dtype).eps) * largest)


def _dependent(J: np.ndarray) -> float:
    return max(DEPENDENT, 100 * float(np.finfo(J.dtype).eps))


def make_state(
    assembly: Any, given: tuple, assemble: bool, t: Array, args: Args
) -> tuple[Pose, Pose]:
    y, fixed = _with_given(assembly, given)
    if not all(is_concrete(leaf) for leaf in jtu.tree_leaves((y, assembly, t, args))):
        if not assemble:
            return y
        names = _named_rows(assembly, t, args)
        eps = float(jnp.finfo(y[0].position.dtype).eps)
        closed = max(CLOSED, ROUNDING * eps)
        return assemble_traced(assembly, y, fixed, t, args, names, ITERATIONS, closed)
    find = _Host(assembly, y, fixed, t, args)
    if assemble:
        y = find.assembled(y)
    find.check(y)
    return y


def _with_given(assembly: Any, given: tuple) -> tuple[tuple[Pose, Pose], tuple[Pose, Pose]]:
    """The state, and where it was given."""
    bodies = assembly.bodies
    q, planar = bodies.drawing, bodies.planar
    positions, orientations, velocities, spins = given
    d = 2 if planar else 3
    vector = lambda what, value: check_vector(what, value, d)
    turned = lambda what, value: check_orientation(what, value, planar)
    spin = check_number if planar else vector
    x, has_x = _place(bodies, q.position, positions, "positions", vector)
    p, has_p = _place(bodies, q.orientation, orientations, "orientations", turned)
    still = np.zeros((len(bodies.names), 3), q.coordinates.dtype)
    u, has_u = _place(bodies, still[:, :d], velocities, "velocities", vector)
    no_spin = still[:, 0] if planar else still
    w, has_w = _place(bodies, no_spin, spins, "angular_velocities", spin)
    rate = w if planar else quaternion_rate(p, w)
    spread = lambda has, like: np.broadcast_to(has.reshape(-1, *(1,) * (like.ndim - 1)), like.shape)
    fixed = Pose(spread(has_x, x), spread(has_p, p)), Pose(spread(has_u, x), spread(has_w, p))
    return (Pose(x, p), Pose(u, rate)), fixed


@jax.jit
def quaternion_rate(p: Any, spin: Any) -> Any:
    """`p' = G(p)^T R(p)^T omega / 2` of angular velocities in space, `(..., 3)`."""
    local = jnp.sum(rotation_matrix(p) * spin[..., :, None], axis=-2)
    return jnp.sum(rates_matrix(p) * local[..., :, None], axis=-2) / 2


def _place(
    bodies: Any, rows: Any, words: Any, what: str, checked: Callable
) -> tuple[Array, np.ndarray]:
    """The rows with those that are given by name, and which are."""
    words = {} if words is None else words
    if not isinstance(words, dict):
        raise TypeError(f"`{what}` must be a dictionary of names of bodies, got {words!r}.")
    has = np.zeros(len(bodies.names), bool)
    rows = list(np.asarray(rows) if is_concrete(rows) else rows)
    for name, value in words.items():
        i = bodies.moving_index(name, f"`{what}`")
        rows[i], has[i] = checked(f"`{what}` of {name!r}", value), True
    return stack(rows), has


class _Host:
    """The equations of an assembly and their Jacobians as NumPy arrays."""

    def __init__(
        self, assembly: Any, y: tuple[Pose, Pose], fixed: tuple[Pose, Pose], t: Array, args: Args
    ):
        self.assembly, self.fixed, self.at = assembly, fixed, (t, args)
        self.unravel = jfu.ravel_pytree(y[0])[1]
        phi = lambda t, x: jfu.ravel_pytree(assembly._equations(t, self.unravel(x), args))[0]
        rate = lambda x: jax.jvp(lambda t: phi(t, x), (t,), (jnp.ones_like(t),))
        self.equations: Callable = jax.jit(lambda x: (*rate(x), jax.jacfwd(phi, 1)(t, x)))

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals, their rates while nothing moves (that of drives), and their Jacobian."""
        phi, rate, J = map(np.asarray, self.equations(x))
        return phi, rate, J

    def assembled(self, y: tuple[Pose, Pose]) -> tuple[Pose, Pose]:
        """Gauss-Newton steps of least norm in what is free; velocities by one."""
        x, w = (np.array(jfu.ravel_pytree(part)[0]) for part in y)
        kept_x, kept_w = (
            np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(part)])
            for part in self.fixed
        )
        for _ in range(ITERATIONS):
            phi, _, J = self(x)
            if np.abs(phi).max(initial=0) < 10 * np.finfo(x.dtype).eps:
                break
            x[~kept_x] -= np.linalg.lstsq(J[:, ~kept_x], phi, rcond=_dependent(J))[0]
        self.check_positions(x, " Whatever the other bodies do, the joints cannot be closed")
        _, rate, J = self(x)
        w[~kept_w] -= np.linalg.lstsq(J[:, ~kept_w], rate + J @ w, rcond=_dependent(J))[0]
        return self.unravel(jnp.asarray(x)), self.unravel(jnp.asarray(w))

    def check(self, y: tuple[Pose, Pose]) -> None:
        x, w = (np.array(jfu.ravel_pytree(part)[0]) for part in y)
        self.check_positions(x, "")
        _, driven, J = self(x)
        rate = np.abs(driven + J @ w)
        most = _closed(x) * max(1, np.abs(w).max())
        if not rate.max(initial=0) <= most:
            worst = self._worst(rate, most, "m/s")
            raise ValueError(
                f"The velocities do not agree with the joints: {worst}. Give only those that are known, "
                "such that joints allow them, and `assemble=True`."
            )
        if not self.assembly.redundant:
            self._check_rank(J)

    def check_positions(self, x: np.ndarray, reason: str) -> None:
        gap = np.abs(self(x)[0])
        if not gap.max(initial=0) <= _closed(x):
            advice = (
                f"{reason}: check lengths and points, or give less."
                if reason
                else " Give `assemble=True` to close them, or correct positions and orientations."
            )
            raise ValueError(
                f"The state does not satisfy the joints: {self._worst(gap, _closed(x), 'm')}.{advice}"
            )

    def _worst(self, size: np.ndarray, most: float, unit: str) -> str:
        named = _named_rows(self.assembly, *self.at)
        largest = [size[rows].max() for _, rows in named]
        order = np.argsort(largest)[::-1][:5]
        worst = [(named[i][0], largest[i]) for i in order if not largest[i] <= most]
        return ", ".join(f"{name} (gap {gap:.3g} {unit})" for name, gap in worst)

    def _check_rank(self, J: np.ndarray) -> None:
        J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), np.finfo(J.dtype).tiny)
        left, sizes, _ = np.linalg.svd(J, full_matrices=True)
        rank = int(np.sum(sizes > _dependent(J) * sizes.max(initial=1)))
        if rank == J.shape[0]:
            return
        among = np.abs(left[:, rank:]).max(axis=1)
        named = _named_rows(self.assembly, *self.at)
        names = [name for name, rows in named if among[rows].max() > 1e-6]
        raise ValueError(
            f"{J.shape[0] - rank} of the {J.shape[0]} equations of the joints depend on others in this pose, among those of "
            f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}. If they do so in every pose (closed loops), "
            "write `Assembly(..., redundant=True)`; if in this one alone, start beside it."
        )


def _named_rows(assembly: Any, t: Array, args: Args) -> list[tuple[str, np.ndarray]]:
    """The rows of every joint among the equations."""
    named, start = [], 0
    at_drawing = lambda: assembly._equations(t, assembly.bodies.drawing, args)
    for group, part in zip(assembly.joints, jax.eval_shape(at_drawing), strict=False):
        rows = start + np.arange(part.size).reshape(part.shape)
        named += list(zip(group.attachment.names, rows, strict=True))
        start += part.size
    norms = assembly.bodies.names if not assembly.bodies.planar else ()
    named += [(f"norm of {name!r}", np.array([start + i])) for i, name in enumerate(norms)]
    return named
