"""Joints, as a user says them. Points and axes are those of the drawing, the pose of the bodies in
their `position` and `orientation`, in the coordinates of space."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .checks import check_axis, check_vector, is_concrete


class AbstractJoint(eqx.Module):
    """What holds two bodies together, or one to `mj.multibody.GROUND`.

    The point of the joint is either `at`, a point of space in the drawing, which is then a point of
    both bodies; or `points`, a pair, one in the frame of each body (of the ground: in space), for
    which the drawing need not be closed.
    """

    first: eqx.AbstractVar[str]
    second: eqx.AbstractVar[str]
    points: eqx.AbstractVar[Any]
    name: eqx.AbstractVar[str | None]

    @property
    @abc.abstractmethod
    def drawn(self) -> tuple[Any, Any] | None:
        """The two points of space in the drawing, or `None`."""

    @property
    def axes(self) -> tuple[Any, Any]:
        """Of the first and of the second body, in the drawing."""
        return None, None


class Revolute(AbstractJoint):
    """A hinge: one point in common, and in space the direction `axis`. Two equations in the plane,
    where it has no axis, five in space.

    **Arguments:**

    - `first`, `second`: names of bodies, one of them may be `mj.multibody.GROUND`.
    - `at` or `points`: the point, see [`AbstractJoint`][]. `axis`: shape `(3,)`, any length.
    - `name`: by default made of kind and bodies.
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    axis: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)

    @property
    def axes(self):
        return self.axis, self.axis


class Spherical(AbstractJoint):
    """A ball joint: one point in common, three equations; in space only. Arguments as for
    [`Revolute`][], without an axis."""

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)


class Prismatic(AbstractJoint):
    """A slider: it moves along `axis` and does not turn, as in the drawing. Two equations in the
    plane, five in space. Arguments as for [`Revolute`][]; `axis` has shape `(2,)` in the plane."""

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    axis: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)

    @property
    def axes(self):
        return self.axis, self.axis


class Cylindrical(AbstractJoint):
    """Sliding along `axis` and turning about it: four equations; in space only. Arguments as for
    [`Revolute`][]."""

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    axis: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)

    @property
    def axes(self):
        return self.axis, self.axis


class Universal(AbstractJoint):
    """A Cardan joint: one point in common, and two axes that stay perpendicular, the first fixed in
    the first body, the second in the second: four equations; in space only.

    **Arguments:** as for [`Revolute`][], but `axis` is a pair of axes, perpendicular in the drawing.
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    axis: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)

    @property
    def axes(self):
        if not (isinstance(self.axis, tuple | list) and len(self.axis) == 2):
            raise ValueError(
                f"`axis` of the universal joint of {self.first!r} and {self.second!r} must be a pair of axes, the first "
                f"fixed in {self.first!r}, the second in {self.second!r}, got {self.axis!r}."
            )
        return self.axis[0], self.axis[1]


class Fixed(AbstractJoint):
    """A weld: no motion against the drawing. Three equations in the plane, six in space.

    **Arguments:** as for [`Revolute`][]; `at` is where joint forces are told, by default the centre
    of mass of the first body that is not the ground.
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    at: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return None if self.at is None else (self.at, self.at)


class Distance(AbstractJoint):
    """A massless rod with ball joints at both ends: one equation.

    **Arguments:**

    - `first`, `second`, `name`: as for [`Revolute`][].
    - `between`: its ends in the drawing, a pair of points of space; or `points`, a pair in the frames
        of the bodies.
    - `length` (m), positive; by default that of the drawing.
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    between: Any = None
    length: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def drawn(self):
        return self.between


def ends(thing: Any, name: str, planar: bool) -> tuple[bool, Any, Any]:
    """The two points of a joint or a force, and whether they are those of the drawing."""
    d = 2 if planar else 3
    drawn, pair = thing.drawn, thing.points
    word = "between" if hasattr(thing, "between") else "at"
    if (drawn is None) == (pair is None):
        raise ValueError(
            f"{name}: give either `{word}` (in space, as drawn) or `points` (a pair, one in the frame of each body)."
        )
    pair, word = (pair, "points") if drawn is None else (drawn, word)
    if not (isinstance(pair, tuple | list) and len(pair) == 2):
        raise ValueError(f"{name}: `{word}` must be a pair of points, got {pair!r}.")
    first, second = (check_vector(f"{name}: `{word}`", point, d) for point in pair)
    return drawn is not None, first, second


def drawn_axes(joint: AbstractJoint, name: str, planar: bool, needed: bool) -> tuple[Any, Any]:
    """Both axes in space. In the plane the axis of a slider lies in it."""
    axes = joint.axes
    if not needed:
        if any(axis is not None for axis in axes):
            raise ValueError(f"{name}: in the plane a hinge has no `axis`; leave it out.")
        # of frames whose columns are those of the body, as far as possible
        axis = np.array([0.0, 0.0, 1.0])
        return axis, axis
    if any(axis is None for axis in axes):
        raise ValueError(f"{name} needs an `axis` of shape ({2 if planar else 3},).")
    if planar:
        axes = [check_vector(f"{name}: `axis`", axis, 2) for axis in axes]
        axes = [jnp.concatenate([axis, jnp.zeros(1, axis.dtype)]) for axis in axes]
    axes = [check_axis(f"{name}: `axis`", axis) for axis in axes]
    if isinstance(joint, Universal) and all(is_concrete(axis) for axis in axes):
        a, b = (np.asarray(axis) / np.linalg.norm(axis) for axis in axes)
        if abs(a @ b) > 1e-6:
            angle = np.degrees(np.arccos(np.clip(a @ b, -1, 1)))
            raise ValueError(
                f"{name}: its two axes must be perpendicular in the drawing, the angle is {angle:.4g} degrees."
            )
    return axes[0], axes[1]
