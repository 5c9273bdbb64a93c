"""Forces, as users describe them; weight is `gravity` of the assembly. Points are given as for joints.

A `value` is a number or array, or a function `f(t, args)` of the time and the `args` of the solve.
"""

from typing import Any

import equinox as eqx


def _names(joints: Any) -> tuple[str, ...]:
    """Return names of joints as a tuple; refuse a single one, which would be taken for a list of letters."""
    if isinstance(joints, str):
        raise TypeError(
            f"`joints` must be a tuple of names, got the string {joints!r}: write `({joints!r},)`."
        )
    return tuple(joints)


class AbstractForce(eqx.Module):
    """A force that acts on bodies, besides their weight."""

    name: eqx.AbstractVar[str | None]


class AbstractLineForce(AbstractForce):
    """A force between two points, along their line: they attract each other with
    `stiffness (l - length) + damping l' - value`, where `l` is their distance. Missing terms are zero."""

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    between: eqx.AbstractVar[Any]
    points: eqx.AbstractVar[Any]


class AbstractJointForce(AbstractForce):
    """A force in a hinge or slider. Those without a law of their own are terms of
    `stiffness (x - rest) + damping x' - value`, which acts against its coordinate `x`."""

    joint: str = eqx.field(static=True)


class Spring(AbstractLineForce):
    """A spring with damping between two points: they attract each other with
    `stiffness (l - length) + damping l'`, where `l` is their distance.

    Where the points coincide the force has no direction: a spring of `length` zero has none there, a
    damper has `damping` times the relative velocity of the points, and any other force is not a number,
    which ends the solve.

    **Arguments:**

    - `first`, `second`: names of bodies, one of them may be `mj.multibody.GROUND`.
    - `stiffness` (N/m), `length` at which it is slack (m), `damping` (N s/m).
    - `between`: its ends in the drawing, a pair of points in world coordinates; or `points`, a pair in
        the frames of the bodies.
    """

    stiffness: Any = 0.0
    length: Any = 0.0
    damping: Any = 0.0
    between: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class Damper(AbstractLineForce):
    """A damper between two points: they attract each other with `damping l'`. Arguments as for
    [`Spring`][]."""

    damping: Any = 0.0
    between: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class RotationalDamper(AbstractForce):
    """A damper between two bodies against their relative angular velocity: the torque on the second one is
    `damping` times that of the first minus that of the second, and its opposite acts on the first.

    For the friction of ball joints; that of a hinge is the `damping` of its [`JointSpring`][].

    **Arguments:**

    - `first`, `second`: names of bodies, one of them may be `mj.multibody.GROUND`.
    - `damping` (N m s/rad).
    """

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    damping: Any
    name: str | None = eqx.field(static=True, default=None)


class LinearActuator(AbstractLineForce):
    """A cylinder between two points that pushes them apart with the force `value` (N), a number or
    `f(t, args)`. Other arguments as for [`Spring`][]."""

    value: Any
    between: Any = None
    points: Any = None
    name: str | None = eqx.field(static=True, default=None)


class JointSpring(AbstractJointForce):
    """A spring with damping in a hinge or slider: `stiffness (x - rest) + damping x'` acts against its
    coordinate.

    **Arguments:**

    - `joint`: the name of a [`Revolute`][] or [`Prismatic`][]. Its coordinate `x`, an angle or a distance, is that
        of the second body relative to the first, about or along its axis (in the plane counter-clockwise), and zero in
        the drawing. Angles among the [`JointCoordinates`][] continue beyond `pi`. Those of hinges that close loops, and
        all where the assembly itself is solved, are from `-pi` to `pi`, as poses do not tell whole turns: the torque
        of a spring then jumps at half a turn.
    - `stiffness` (N m/rad or N/m), `rest` (rad or m), `damping` (N m s/rad or N s/m). With a `rest` beyond half a turn
        the assembly must be solved in [`JointCoordinates`][].
    """

    stiffness: Any = 0.0
    rest: Any = 0.0
    damping: Any = 0.0
    name: str | None = eqx.field(static=True, default=None)


class Motor(AbstractJointForce):
    """A motor in a hinge or slider: the torque (N m) or force (N) `value`, a number or `f(t, args)`,
    acts on the second body in the direction of the joint's coordinate, and its opposite on the first.

    **Arguments:** `joint` as for [`JointSpring`][]; `value`.
    """

    value: Any
    name: str | None = eqx.field(static=True, default=None)


class RotorInertia(AbstractForce):
    """The inertia of a rotor that turns with a hinge or slider: `inertia x''` acts against its coordinate
    `x`. MJCF calls it `armature`.

    A motor with the moment of inertia `J` about its shaft, behind gears that make it turn `n` times as fast
    as the joint, has `inertia = n^2 J`, for robots often more than that of the links. Its spin together with the
    body that carries it is not part of it.

    **Arguments:**

    - `joint`: as for [`JointSpring`][].
    - `inertia` (kg m^2, of a slider kg), not negative.

    The assembly must be solved in the coordinates of its joints, see [`JointCoordinates`][]. Joints with
    rotors must not form a closed loop by themselves.

    Source: MuJoCo's XML reference, `armature` of joints.
    """

    joint: str = eqx.field(static=True)
    inertia: Any
    name: str | None = eqx.field(static=True, default=None)


class Controller(AbstractForce):
    """A feedback controller: torques (N m) and forces (N) in several hinges and sliders that depend on the
    state of the whole mechanism.

    ```python
    mb.Controller(("shoulder", "elbow"), lambda t, y, args: -args @ near.coordinates(y))
    ```

    **Arguments:**

    - `joints`: the names of [`Revolute`][] and [`Prismatic`][] joints, `k` of them.
    - `law`: `f(t, y, args)` returns the values `(k,)`, with signs as for [`Motor`][]; `y = (q, v)` is the
        state of the assembly, the poses of all bodies and their rates.
    - `name`: by default made from the names of the joints.

    Its torques are not part of `Assembly.energy`. For values that do not depend on the state use [`Motor`][].
    """

    joints: tuple[str, ...] = eqx.field(static=True, converter=_names)
    law: Any
    name: str | None = eqx.field(static=True, default=None)


class Tendon(AbstractForce):
    """A tendon over pulleys of constant radii, through several hinges and sliders (a fixed tendon of MuJoCo): it has
    the length `l = sum_i r_i x_i` of their coordinates `x_i`, and acts in each with `r_i F` in the direction of its
    coordinate,

        F = value - stiffness (l - rest) - damping l',   within `limits`.

    With one joint it is a servo motor of limited torque: `Tendon(("elbow",), (1.0,), lambda t, args: 50 * args,
    stiffness=50.0, damping=2.0, limits=(-10.0, 10.0))` turns the elbow to the angle `args`. To angles beyond `pi` it does
    so in [`JointCoordinates`][] alone: poses do not tell whole turns, and it would turn for ever. Such targets are
    refused there where they are known, as numbers are, but not functions.

    **Arguments:**

    - `joints`: the names of [`Revolute`][] and [`Prismatic`][] joints, `k` of them; their coordinates as for
        [`JointSpring`][].
    - `coefficients`: the radii `r_i` (m, of sliders no unit), shape `(k,)`, with signs.
    - `value` (N), a number or `f(t, args)`; `stiffness` (N/m), `rest` (m), `damping` (N s/m).
    - `limits` of `F` (N): a pair, or `None`.
    - `name`: by default made from the names of the joints.

    The energy of its spring is part of `Assembly.energy` where it has no limits.

    Source: MuJoCo's XML reference, `tendon/fixed` and `actuator/general`.
    """

    joints: tuple[str, ...] = eqx.field(static=True, converter=_names)
    coefficients: Any
    value: Any = 0.0
    stiffness: Any = 0.0
    rest: Any = 0.0
    damping: Any = 0.0
    limits: Any = None
    name: str | None = eqx.field(static=True, default=None)


class Force(AbstractForce):
    """A force on a body, in world coordinates.

    **Arguments:**

    - `body`: its name. `value` (N): shape `(2,)` or `(3,)`, or `f(t, args)` that returns it.
    - `point`: where it acts, in the frame of the body; by default at the centre of mass.
    """

    body: str = eqx.field(static=True)
    value: Any
    point: Any = None
    name: str | None = eqx.field(static=True, default=None)


class Torque(AbstractForce):
    """A torque on a body: `value` (N m), in world coordinates, shape `(3,)`, in the plane a number, or
    `f(t, args)` that returns it. `body`: its name."""

    body: str = eqx.field(static=True)
    value: Any
    name: str | None = eqx.field(static=True, default=None)
