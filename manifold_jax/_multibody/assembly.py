"""Bodies, joints and forces put together: a mechanical system."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._mechanics import MechanicalSystem
from . import reading
from .bodies import Bodies, Body, Pose
from .checks import check_vector, floating
from .drives import group_restraints
from .forces import AbstractForce
from .frames import Frames, in_space
from .joint_groups import jacobian, JointGroup, residuals
from .joints import AbstractRestraint
from .load_groups import group_forces
from .loads import AbstractLoads, add
from .rotations import rates_matrix, turn_back
from .start import make_state
from .system import ConstantAssembly, system_of


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
        [`Prismatic`][], [`Cylindrical`][], [`Universal`][], [`Fixed`][], [`Distance`][], and [`Drive`][]
        where their motion is prescribed.
    - `forces`: [`Spring`][], [`Damper`][], [`JointSpring`][], [`Motor`][],
        [`LinearActuator`][], [`Force`][], [`Torque`][].
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
    loads: tuple[AbstractLoads, ...]
    gravity: Float[Array, "3"]
    redundant: bool = eqx.field(static=True)

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
        self.loads = group_forces(self.bodies, self.joints, forces)
        gravity = np.zeros(d) if gravity is None else gravity
        self.gravity = in_space(check_vector("`gravity`", gravity, d))
        self.redundant = redundant
        if self.bodies.planar and not self.joints:
            raise ValueError(
                "Bodies in the plane without any joint have no constraints: without them use `diffrax.ODETerm` and the "
                "solver alone."
            )

    @property
    def system(self) -> MechanicalSystem:
        """Masses, constraints and forces as a [`MechanicalSystem`][], which has the `terms`, the
        manifold `constraint` and the `multipliers`."""
        return system_of(ConstantAssembly(self), self.redundant)

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
        """A state `(q, v)`: the drawing at rest, with what is given for some bodies by name.

        **Arguments:**

        - `positions`, `velocities` of centres of mass; `orientations`, as for [`Body`][];
            `angular_velocities` (rad/s), a number, or in space shape `(3,)`, in the coordinates of
            space.
        - `assemble`: keep what is given, and find the rest such that all joints are satisfied, the
            nearest to the drawing and the slowest. Also inside of `jit`, `vmap` and derivatives, by
            lengths and by what is given; joints that cannot be closed are then an error while the
            program runs. (Without it traced states are not checked.)
        - `t`, `args`: the time of the start and the `args` of the solve, for what [`Drive`][]s prescribe.

        **Raises** `ValueError` where joints are not satisfied (without `assemble`) or cannot be:
        which ones, and how large the gap is; and where equations depend on each other but
        `redundant` is false.
        """
        given = positions, orientations, velocities, angular_velocities
        return make_state(self, given, assemble, floating(t), args)

    def gaps(
        self, q: Pose, t: RealScalarLike = 0.0, args: Args = None
    ) -> dict[str, Float[Array, " r"]]:
        """Residuals of the joints by name at the first part of a state `(q, v)`: lengths in metres,
        cosines of angles. `t` and `args` are those of [`Drive`][]s, whose angles are in rad."""
        gaps = residuals(self.joints_at(t, args), q)
        pairs = [
            (name, row)
            for group, rows in zip(self.joints, gaps, strict=True)
            for name, row in zip(group.attachment.names, rows, strict=True)
        ]
        return dict(pairs)

    def motion(self, y: tuple[Pose, Pose], name: str) -> reading.Motion:
        """Position, orientation, velocity and angular velocity of a body. `y` may have leading axes,
        here and below, such as `sol.ys`."""
        return reading.motion(self, y, name)

    def point(self, y: tuple[Pose, Pose], name: str, at: Any) -> tuple[Array, Array]:
        """Position and velocity in space of the point `at` in the frame of a body."""
        return reading.point(self, y, name, at)

    def joint_coordinates(self, y: tuple[Pose, Pose]) -> dict[str, Float[Array, "*t"]]:
        """Angles of hinges (from `-pi` to `pi`) and displacements of sliders by name, zero in the
        drawing."""
        return reading.joint_coordinates(self, y)

    def joint_forces(
        self, t: reading.Times, y: tuple[Pose, Pose], args: Args = None
    ) -> dict[str, reading.JointForce]:
        """Force and torque of every joint on its second body, from the multipliers, at the time `t` or
        the times of all states. With `redundant`
        joints it is the sum over those that depend on each other that is determined."""
        return reading.joint_forces(self, t, y, args)

    def energy(self, y: tuple[Pose, Pose]) -> reading.Energy:
        """Kinetic energy, and potential energy of weight and springs."""
        return reading.energy(self, y)

    def joints_at(self, t: RealScalarLike, args: Args) -> tuple[JointGroup, ...]:
        """Return the joints with the motions of drives at that time."""
        return tuple(group.at(t, args) for group in self.joints)

    def _equations(self, t: RealScalarLike, q: Pose, args: Args) -> tuple[Array, ...]:
        equations = residuals(self.joints_at(t, args), q)
        if self.bodies.planar:
            return equations
        return (*equations, (jnp.sum(q.orientation**2, axis=1) - 1) / 2)

    def _jacobian(self, t: RealScalarLike, q: Pose, args: Args) -> Float[Array, "m n"]:
        rows = jacobian(self.joints_at(t, args), q)
        if not self.bodies.planar:
            p, own = q.orientation, jnp.eye(len(self.names), dtype=rows.dtype)
            norms = own[:, :, None] * jnp.pad(p, ((0, 0), (3, 0)))[:, None, :]
            rows = jnp.concatenate([rows, norms])
        return rows.reshape(rows.shape[0], -1)

    def _force(self, t: RealScalarLike, q: Pose, v: Pose, args: Args) -> Pose:
        frames = Frames.of(q, v)
        weight = self.bodies.mass[:, None] * self.gravity[None, :]
        total = jnp.pad(weight, ((0, 1), (0, 0))), jnp.zeros_like(frames.origin)
        for loads in self.loads:
            total = add(total, loads.wrench(t, frames, args))
        force, torque = total[0][:-1], total[1][:-1]
        if self.bodies.planar:
            return Pose(force[:, :2], torque[:, 2])
        local = turn_back(frames.rotation[:-1], torque)
        turning = 2 * turn_back(rates_matrix(q.orientation), local)
        return Pose(force, turning + self.bodies.gyroscopic(q, v))
