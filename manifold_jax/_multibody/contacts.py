"""Contacts that yield, and friction, as users describe them: forces that are continuous, so that any solver takes
them. Contacts that do not yield are resets, see `mj.impact`."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx

from .._base.user_functions import check_function
from .forces import AbstractForce, AbstractJointForce


class JointStop(AbstractJointForce):
    r"""Stops that bound the coordinate `x` of a hinge or slider, and yield. Beyond one by a depth `p`, the torque or
    force

        stiffness p max(0, 1 + dissipation p')

    pushes it back.

    **Arguments:**

    - `joint`: as for [`JointSpring`][].
    - `lower`, `upper` (rad or m): where the stops are, counted from the drawing; `-jnp.inf` or `jnp.inf` for none.
        Poses do not tell whole turns: stops of a hinge that are `2 pi` apart or more, or a single one beyond `pi`, need
        [`JointCoordinates`][], and otherwise angles are those nearest to the middle of the stops.
    - `stiffness` (N m/rad or N/m), positive.
    - `dissipation` (s/rad or s/m), not negative: a stop that is hit at the speed `v` gives back the fraction `e` of it,
        where `c v (1 + e) = log((1 + c v) / (1 - c v e))` with this `c`: about `1 - 2 c v / 3`.

    Explicit solvers take steps of about `sqrt(inertia / stiffness)` at a stop. With [`impact`][manifold_jax.impact]
    instead it does not yield.

    Source: Hunt & Crossley, Coefficient of restitution interpreted as damping in vibroimpact, J. Appl. Mech. 42 (1975).
    """

    lower: Any
    upper: Any
    stiffness: Any
    dissipation: Any = 0.0
    name: str | None = eqx.field(static=True, default=None)


class JointFriction(AbstractJointForce):
    r"""Dry friction in a hinge or slider: `torque x' / sqrt(x'^2 + slip^2)` acts against its coordinate `x`.

    **Arguments:**

    - `joint`: as for [`JointSpring`][].
    - `torque` (N m, of a slider N), not negative: that of Coulomb's law, the `frictionloss` of MJCF and the
        `friction` of URDF.
    - `slip` (rad/s or m/s), positive: below this speed friction fades. A joint that would stick under a torque `u`
        creeps, at the speed `slip u / sqrt(torque^2 - u^2)`. A small one makes the equations stiff, by
        `torque / (inertia slip)`.
    """

    torque: Any
    slip: Any = 1e-2
    name: str | None = eqx.field(static=True, default=None)


class GroundContact(AbstractForce):
    r"""A point of a body that touches the ground, a plane that yields, with friction. At a depth `p` below the plane
    the point is pushed back, and its velocity `u` along the plane is braked, by

        N = stiffness p max(0, 1 + dissipation p'),   friction N u / sqrt(|u|^2 + slip^2).

    ```python
    mb.GroundContact("foot", (0.1, 0.0, -0.05), stiffness=2e4, dissipation=0.5, friction=0.8)
    ```

    **Arguments:**

    - `body`: its name. `point`: in the frame of the body, shape `(2,)` or `(3,)`.
    - `stiffness` (N/m), positive, and `dissipation` (s/m), as for [`JointStop`][].
    - `friction`: the coefficient of Coulomb's law, not negative.
    - `slip` (m/s), positive: below this speed friction fades, as in [`JointFriction`][].
    - `at`: a point of the plane in world coordinates, by default the origin. `normal`: the direction in which it
        pushes, of any length, by default along the last axis: upwards.

    Source: Hunt & Crossley (1975), as for [`JointStop`][].
    """

    body: str = eqx.field(static=True)
    point: Any
    stiffness: Any
    dissipation: Any = 0.0
    friction: Any = 0.0
    slip: Any = 1e-2
    at: Any = None
    normal: Any = None
    name: str | None = eqx.field(static=True, default=None)


def stops_at(
    stops: Callable | None, limits: Mapping[str, tuple[float, float]]
) -> list[AbstractForce]:
    """Return what `stops(joint, lower, upper)` makes of the limits of joints, counted from the drawing."""
    if stops is None:
        return []
    check_function("stops", stops, "f(joint, lower, upper)")
    found = []
    for name, ends in limits.items():
        made = stops(name, *map(float, ends))
        if isinstance(made, AbstractForce):
            found.append(made)
        elif made is not None:
            raise TypeError(
                f"`stops` must return a force such as `mj.multibody.JointStop`, or None for no stop; for the joint {name!r} "
                f"it returned {type(made).__name__}."
            )
    return found
