"""The assembly of bodies, joints and forces, as a mechanical system."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._mechanics import MechanicalSystem
from .bodies import Bodies, Body, Pose
from .checks import check_shape, floating, is_concrete
from .couplings import Couplings, group_couplings
from .energy import energy_of
from .equations import DRIVEN
from .force_groups import group_forces
from .forces import AbstractForce
from .frames import Frames, in_space, Placed, with_ground
from .independent import find_independent, Independent
from .joint_forces import find_joint_forces
from .joint_groups import group_restraints, JointGroup, residuals
from .joints import AbstractRestraint, Revolute
from .known_coordinates import NONE_KNOWN
from .loads import AbstractLoads
from .picture import draw_outline, new_axes, outline_of, write_film
from .reading import Energy, JointForce, Motion, over_times, Times
from .rotors import group_rotors, Rotors
from .start import make_state
from .system import system_in_poses


class Assembly(eqx.Module):
    r"""Rigid bodies with joints and forces, all in the plane or all in space.

    ```python
    mb = mj.multibody
    crank = mb.Body("crank", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pivot = mb.Revolute("crank", mb.GROUND, at=(0.0, 0.0))
    swing = mb.Assembly([crank], [pivot], gravity=(0.0, -9.81))
    hook = mj.Projected(dfx.Tsit5(), swing.system.constraint)
    sol = mj.diffeqsolve(swing.system.terms, hook, 0.0, 1.0, 0.01, swing.state())
    ```

    **Arguments:**

    - `bodies`: [`Body`][], in any order. `joints`: [`Revolute`][], [`Spherical`][],
        [`Prismatic`][], [`Cylindrical`][], [`Universal`][], [`Fixed`][], [`Distance`][]; [`Drive`][]
        where their motion is prescribed, and [`Coupling`][] of two of them.
    - `forces`: [`Spring`][], [`Damper`][], [`RotationalDamper`][], [`JointSpring`][], [`Motor`][],
        [`LinearActuator`][], [`Tendon`][], [`Controller`][], [`Force`][], [`Torque`][], [`JointStop`][],
        [`JointFriction`][], [`GroundContact`][], and [`RotorInertia`][].
    - `gravity` (m/s^2): shape `(2,)` or `(3,)`; `None` for none.
    - `redundant`: whether equations of joints depend on each other, as in most closed loops in
        space that move in a plane. `Assembly.state` says so.

    The coordinates are [`Pose`][]: positions of the centres of mass, and angles or unit
    quaternions with their norms as constraints. Joints of one kind are one array computation,
    however many they are.

    The assembly is a pytree whose leaves are all masses, moments of inertia, points, lengths and
    rates: built from traced numbers it can be differentiated, see also [`parametrized`][].

    **Raises** `ValueError` for names that are missing or not unique, axes that are zero, joints of
    a body with itself.
    """

    bodies: Bodies
    joints: tuple[JointGroup, ...]
    couplings: Couplings
    loads: tuple[AbstractLoads, ...]
    rotors: tuple[Rotors, ...]
    gravity: Float[Array, "3"]
    redundant: bool = eqx.field(static=True)
    independent: Independent | None

    def __init__(
        self,
        bodies: Sequence[Body],
        joints: Sequence[AbstractRestraint] = (),
        forces: Sequence[AbstractForce] = (),
        *,
        gravity: Any = None,
        redundant: bool = False,
    ):
        self.bodies = Bodies.of(bodies)
        d = 2 if self.bodies.planar else 3
        self.joints = group_restraints(self.bodies, joints)
        self.couplings = group_couplings(self.joints, joints)
        self.loads = group_forces(self.bodies, self.joints, forces)
        self.rotors = group_rotors(self.joints, forces)
        gravity = np.zeros(d) if gravity is None else gravity
        self.gravity = in_space(check_shape("`gravity`", gravity, (d,)))
        self.redundant = redundant
        self.independent = None
        if self.bodies.planar and not self.joints:
            raise ValueError(
                "Bodies in the plane without any joint have no constraints: without them use `diffrax.ODETerm` and the "
                "solver alone."
            )

    @property
    def system(self) -> MechanicalSystem:
        """Masses, constraints and forces as a [`MechanicalSystem`][], which has the `terms`, the
        manifold `constraint` and the `multipliers`.

        **Raises** `ValueError` for [`RotorInertia`][], [`Coupling`][], bodies without mass, and springs, servo motors and
        stops of hinges that reach beyond half a turn: use [`JointCoordinates`][]."""
        return system_in_poses(self)

    def without_dependent_equations(self) -> "Assembly":
        """Return the assembly with as many equations of its joints as are independent, for closed loops whose
        equations depend on each other in every pose. The rest follows from them, and is still part of `gaps`.

        Faster than `redundant=True`, which decomposes a matrix at every stage, and exact whatever the ratio
        of masses. The forces in the joints are then those of one of several possible sets, in which
        equations that were left out carry none. Those that are kept may depend on each other in other
        poses: where a solve ends although the mechanism can go on, take `redundant=True`.

        **Raises** `ValueError` if fewer equations are independent in the drawing than nearby (a singular
        pose), and if numbers of the assembly are traced: call it outside of `jit`.
        """
        if not all(map(is_concrete, jtu.tree_leaves(self))):
            raise ValueError(
                "`without_dependent_equations` needs known numbers: call it outside of `jit`, `vmap` and derivatives, and replace "
                "the numbers of its result inside, by `eqx.tree_at`."
            )
        found = find_independent(self)
        return eqx.tree_at(lambda a: a.independent, self, found, is_leaf=lambda x: x is None)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the bodies, in the order of the rows of a [`Pose`][]."""
        return self.bodies.names

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints in the order of the multipliers: kind by kind."""
        return tuple(name for group in self.joints for name in group.attachment.names)

    def state(
        self,
        positions: dict[str, Any] | None = None,
        orientations: dict[str, Any] | None = None,
        velocities: dict[str, Any] | None = None,
        angular_velocities: dict[str, Any] | None = None,
        *,
        assemble: bool = False,
        t: RealScalarLike = 0.0,
        args: Args = None,
    ) -> tuple[Pose, Pose]:
        """Return a state `(q, v)`: the drawing at rest, with other values for some bodies by name.

        **Arguments:**

        - `positions`, `velocities` of centres of mass; `orientations`, as for [`Body`][];
            `angular_velocities` (rad/s), a number, or in space shape `(3,)`, in world coordinates.
        - `assemble`: keep the given values, and find the rest such that all joints are satisfied: the
            nearest to the drawing, and the slowest. Also inside `jit`, `vmap` and derivatives, with
            respect to lengths and given values; joints that cannot be closed are then an error at
            run time. (Without it traced states are not checked.)
        - `t`, `args`: the time of the start and the `args` of the solve, for what [`Drive`][]s prescribe.

        **Raises** `ValueError` where joints are not satisfied (without `assemble`) or cannot be:
        which ones, and how large the gap is; and where equations depend on each other but
        `redundant` is false.
        """
        given = positions, orientations, velocities, angular_velocities
        return make_state(self, given, assemble, floating(t), args)

    def gaps(self, q: Pose, t: Times = 0.0, args: Args = None) -> dict[str, Float[Array, "*t r"]]:
        """Return residuals of the joints by name at the positions `q` of a state `(q, v)`: lengths in
        metres, cosines of angles. `t` and `args` are those of [`Drive`][]s, whose angles are in rad. `q` may
        have a leading axis, as in `sol.ys`, with the times `sol.ts`."""
        if q.position.ndim > 2:
            times = jnp.broadcast_to(floating(t), q.position.shape[:1])
            return jax.vmap(lambda q, t: self.gaps(q, t, args))(q, times)
        rows = (row for part in residuals(self.joints_at(t, args), q) for row in part)
        return dict(zip(self.joint_names, rows, strict=True))

    @over_times
    def motion(self, y: tuple[Pose, Pose], name: str) -> Motion:
        """Return position, orientation, velocity and angular velocity of a body. `y` may have leading
        axes, here and below, such as `sol.ys`."""
        i = self.bodies.moving_index(name, "`motion`")
        q, v = y
        spin = Frames.of(q, v).spin[i]
        spin = spin[2] if q.planar else spin
        return Motion(q.position[i], q.orientation[i], v.position[i], spin)

    @over_times
    def point(
        self, y: tuple[Pose, Pose], name: str, at: Any, *, drawn: bool = False
    ) -> tuple[Array, Array]:
        """Return position and velocity in world coordinates of a point of a body: `at` in its frame, or
        with `drawn=True` where it is in the drawing, as for joints."""
        d = 2 if self.bodies.planar else 3
        i = self.bodies.index(name, "`point`")
        at = in_space(check_shape("`at`", at, (d,)))
        if drawn:
            drawing = Placed.of(with_ground(self.bodies.drawing.coordinates)[i])
            at = drawing.rotation.T @ (at - drawing.origin)
        frames = Frames.of(*y)
        arm = frames.rotation[i] @ at
        velocity = frames.velocity[i] + jnp.cross(frames.spin[i], arm)
        return (frames.origin[i] + arm)[:d], velocity[:d]

    @over_times
    def joint_coordinates(self, y: tuple[Pose, Pose]) -> dict[str, Float[Array, "*t"]]:
        """Return angles of hinges (`-pi` to `pi`) and displacements of sliders by name, zero in the
        drawing."""
        frames, found = Frames.of(*y), {}
        for group in self.joints:
            if group.kind in DRIVEN and group.motions is None:
                values = group.attachment.sides(frames).coordinate(group.kind is Revolute)
                found |= dict(zip(group.attachment.names, values, strict=True))
        return found

    def joint_forces(
        self, t: Times, y: tuple[Pose, Pose], args: Args = None
    ) -> dict[str, JointForce]:
        """Return force and torque of every joint on its second body, from the multipliers, at the time
        `t` or the times of all states. With `redundant` joints only the sum over those that depend on
        each other is determined. Springs of hinges beyond half a turn: use that of [`JointCoordinates`][]."""
        if y[0].position.ndim == 2:
            return find_joint_forces(self, t, y, args)
        times = jnp.broadcast_to(floating(t), y[0].position.shape[:1])
        return jax.vmap(lambda t, y: find_joint_forces(self, t, y, args))(times, y)

    @over_times
    def energy(self, y: tuple[Pose, Pose]) -> Energy:
        """Return kinetic energy, and potential energy of weight and springs, whose angles are from `-pi` to `pi`:
        beyond use that of [`JointCoordinates`][]."""
        return energy_of(self, y, NONE_KNOWN)

    def draw(
        self,
        y: tuple[Pose, Pose],
        *,
        markers: Mapping[str, tuple[str, Any]] | None = None,
        ax: Any = None,
    ) -> Any:
        """Draw a state, or the last of several, and return the Matplotlib axes.

        Bodies are lines through the points of their joints and forces, each drawn from its own coordinates:
        where a joint does not hold they do not meet. A mechanism in space is seen from the front (against
        y) and a little from above (z).

        **Arguments:**

        - `y`: a state, or states with a leading axis such as `sol.ys`.
        - `markers`: named points, `{"foot": ("shank", (0.3, -0.8))}`: a body, and where the point is in the
            drawing. Their paths are drawn through all states.
        - `ax`: axes to draw into; by default those of a new figure.

        Needs Matplotlib (extra `cli`).
        """
        ax = new_axes() if ax is None else ax
        draw_outline(outline_of(self, y, markers), ax, -1)
        return ax

    def animate(
        self,
        y: tuple[Pose, Pose],
        path: Any,
        *,
        seconds: float = 5.0,
        markers: Mapping[str, tuple[str, Any]] | None = None,
    ) -> None:
        """Write a film, a GIF, of states with a leading axis, at times in equal intervals: as `draw`
        shows them, over so many `seconds`.

        ```python
        ts = jnp.linspace(0, 4, 81)  # in real time:
        robot.animate(sol.ys, "robot.gif", seconds=4.0, markers={"tool": ("platform", (0.0, 0.0, -0.6))})
        ```
        """
        if y[0].position.ndim != 3:
            raise ValueError(
                "`y` must be states with a leading axis for the times, such as `sol.ys`; a single one is drawn by `draw`."
            )
        write_film(outline_of(self, y, markers), path, seconds)

    def joints_at(self, t: RealScalarLike, args: Args) -> tuple[JointGroup, ...]:
        """Return the joints with the motions of drives at that time."""
        return tuple(group.at(t, args) for group in self.joints)
