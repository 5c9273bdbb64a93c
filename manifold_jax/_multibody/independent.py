"""The equations of joints that do not depend on others: closed loops have more than are needed."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from .bodies import Bodies
from .start import dependent_equations, LoopClosure


_POSES = 3
_DISPLACEMENTS = (
    1e-2,
    1e-3,
    1e-4,
)  # of coordinates, m or rad: the first from which the loops close again
_CLOSED = 1e-9


class Independent(eqx.Module):
    """The rows of equations that are solved, among those of all joints and norms."""

    rows: tuple[int, ...] = eqx.field(static=True)


def find_independent(assembly: Any) -> Independent | None:
    """Return a largest set of independent equations in the drawing, `None` if all are.

    By QR with pivoting of the rows of `J M^(-1/2)`, those of the linear systems that are solved. The rest
    must depend on them in poses nearby, too: then it follows from them.
    """
    passive = tuple(group for group in assembly.joints if group.motions is None)
    driven = sum(len(group.attachment.names) for group in assembly.joints) - sum(
        len(group.attachment.names) for group in passive
    )
    closure = _in_drawing(eqx.tree_at(lambda a: a.joints, assembly, passive))
    x = np.asarray(closure.x)
    _, _, J = closure.known(x)
    number, _ = dependent_equations(J)
    for nearby in _poses_nearby(closure, x, J):
        _, _, J_nearby = closure.known(nearby)
        elsewhere, _ = dependent_equations(J_nearby)
        if elsewhere != number:
            raise ValueError(
                f"{number} of the {J.shape[0]} equations of the joints depend on others in the drawing, and {elsewhere} "
                "nearby: the drawing is a singular pose, in which it is not determined how the mechanism moves on. Draw it in "
                "another one."
            )
    if number == 0:
        return None
    weighted = _weighted(assembly.bodies, J)
    sizes = np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), np.finfo(J.dtype).tiny)
    *_, order = scipy.linalg.qr((weighted / sizes).T, mode="r", pivoting=True)
    chosen = np.sort(order[: J.shape[0] - number])
    joints = J.shape[0] - (0 if assembly.bodies.planar else len(assembly.names))
    # The equations of drives, which are all solved, are between those of joints and the norms.
    drives, norms = joints + np.arange(driven), chosen[chosen >= joints] + driven
    rows = np.concatenate([chosen[chosen < joints], drives, norms])
    return Independent(tuple(rows.tolist()))


def _poses_nearby(closure: LoopClosure, x: np.ndarray, J: np.ndarray) -> Iterator[np.ndarray]:
    """Yield poses that are reached by small motions in random directions that the joints allow."""
    random, free = np.random.default_rng(0), scipy.linalg.null_space(J, rcond=1e-9)
    for _ in range(_POSES if free.size else 0):
        direction = free @ random.normal(size=free.shape[1])
        direction /= np.linalg.norm(direction)
        for displacement in _DISPLACEMENTS:
            nearby = closure.closed(x + displacement * direction)
            residual, _, _ = closure.known(nearby)
            if np.abs(residual).max(initial=0) < _CLOSED:
                yield nearby
                break


def _in_drawing(assembly: Any) -> LoopClosure:
    drawing = assembly.bodies.drawing
    still = eqx.tree_at(lambda q: q.coordinates, drawing, jnp.zeros_like(drawing.coordinates))
    free = np.zeros(drawing.coordinates.shape, bool)
    t = jnp.zeros((), drawing.coordinates.dtype)
    return LoopClosure(assembly, (drawing, still), (free, free), t, None)


def _weighted(bodies: Bodies, J: np.ndarray) -> np.ndarray:
    """Return `J L` with `L L^T = M^-1`; as if bodies without mass had one of 1 kg."""
    mass = _mass_in_drawing(bodies.with_masses())
    if bodies.planar:
        return J / np.sqrt(np.asarray(mass))
    lower = np.linalg.cholesky(np.asarray(mass.inverse))
    number, size, _ = lower.shape
    rows = J.reshape(J.shape[0], number, size)
    return np.einsum("rbi,bij->rbj", rows, lower).reshape(J.shape)


@eqx.filter_jit  # operation by operation it would be fifty programs
def _mass_in_drawing(bodies: Bodies) -> Any:
    return bodies.mass_matrix(bodies.drawing, bodies.inverse_inertia())
