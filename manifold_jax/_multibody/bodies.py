"""Rigid bodies: what a user says of each, and the arrays of all of them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .checks import check_vector, floating, is_concrete, unique_names
from .rotations import compose, planar_rotation, rates_matrix, rotation_matrix, turn


GROUND = "ground"


class Pose(NamedTuple):
    """Positions of the centres of mass `(N, d)` and orientations of `N` bodies: quaternions, scalar
    first, `(N, 4)` in space, angles `(N,)` in the plane. The coordinates `q` of an assembly; its
    velocities `v` are their rates, in the same layout."""

    position: Float[Array, "*n d"]
    orientation: Float[Array, "..."]


class Body(eqx.Module):
    """A rigid body, its frame at the centre of mass.

    **Arguments:**

    - `name`: what joints and forces call it.
    - `mass` (kg), positive.
    - `inertia` (kg m^2) about the centre of mass: a number for a body in the plane; for one in
        space the moments about the axes of its frame, shape `(3,)`, or the matrix `(3, 3)`.
    - `position` of the centre of mass (m), shape `(2,)` or `(3,)`, and `orientation` (an angle,
        or a unit quaternion, scalar first, see [`quaternion`][]) in the *drawing*, the pose in
        which joints are described. Default: at the origin, not turned.

    Numbers may be traced by JAX. **Raises** `ValueError` for shapes, masses and inertias that no
    body has. A thin rod without a moment about its own axis has no well-defined spin: give a small
    one, or use a [`Distance`][].
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""]
    inertia: Float[Array, "..."]
    position: Float[Array, " d"]
    orientation: Float[Array, "..."]

    def __init__(
        self, name: str, mass: Any, inertia: Any, *, position: Any = None, orientation: Any = None
    ):
        if not isinstance(name, str) or not name or name == GROUND:
            raise ValueError(
                f"`name` of a body must be a string and not {GROUND!r}, which is what does not move, got {name!r}."
            )
        self.name = name
        self.mass, self.inertia = floating(mass), floating(inertia)
        if self.mass.shape != () or self.inertia.shape not in ((), (3,), (3, 3)):
            raise ValueError(
                f"Body {name!r}: `mass` must be a number and `inertia` a number (a body in the plane) or of shape (3,) "
                f"or (3, 3) (in space), got shapes {self.mass.shape} and {self.inertia.shape}."
            )
        planar = self.inertia.ndim == 0
        d, still = (2, 0.0) if planar else (3, (1.0, 0.0, 0.0, 0.0))
        where = np.zeros(d) if position is None else position
        self.position = check_vector(f"Body {name!r}: `position`", where, d)
        self.orientation = _orientation(name, still if orientation is None else orientation, planar)
        _check_mass(self)


def _orientation(name: str, orientation: Any, planar: bool) -> Float[Array, "..."]:
    p = floating(orientation)
    if p.shape != (() if planar else (4,)):
        what = "an angle" if planar else "a unit quaternion of shape (4,)"
        raise ValueError(f"Body {name!r}: `orientation` must be {what}, got shape {p.shape}.")
    if planar:
        return p
    if is_concrete(p) and not abs(float(np.linalg.norm(p)) - 1) < 1e-6:
        raise ValueError(
            f"Body {name!r}: `orientation` must be a quaternion of norm 1, got {np.asarray(p)}. Use e.g. "
            "`mj.multibody.quaternion(axis, angle)`."
        )
    return p / jnp.sqrt(jnp.sum(p * p))


def _check_mass(body: Body) -> None:
    if is_concrete(body.mass) and not float(body.mass) > 0:
        raise ValueError(f"Body {body.name!r}: `mass` must be positive, got {float(body.mass)}.")
    if not is_concrete(body.inertia):
        return
    inertia = np.asarray(body.inertia, float)
    matrix = inertia if inertia.ndim == 2 else np.diag(np.atleast_1d(inertia))
    size = 1e-6 * np.abs(matrix).max()
    if not np.all(np.abs(matrix - matrix.T) <= size):
        raise ValueError(f"Body {body.name!r}: `inertia` is not symmetric: {inertia.tolist()}.")
    moments = np.linalg.eigvalsh(matrix)
    if not moments[0] > 0:
        raise ValueError(
            f"Body {body.name!r}: `inertia` must be positive definite, got the principal moments {moments.tolist()}."
        )
    if moments.size == 3 and moments[2] > moments[0] + moments[1] + size:
        raise ValueError(
            f"Body {body.name!r}: no body has the principal moments of inertia {moments.tolist()}: the largest exceeds "
            "the sum of the others. Are they about the centre of mass?"
        )


class Bodies(eqx.Module):
    """The arrays of all bodies: masses `(N,)`, moments of inertia `(N,)` or matrices `(N, 3, 3)`,
    and the drawing."""

    names: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, " n"]
    inertia: Float[Array, "..."]
    drawing: Pose

    @staticmethod
    def of(bodies: Sequence[Body]) -> "Bodies":
        if not bodies or not all(isinstance(body, Body) for body in bodies):
            raise ValueError("`bodies` must be a sequence of at least one `mj.multibody.Body`.")
        names = unique_names("body", [body.name for body in bodies])
        planar = {body.inertia.ndim == 0 for body in bodies}
        if len(planar) > 1:
            flat = [body.name for body in bodies if body.inertia.ndim == 0]
            raise ValueError(
                f"Bodies {flat} have one moment of inertia (in the plane), the others three (in space): an assembly is "
                "either in the plane or in space. Give all `inertia` the same kind."
            )
        matrix = lambda body: jnp.diag(body.inertia) if body.inertia.ndim == 1 else body.inertia
        inertia = [body.inertia if body.inertia.ndim == 0 else matrix(body) for body in bodies]
        drawing = Pose(stack([b.position for b in bodies]), stack([b.orientation for b in bodies]))
        return Bodies(names, stack([b.mass for b in bodies]), stack(inertia), drawing)

    @property
    def planar(self) -> bool:
        return self.inertia.ndim == 1

    def index(self, name: Any, of: str) -> int:
        """Of a body; the ground comes after the last."""
        if name == GROUND:
            return len(self.names)
        if name not in self.names:
            known = ", ".join(map(repr, self.names[:12]))
            raise ValueError(
                f"{of} names the body {name!r}, which is not there. Bodies are {known}{', ...' if len(self.names) > 12 else ''}, "
                "and `mj.multibody.GROUND`."
            )
        return self.names.index(name)

    def mass_matrix(self, q: Pose) -> Float[Array, "..."]:
        """A diagonal in the plane; in space `diag(m, 4 G^T I G + 4 c p p^T)`.

        The last term is without effect, as the norm of `p` is constant, and makes the matrix
        regular: without it no force is needed to stretch a quaternion. `c` is the mean moment.
        """
        if self.planar:
            masses = jnp.repeat(self.mass, 2)
            return jnp.concatenate([masses, self.inertia])
        n, p = len(self.names), q.orientation
        G = rates_matrix(p)
        mean = jnp.trace(self.inertia, axis1=1, axis2=2) / 3
        blocks = compose(jnp.swapaxes(G, 1, 2), compose(self.inertia, G))
        blocks = 4 * (blocks + mean[:, None, None] * p[:, :, None] * p[:, None, :])
        own = jnp.eye(n, dtype=p.dtype)[:, None, :, None]
        turning = (own * blocks[:, :, None, :]).reshape(4 * n, 4 * n)
        moving = jnp.diag(jnp.repeat(self.mass, 3))
        none = jnp.zeros((3 * n, 4 * n), p.dtype)
        return jnp.block([[moving, none], [none.T, turning]])

    def gyroscopic(self, q: Pose, v: Pose) -> Float[Array, "..."]:
        """`-8 G(p')^T I G(p) p'` of every quaternion; nothing in the plane."""
        if self.planar:
            return jnp.zeros_like(q.orientation)
        G, rates = rates_matrix(q.orientation), rates_matrix(v.orientation)
        momentum = turn(self.inertia, turn(G, v.orientation))
        return -8 * jnp.sum(rates * momentum[:, :, None], axis=1)


class Frames(NamedTuple):
    """Origins, rotations, velocities and angular velocities in space of all bodies and, last, of
    the ground; those in the plane are turned about the third axis."""

    origin: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    velocity: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]

    @staticmethod
    def of(q: Pose, v: Pose) -> "Frames":
        n = q.position.shape[0]
        if q.orientation.ndim == 1:
            rotation = planar_rotation(q.orientation)
            spin = jnp.stack([jnp.zeros(n, v.orientation.dtype)] * 2 + [v.orientation], axis=1)
        else:
            rotation = rotation_matrix(q.orientation)
            spin = turn(rotation, 2 * turn(rates_matrix(q.orientation), v.orientation))
        ground = jnp.eye(3, dtype=rotation.dtype)[None]
        still = lambda rows: jnp.concatenate([in_space(rows), jnp.zeros((1, 3), rows.dtype)])
        return Frames(
            still(q.position), jnp.concatenate([rotation, ground]), still(v.position), still(spin)
        )


def in_space(rows: Float[Array, "n d"]) -> Float[Array, "n 3"]:
    """Vectors in the plane with a third component of zero."""
    return jnp.pad(rows, ((0, 0), (0, 3 - rows.shape[1])))


def stack(values: Sequence[Any]) -> Array:
    """One array; of concrete values without a program for each."""
    if all(is_concrete(value) for value in values):
        return jnp.asarray(np.stack([np.asarray(value) for value in values]))
    return jnp.stack([jnp.asarray(value) for value in values])


def still(q: Pose) -> Pose:
    return jax.tree_util.tree_map(jnp.zeros_like, q)
