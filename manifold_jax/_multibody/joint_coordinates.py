"""An assembly in the coordinates of its joints."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._linalg.dense import factorize_positive
from .._mechanics import MechanicalConstraint, MechanicalSystem
from .assembly import Assembly
from .bodies import Pose
from .checks import floating, is_concrete
from .contact_loads import StopLaws
from .energy import energy_of
from .frames import Frames
from .joint_forces import find_joint_forces
from .loads import JointLoads
from .reading import Energy, JointForce, Times
from .rotors import names_of
from .spanning_tree import find_spanning_tree, SpanningTree
from .start import CLOSED
from .system import ConstantAssembly, only_in_joint_coordinates
from .tree_checks import check_couplings, check_cycles, check_masses
from .tree_independent import check_dependent_loops, check_light_motions, find_independent_loops
from .tree_motion import TreeMotion
from .tree_readings import coordinates_of, poses_of
from .tree_system import LoopEquations, motion_of, TreeForces, TreeMass


State = tuple[Float[Array, "*t n"], Float[Array, "*t n"]]


class JointCoordinates(eqx.Module):
    r"""An [`Assembly`][] in the coordinates of its joints, a spanning tree of them, with the other joints as
    constraints:

        M(q) a + J^T lambda = Q(t, q, v),   phi(t, q) = 0.

    ```python
    robot = mb.read_urdf("robot.urdf", closures="robot.yaml").assembly
    joints = mb.JointCoordinates(robot)
    hook = mj.Projected(dfx.Dopri8(), joints.constraint)
    sol = mj.diffeqsolve(joints.terms, hook, 0.0, 1.0, 0.01, joints.state(), ...)
    robot.gaps(joints.poses(sol.ys)[0])  # also motion, point, draw, animate
    joints.energy(sol.ys)  # also joint_forces
    ```

    `q` has far fewer numbers than the poses of all bodies, and the joints of the tree hold by construction: a robot
    of ten bodies in one loop is solved several times as fast. Prefer the assembly itself for long chains
    (`M` is a full matrix: costs grow with the cube of the number of coordinates), and for the forces in the joints.

    **Arguments:**

    - `assembly`: where some equations of its joints depend on others, one of
        `without_dependent_equations`, or with `redundant=True`.

    **Attributes:**

    - `names`: of the numbers of `q`: angles of hinges (rad) and displacements of sliders (m), zero in the
        drawing, by the names of their joints; several numbers of one joint are `"name[0]"`, `"name[1]"`. A
        universal joint has two angles, a cylindrical one an angle and a displacement, a ball joint a
        unit quaternion, by which the second body is turned from where it is drawn, in the frame of the
        first. Bodies that no joints but rods tie to the ground have the coordinates of a `Pose`.
    - `terms`, `constraint`: the vector field on `(q, v)` with `v = dq/dt`, and the manifold; `None` if all joints are
        part of the tree, or the others of an assembly `without_dependent_equations` follow from it (a door on two
        hinges), which is then solved by any solver alone.
    - `system`: both as a [`MechanicalSystem`][manifold_jax.MechanicalSystem], of a tree one with no equations, for
        [`equilibrium`][manifold_jax.equilibrium] and [`rattle`][manifold_jax.rattle].

    The tree is the one with the fewest coordinates among those with all joints that have [`RotorInertia`][] or
    [`Coupling`][], and all hinges with springs, servo motors or stops beyond half a turn. Angles of its hinges continue
    beyond `pi`.

    **Raises** `ValueError` where such joints form a closed loop, and for bodies without mass that
    move no others, or that joints can move while nothing with mass moves.

    To differentiate by numbers of the assembly, replace it inside your function:
    `eqx.tree_at(lambda joints: joints.assembly, joints, changed)`.

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 8.
    """

    assembly: Assembly
    tree: SpanningTree = eqx.field(static=True)
    independent: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(self, assembly: Assembly):
        if not isinstance(assembly, Assembly):
            raise TypeError(
                f"`assembly` must be an `mj.multibody.Assembly`, got {type(assembly).__name__}. Of a robot take `robot.assembly`."
            )
        self.assembly = assembly
        coupled = assembly.couplings.joints + assembly.couplings.others
        turning = (name for loads in assembly.loads for name in loads.joints_with_whole_turns)
        needed = tuple(dict.fromkeys((*names_of(assembly.rotors), *coupled, *turning)))
        self.tree = find_spanning_tree(assembly.joints, len(assembly.names), needed)
        if not set(needed) <= set(self.names):
            left = [name for name in needed if name not in self.names]
            raise ValueError(
                f"`assembly`: joints with `RotorInertia` or `Coupling`, and hinges with springs, servo motors or stops beyond half "
                f"a turn, form a closed loop, with {left[:12]}. One joint of every loop must have none of these: leave one out, or add "
                "the inertia of a rotor to that of a body."
            )
        coordinates = self._motion.coordinates
        check_masses(assembly, self.tree, coordinates)
        if all(map(is_concrete, jtu.tree_leaves(assembly))) and np.any(assembly.bodies.mass == 0):
            check_light_motions(assembly, self._motion)
        check_cycles(assembly, coordinates)
        self.independent = None if assembly.independent is None else self._find_independent()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self._motion.coordinates.columns)

    @property
    def system(self) -> MechanicalSystem:
        source = ConstantAssembly(self.assembly)
        equations = LoopEquations(source, self.tree, self.independent)
        mass, forces = TreeMass(source, self.tree), TreeForces(source, self.tree)
        is_independent = not self._has_constraints or self.assembly.independent is not None
        redundant = self.assembly.redundant and not is_independent
        return MechanicalSystem(mass, equations, forces, redundant=redundant, structure="dense")

    @property
    def terms(self) -> dfx.AbstractTerm:
        return self.system.terms if self._has_constraints else dfx.ODETerm(self._field)

    @property
    def constraint(self) -> MechanicalConstraint | None:
        return self.system.constraint if self._has_constraints else None  # pyright: ignore[reportReturnType]

    def state(self, y: tuple[Pose, Pose] | None = None) -> State:
        """Return the state `(q, v)` of a state of the assembly, by default `assembly.state()`, the drawing at
        rest. Poses do not tell whole turns: angles are from `-pi` to `pi`, those of a hinge with stops as near as
        possible to the middle of these. Add multiples of `2 pi` to others.

        **Raises** `ValueError` if the state does not satisfy the joints of the tree, and where equations of loops
        depend on each other but the assembly is neither `redundant` nor one of `without_dependent_equations`.
        """
        y = self.assembly.state() if y is None else y
        found = _between_stops(self._motion, _stops_of_hinges(self.assembly), y)
        if all(map(is_concrete, jtu.tree_leaves((self.assembly, y)))):
            self._check(found, y)
        return found

    def poses(self, y: State) -> tuple[Pose, Pose]:
        """Return the state of the assembly; `y` may have leading axes, such as `sol.ys`."""
        if y[0].ndim > 1:
            return jax.vmap(self.poses)(y)
        return poses_of(self._motion, *y)

    def energy(self, y: State) -> Energy:
        """Return kinetic energy, and potential energy of weight and springs, whose angles continue beyond `pi`. `y` may
        have leading axes, such as `sol.ys`."""
        if y[0].ndim > 1:
            return jax.vmap(self.energy)(y)
        return energy_of(self.assembly, self.poses(y), self._motion.coordinates.known(y[0]))

    def joint_forces(self, t: Times, y: State, args: Args = None) -> dict[str, JointForce]:
        """Return force and torque of every joint on its second body, as
        [`Assembly.joint_forces`][manifold_jax.multibody.Assembly.joint_forces], with the angles of springs, servo motors
        and stops as they are in `y`, which may have leading axes.

        **Raises** `ValueError` for [`RotorInertia`][], [`Coupling`][] and bodies without mass."""
        if y[0].ndim > 1:
            times = jnp.broadcast_to(floating(t), y[0].shape[:1])
            return jax.vmap(lambda t, y: self.joint_forces(t, y, args))(times, y)
        known = self._motion.coordinates.known(y[0])
        if listed := only_in_joint_coordinates(self.assembly, known):
            raise ValueError(
                f"`joint_forces`: forces in joints are found from the poses of bodies, and not yet with {listed}. Leave these out, "
                "or give bodies mass, for an assembly whose forces are wanted."
            )
        return find_joint_forces(self.assembly, t, self.poses(y), args, known)

    @property
    def _motion(self) -> TreeMotion:
        return motion_of(self.assembly, self.tree)

    @property
    def _has_constraints(self) -> bool:
        if self.independent is not None:
            return bool(self.independent)
        has_loops = any(self.tree.loops) or bool(self.assembly.couplings.names)
        return has_loops or self._motion.coordinates.has("quaternion")

    def _field(self, t: RealScalarLike, y: State, args: Args) -> State:
        source = ConstantAssembly(self.assembly)
        mass = factorize_positive(TreeMass(source, self.tree)(y[0], args))
        a = mass.solve(TreeForces(source, self.tree)(t, *y, args))
        return y[1], a + jnp.where(mass.usable, 0, jnp.nan).astype(a.dtype)

    def _check(self, found: State, y: tuple[Pose, Pose]) -> None:
        ours, given = _frames(*_poses(self._motion, *found)), _frames(*y)
        for k, what in ((0, "positions"), (2, "velocities")):  # of `Frames`, linear and angular
            parts = zip(ours[k : k + 2], given[k : k + 2], strict=True)
            gap = np.max([np.abs(a - b).reshape(len(a), -1).max(axis=1) for a, b in parts], axis=0)
            if not gap.max() <= 10 * CLOSED * max(1, np.abs(given[k]).max()):
                raise ValueError(
                    f"`y`: the {what} of {self.assembly.names[int(gap.argmax())]!r} are not those that the joints allow (gap "
                    f"{gap.max():.3g}). Make a state by `assembly.state(..., assemble=True)`."
                )
        check_couplings(self.assembly.couplings, self._motion.coordinates, *found)
        checked = self.assembly.redundant or self.assembly.independent is not None
        if self._has_constraints and not checked:
            check_dependent_loops(self.assembly, self._motion, found[0])

    def _find_independent(self) -> tuple[int, ...] | None:
        if not all(map(is_concrete, jtu.tree_leaves(self.assembly))):
            raise ValueError(
                "`assembly` is one of `without_dependent_equations`, whose numbers must be known: call `JointCoordinates` outside "
                "of `jit`, `vmap` and derivatives, and replace `assembly` inside, by `eqx.tree_at`."
            )
        drawing = self.assembly.bodies.drawing
        q, _ = _coordinates_of(self._motion, (drawing, jtu.tree_map(jnp.zeros_like, drawing)))
        return find_independent_loops(self.assembly, self._motion, q)


def _stops_of_hinges(assembly: Assembly) -> tuple[JointLoads, ...]:
    in_hinges = (loads for loads in assembly.loads if isinstance(loads, JointLoads) and loads.hinge)
    return tuple(loads for loads in in_hinges if isinstance(loads.laws, StopLaws))


# One program each, not one for each operation.
@eqx.filter_jit
def _between_stops(
    motion: TreeMotion, stops: tuple[JointLoads, ...], y: tuple[Pose, Pose]
) -> State:
    """Return coordinates and rates, with those whole turns of hinges that are nearest to their stops."""
    q, v = coordinates_of(motion, y)
    for loads in stops:
        known = motion.coordinates.known(q)
        places, numbers = known.find(loads.joints)
        x = known.instead_of(jnp.zeros_like(loads.laws.lower), loads.joints)
        q = q.at[numbers].set(loads.laws.nearest(x)[places])
    return q, v


_coordinates_of = eqx.filter_jit(coordinates_of)
_poses = eqx.filter_jit(poses_of)
_frames = eqx.filter_jit(Frames.of)
