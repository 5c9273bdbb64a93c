"""Rigid bodies: the descriptions that users give, and the arrays of all of them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import BoolScalar
from .._mechanics import InvertedBlocks
from .checks import check_sequence, check_shape, is_concrete, stack, unique_names
from .rotations import compose, inverted, rates_matrix, turn


GROUND = "ground"


class Pose(eqx.Module):
    """Positions of the centres of mass `(N, d)` and orientations of `N` bodies: quaternions, scalar
    first, `(N, 4)` in space, angles `(N,)` in the plane. The coordinates `q` of an assembly; its
    velocities `v` are their rates, in the same layout.

    Held as one array `coordinates`, `(N, 7)` or `(N, 3)`, a row for each body: then masses are blocks
    on the diagonal.
    """

    coordinates: Float[Array, "*n c"]

    def __init__(self, position: Any, orientation: Any):
        if np.ndim(orientation) < np.ndim(position):
            orientation = orientation[..., None]
        are_numpy = isinstance(position, np.ndarray) and isinstance(orientation, np.ndarray)
        join = np.concatenate if are_numpy else jnp.concatenate
        self.coordinates = join([position, orientation], axis=-1)  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def planar(self) -> bool:
        return self.coordinates.shape[-1] == 3

    @property
    def position(self) -> Any:
        return self.coordinates[..., : 2 if self.planar else 3]

    @property
    def orientation(self) -> Any:
        return self.coordinates[..., 2] if self.planar else self.coordinates[..., 3:]


class Body(eqx.Module):
    """A rigid body, its frame at the centre of mass.

    **Arguments:**

    - `name`: what joints and forces call it.
    - `mass` (kg), positive, or zero with zero `inertia`, for a link between joints: the assembly is then
        solved in the coordinates of its joints, see [`JointCoordinates`][].
    - `inertia` (kg m^2) about the centre of mass: a number for a body in the plane; for one in
        space the moments about the axes of its frame, shape `(3,)`, or the matrix `(3, 3)`.
    - `position` of the centre of mass (m), shape `(2,)` or `(3,)`, and `orientation` (an angle,
        or a unit quaternion, scalar first, see [`quaternion`][]) in the *drawing*, the reference
        configuration in which joints are described. Default: at the origin, not turned.

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
                f"`name` of a body must be a string and not {GROUND!r}, which is what does not move, got {name!r}. Rename "
                "it, in the file if it is read from one."
            )
        self.name = name
        what = f"Body {name!r}"
        self.mass = check_shape(f"{what}: `mass`", mass, ())
        self.inertia = check_shape(
            f"{what}: `inertia`", inertia, (), (3,), (3, 3), advice=" (a number in the plane)"
        )
        planar = self.inertia.ndim == 0
        d, still = (2, 0.0) if planar else (3, (1.0, 0.0, 0.0, 0.0))
        where = np.zeros(d) if position is None else position
        self.position = check_shape(f"{what}: `position`", where, (d,))
        turned = still if orientation is None else orientation
        self.orientation = check_orientation(f"{what}: `orientation`", turned, planar)
        _check_mass(self)


def check_orientation(what: str, value: Any, planar: bool) -> Float[Array, "..."]:
    """Check an angle, or a unit quaternion."""
    if planar:
        return check_shape(what, value, (), advice=", an angle")
    p = check_shape(what, value, (4,), advice=", a unit quaternion")
    if not is_concrete(p):
        return p / jnp.sqrt(jnp.sum(p * p))
    norm = np.linalg.norm(p)
    if not abs(norm - 1) < 1e-6:
        raise ValueError(
            f"{what} must be a quaternion of norm 1, got {np.asarray(p)}. Use e.g. `mj.multibody.quaternion(axis, angle)`."
        )
    return jnp.asarray(np.asarray(p) / norm)


def _check_mass(body: Body) -> None:
    if not is_concrete(body.inertia):
        return
    inertia = np.asarray(body.inertia, float)
    if is_concrete(body.mass) and float(body.mass) == 0 and not inertia.any():
        return
    if is_concrete(body.mass) and not float(body.mass) > 0:
        raise ValueError(
            f"Body {body.name!r}: `mass` must be positive, or zero with zero `inertia`, got {float(body.mass)}."
        )
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


def _matrix(inertia: Array) -> Any:
    if inertia.ndim == 2:
        return inertia
    return np.diag(np.asarray(inertia)) if is_concrete(inertia) else jnp.diag(inertia)


class Bodies(eqx.Module):
    """The arrays of all bodies: masses `(N,)`, inertias `(N,)` or `(N, 3, 3)`, and the drawing."""

    names: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, " n"]
    inertia: Float[Array, "..."]
    drawing: Pose

    @staticmethod
    def of(bodies: Sequence[Body]) -> "Bodies":
        bodies = check_sequence("bodies", bodies, Body, "`mj.multibody.Body`")
        if not bodies:
            raise ValueError("`bodies` must be a sequence of at least one `mj.multibody.Body`.")
        names = unique_names("body", [body.name for body in bodies])
        flat = [body.name for body in bodies if body.inertia.ndim == 0]
        if 0 < len(flat) < len(bodies):
            raise ValueError(
                f"Bodies {flat} have one moment of inertia (in the plane), the others three (in space): an assembly is "
                "either in the plane or in space. Give all `inertia` the same kind."
            )
        inertia = [_matrix(body.inertia) if not flat else body.inertia for body in bodies]
        drawing = Pose(stack([b.position for b in bodies]), stack([b.orientation for b in bodies]))
        return Bodies(names, stack([b.mass for b in bodies]), stack(inertia), drawing)

    @property
    def planar(self) -> bool:
        return self.inertia.ndim == 1

    def index(self, name: Any, of: str) -> int:
        """Return the number of a body; the ground comes after the last."""
        if name == GROUND:
            return len(self.names)
        if name not in self.names:
            known = ", ".join(map(repr, self.names[:12]))
            raise ValueError(
                f"{of} names the body {name!r}, which is not there. Bodies are {known}{', ...' if len(self.names) > 12 else ''}, "
                "and `mj.multibody.GROUND`."
            )
        return self.names.index(name)

    def moving_index(self, name: Any, of: str) -> int:
        i = self.index(name, of)
        if i == len(self.names):
            raise ValueError(f"{of}: the ground does not move. Name a body.")
        return i

    def inverse_inertia(self) -> tuple[Float[Array, "n 3 3"], BoolScalar] | None:
        """Return the inverses, and whether all are positive definite; `None` in the plane."""
        return None if self.planar else inverted(self.inertia)

    def mass_matrix(self, q: Pose, inverse_inertia: tuple[Array, Array] | None) -> Any:
        """Return a diagonal in the plane; in space the inverses of blocks
        `diag(m, 4 G^T I G + 4 c p p^T)`.

        The last term has no effect, as the norm of `p` is constant, and makes the matrix nonsingular:
        without it no force is needed to stretch a quaternion. `c` is the mean moment. As the rows of
        `G` and `p` are orthogonal, of length `|p|`, the inverse of such a block is
        `diag(1/m, (G^T I^-1 G + p p^T / c) / (4 |p|^4))`. `inverse_inertia` is what the method of that name returns.
        """
        if inverse_inertia is None:
            return jnp.stack([self.mass, self.mass, self.inertia], axis=1).reshape(-1)
        p, inertia = q.orientation, self.inertia
        G = rates_matrix(p)
        inverse, positive = inverse_inertia
        mean = jnp.trace(inertia, axis1=1, axis2=2) / 3
        mean, mass = mean[:, None, None], self.mass[:, None, None]
        along = p[:, :, None] * p[:, None, :]

        def blocks(mass: Any, turning: Any) -> Any:
            """Return `diag(mass, turning)` for each body."""
            moving = mass * jnp.eye(3, dtype=p.dtype)[None]
            widths = ((0, 0), (0, 4), (0, 4)), ((0, 0), (3, 0), (3, 0))
            return jnp.pad(moving, widths[0]) + jnp.pad(turning, widths[1])

        turned = lambda inertia: compose(jnp.swapaxes(G, 1, 2), compose(inertia, G))
        matrix = blocks(mass, 4 * (turned(inertia) + mean * along))
        norm4 = (4 * jnp.sum(p * p, axis=1) ** 2)[:, None, None]
        inverse = blocks(1 / mass, (turned(inverse) + along / mean) / norm4)
        asymmetry = jnp.max(jnp.abs(inertia - jnp.swapaxes(inertia, 1, 2)))
        symmetric = asymmetry <= 1e-6 * jnp.max(jnp.abs(inertia))
        return InvertedBlocks(matrix, inverse, symmetric, positive & jnp.all(self.mass > 0))

    def with_masses(self) -> "Bodies":
        """Return the bodies, those without mass as heavy as the heaviest: to weigh equations, where no number is
        traced."""
        mass, inertia = np.array(self.mass), np.array(self.inertia)
        largest = np.abs(inertia).max() or 1.0
        inertia[mass == 0] = largest if self.planar else largest * np.eye(3)
        mass[mass == 0] = mass.max() or 1.0
        return dataclasses.replace(self, mass=jnp.asarray(mass), inertia=jnp.asarray(inertia))

    def gyroscopic(self, q: Pose, v: Pose) -> Float[Array, "..."]:
        """Return `-8 G(p')^T I G(p) p'` of every quaternion; zeros in the plane."""
        if self.planar:
            return jnp.zeros_like(q.orientation)
        G, rates = rates_matrix(q.orientation), rates_matrix(v.orientation)
        momentum = turn(self.inertia, turn(G, v.orientation))
        return -8 * jnp.sum(rates * momentum[:, :, None], axis=1)
