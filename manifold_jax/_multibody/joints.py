"""Joints, as users describe them. Points and axes are those of the drawing, the pose of the bodies in
their `position` and `orientation`, in world coordinates."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .checks import as_pair, check_axis, check_shape, is_concrete


class AbstractRestraint(eqx.Module):
    """A restriction of the motion of bodies: a joint, the drive of one, or the coupling of two."""


class AbstractJoint(AbstractRestraint):
    """A connection of two bodies, or of one with `mj.multibody.GROUND`.

    The point of the joint is either `at`, a point in world coordinates in the drawing, which is then a
    point of both bodies; or `points`, a pair, one in the frame of each body (of the ground: in world
    coordinates), for which the drawing need not be closed.
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    points: eqx.AbstractVar[Any]
    name: eqx.AbstractVar[str | None]


class AbstractPointJoint(AbstractJoint):
    """A joint at one point."""

    at: Any = None


class AbstractJointWithoutAxis(AbstractPointJoint):
    """A joint that needs no direction."""

    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class AbstractJointWithAxis(AbstractPointJoint):
    """A joint with a direction, `axis`, whose meaning depends on the kind."""

    axis: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class Revolute(AbstractJointWithAxis):
    """A hinge: one point in common, and in space the direction `axis`. Two equations in the plane,
    where it has no axis, five in space.

    **Arguments:**

    - `first`, `second`: names of bodies, one of them may be `mj.multibody.GROUND`.
    - `at` or `points`: the point, see [`AbstractJoint`][]. `axis`: shape `(3,)`, any length.
    - `name`: by default made of kind and bodies.
    """


class Spherical(AbstractJointWithoutAxis):
    """A ball joint: one point in common, three equations; in space only. Arguments as for
    [`Revolute`][], without an axis."""


class Prismatic(AbstractJointWithAxis):
    """A slider: it moves along `axis` and does not turn, as in the drawing. Two equations in the
    plane, five in space. Arguments as for [`Revolute`][]; `axis` has shape `(2,)` in the plane."""


class Cylindrical(AbstractJointWithAxis):
    """Sliding along `axis` and turning about it: four equations; in space only. Arguments as for
    [`Revolute`][]."""


class Universal(AbstractJointWithAxis):
    """A Cardan joint: one point in common, and two axes that stay perpendicular, the first fixed in
    the first body, the second in the second: four equations; in space only.

    **Arguments:** as for [`Revolute`][], but `axis` is a pair of axes, perpendicular in the drawing.
    """


class Fixed(AbstractJointWithoutAxis):
    """A weld: no relative motion. Three equations in the plane, six in space.

    **Arguments:** as for [`Revolute`][], without an axis; `at` is the point for joint forces, by default the
    centre of mass of the first body that is not the ground.
    """


class Distance(AbstractJoint):
    """A massless rod with ball joints at both ends: one equation.

    **Arguments:**

    - `first`, `second`, `name`: as for [`Revolute`][].
    - `between`: its ends in the drawing, a pair of points in world coordinates; or `points`, a pair in
        the frames of the bodies.
    - `length` (m), positive; by default that of the drawing.
    """

    between: Any = None
    length: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class Drive(AbstractRestraint):
    """A drive that moves a hinge or slider as prescribed, with whatever torque or force is required:
    one equation, `x - motion(t, args) = 0` (a rheonomic constraint).

    **Arguments:**

    - `joint`: the name of a [`Revolute`][] or [`Prismatic`][], which may have only one drive.
    - `motion`: its coordinate `x` (rad or m) as a function `f(t, args)` with two derivatives, or a
        number; that of [`JointSpring`][], but angles continue beyond `pi`.
    - `name`: by default made from that of its joint. `Assembly.joint_forces` reports the torque or force
        of the drive under this name.

    `Assembly` raises `ValueError` for a joint that does not exist, has several drives, or is of another
    kind. Use [`Motor`][] if the torque is known instead of the motion.
    """

    joint: str = eqx.field(static=True)
    motion: Any
    name: str | None = eqx.field(static=True, default=None)


class Coupling(AbstractRestraint):
    """Gears, a mimic joint: the coordinate `x` of a hinge or slider is a polynomial in that of another, `z`,

        x = c_1 z + c_2 z^2 + ...,

    one equation. Both are zero in the drawing.

    ```python
    mb.Coupling("output", "input", -0.25)  # wheels that mesh, of 40 and 10 teeth
    mb.Coupling("left finger", "right finger", 1.0)
    ```

    **Arguments:**

    - `joint`, `other`: the names of [`Revolute`][] or [`Prismatic`][] joints, of `x` and of `z`.
    - `coefficients`: the ratio `c_1`, or all `(c_1, c_2, ...)`; rad or m, per powers of rad or m.
    - `name`: by default made from that of its joint.

    The assembly must be solved in the coordinates of its joints, in which angles continue beyond `pi`, see
    [`JointCoordinates`][]. Joints with couplings must not form a closed loop by themselves. One that does not move
    at all has a [`Drive`][] instead, `Drive(joint, 0.0)`.

    `Assembly` raises `ValueError` for a joint that does not exist or is of another kind.

    Source: MuJoCo's XML reference, `equality/joint`; the specification of URDF, `mimic`.
    """

    joint: str = eqx.field(static=True)
    other: str = eqx.field(static=True)
    coefficients: Any
    name: str | None = eqx.field(static=True, default=None)


WITH_AXIS = {
    False: (Revolute, Universal, Cylindrical, Prismatic),
    True: (Prismatic,),  # in the plane
}
# Axes of joints without an axis: frames whose columns are those of the body, as far as possible.
UPRIGHT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])


def ends(thing: Any, name: str, planar: bool) -> tuple[bool, tuple[Any, Any]]:
    """Return whether the two points of a joint or a force are those of the drawing, and the points."""
    if isinstance(thing, AbstractPointJoint):
        word, drawn = "at", None if thing.at is None else (thing.at, thing.at)
    else:
        word, drawn = "between", thing.between
    if (drawn is None) == (thing.points is None):
        raise ValueError(
            f"{name}: give either `{word}` (in space, as drawn) or `points` (a pair, one in the frame of each body)."
        )
    pair, word = (thing.points, "points") if drawn is None else (drawn, word)
    pair = as_pair(f"{name}: `{word}` must be a pair of points", pair)
    shape = (2 if planar else 3,)
    first, second = (check_shape(f"{name}: `{word}`", point, shape) for point in pair)
    return drawn is not None, (first, second)


def drawn_axes(joint: AbstractJoint, name: str, planar: bool) -> tuple[Any, Any]:
    """Return the axes of the first and of the second body, in world coordinates. In the plane the axis
    of a slider lies in it."""
    axis = getattr(joint, "axis", None)
    if not isinstance(joint, WITH_AXIS[planar]):
        if axis is not None:
            where = " in the plane" if planar else ""
            raise ValueError(
                f"{name}: a {type(joint).__name__}{where} has no `axis`; leave it out."
            )
        return UPRIGHT
    if isinstance(joint, Universal):
        return _perpendicular(joint, name)
    if axis is None:
        raise ValueError(f"{name} needs an `axis` of shape ({2 if planar else 3},).")
    if planar:
        axis = check_shape(f"{name}: `axis`", axis, (2,))
        axis = jnp.concatenate([axis, jnp.zeros(1, axis.dtype)])
    axis = check_axis(f"{name}: `axis`", axis)
    return axis, axis


def _perpendicular(joint: Universal, name: str) -> tuple[Any, Any]:
    first, second = joint.first, joint.second
    what = f"{name}: `axis` must be a pair of axes, the first fixed in {first!r}, the second in {second!r}"
    first, second = (check_axis(f"{name}: `axis`", axis) for axis in as_pair(what, joint.axis))
    if is_concrete(first) and is_concrete(second):
        a, b = (np.asarray(axis) / np.linalg.norm(axis) for axis in (first, second))
        if abs(a @ b) > 1e-6:
            angle = np.degrees(np.arccos(np.clip(a @ b, -1, 1)))
            raise ValueError(
                f"{name}: its two axes must be perpendicular in the drawing, the angle is {angle:.4g} degrees."
            )
    return first, second
